"""What the command line refuses: what is wrong, where, and what to do."""

from __future__ import annotations

from pathlib import Path

import pytest

from zsched.exits import EXIT_CONFIG
from zsched.tasks.crossing.__main__ import main, settings_for

TCP, TLS = "tcp/192.0.2.31:7458", "tls/192.0.2.31:7458"
FLEET = "fleet: {name}\nnodes: {{robot1: {{kind: robot}}}}\ntasks: {{}}\n"


@pytest.fixture(autouse=True)
def _in_hall_a(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ZSCHED_FLEET", "hall-a")


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["give", "Hall B", TCP], "'Hall B' is no cell's name"),
        (["give", "hall-a", TCP], "'hall-a' is this fleet itself; name the fleet at the other end"),
        (["take", "hall-a"], "'hall-a' is this fleet itself"),
        (["give", "hall-b", "192.0.2.31"], "hall-b: '192.0.2.31' cannot be dialled; write where the relay of a node"),
        (["give", "hall-b", "tcp/0.0.0.0:7458"], "hall-b: 'tcp/0.0.0.0:7458' cannot be dialled"),
        (["give", "hall-b", TLS], "hall-b is a secured fleet, and nothing says with which certificate"),
        (["give", "hall-b", TLS, "--file", "/none.yaml"], "/none.yaml: there is no such file; put a copy of hall-b's"),
        (["give", "hall-b", TCP, "--patience", "0"], "--patience: 0 is no time; write seconds above 0"),
        (["give", "hall-b", TCP], "this worker has no ZSCHED_NODE"),
    ],
)
def test_a_wrong_word_ends_it_for_good_and_is_told(
    words: list[str], told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(words) == EXIT_CONFIG
    assert f"crossing: {told}" in capsys.readouterr().err


def test_the_file_must_be_the_other_cell_s(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "hall-c.yaml"
    file.write_text(FLEET.format(name="hall-c"))
    assert main(["give", "hall-b", TLS, "--file", str(file)]) == EXIT_CONFIG
    assert f"{file} is the file of fleet hall-c, and not of hall-b" in capsys.readouterr().err


def test_without_the_guest_s_certificate_it_says_which_file_is_missing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    handed = tmp_path / "handed"  # what systemd hands over is of the own cell
    handed.mkdir()
    for name in ("certificate.pem", "key.pem", "ca.pem"):
        (handed / name).write_text("-----BEGIN ")
    monkeypatch.setenv("CREDENTIALS_DIRECTORY", str(handed))
    file = tmp_path / "hall-b.yaml"
    file.write_text(FLEET.format(name="hall-b") + "security: {folder: of-hall-b}\n")
    assert main(["give", "hall-b", TLS, "--file", str(file)]) == EXIT_CONFIG
    assert "of-hall-b/certificate.pem: cannot be read" in capsys.readouterr().err


def test_a_cell_in_plain_text_needs_no_file() -> None:
    assert settings_for("hall-b", [TCP], None) == ""
