from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest

from zsched.lab.demo import DemoOptions, Interrupted, interruptible, run_demo


@pytest.mark.parametrize(
    ("options", "code", "says"),
    [
        (DemoOptions(mode="guess"), 2, "--mode guess"),
        (DemoOptions(duration_s=3.0), 2, "--duration 3"),
        (DemoOptions(log=Path("no-such.log"), out=Path("never-made")), 78, "no-such.log"),
    ],
)
def test_wrong_options_are_told_before_anything_starts(
    options: DemoOptions, code: int, says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)

    assert run_demo(options) == code
    assert says in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_a_folder_with_something_in_it_is_not_overwritten(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "mine").write_text("x")

    assert run_demo(DemoOptions(out=tmp_path)) == 2
    assert "not empty" in capsys.readouterr().err


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_the_first_signal_interrupts_and_later_ones_cannot_cut_the_clean_up(number: signal.Signals) -> None:
    cleaned = []
    before = signal.getsignal(number)

    def work() -> None:
        with interruptible():
            try:
                os.kill(os.getpid(), number)
                signal.pause()
            finally:
                os.kill(os.getpid(), number)
                cleaned.append(True)

    with pytest.raises(Interrupted) as caught:
        work()

    assert caught.value.number == number
    assert cleaned
    assert signal.getsignal(number) is before
