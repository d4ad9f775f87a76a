"""Reading a YAML text: what is kept of a text that is read again."""

import pytest

from zsched.config import reader
from zsched.config.reader import NOWHERE, read_yaml


def test_a_text_that_is_read_again_is_not_parsed_again(monkeypatch: pytest.MonkeyPatch) -> None:
    text = b"a: {b: [1, 2]}  # read twice"
    root, first = read_yaml(text)
    monkeypatch.setattr(reader, "_compose", lambda *_: pytest.fail("it was parsed again"))
    again, second = read_yaml(text)
    assert again is root
    first.error(NOWHERE, "what one reader finds wrong")
    assert not second.faults  # is no fault for the other


@pytest.mark.parametrize("text", [b"a: [1", b"", b"{{a: 1}: 2}"])
def test_a_faulty_text_tells_its_faults_each_time(text: bytes) -> None:
    told = [read_yaml(text)[1].faults for _ in range(2)]
    assert told[0]
    assert told[0] == told[1]


def test_a_long_text_is_not_kept() -> None:
    text = b"".join(b"key%d: value\n" % number for number in range(2000))
    assert read_yaml(text)[0] is not read_yaml(text)[0]
