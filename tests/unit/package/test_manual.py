"""The manual pages, which are the help."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest
import typer.main
from manual import pages

from zsched.cli import app

ROOT = Path(__file__).parents[3]


def test_the_manual_pages_that_are_shipped_are_today_s_help() -> None:
    found = pages(typer.main.get_command(app))
    shipped = {path.name: path.read_text(encoding="utf-8") for path in (ROOT / "man").glob("*.1")}
    assert shipped == found, "write them anew: make man"


def test_every_verb_has_a_page_with_all_its_options() -> None:
    found = pages(typer.main.get_command(app))
    assert {"zsched.1", "zsched-status.1", "zsched-stream.1", "zsched-stream-list.1"} <= set(found)
    assert not [name for name in found if "complete." in name or "demo" in name]
    page = found["zsched-tune.1"]
    assert '.TH "ZSCHED-TUNE" "1" "" "zsched" "zsched"' in page
    for text in ("\\-\\-revision N", "\\-\\-json", "TASK", "[KEY=VALUE]", ".SH DESCRIPTION\nShow a task's tuning"):
        assert text in page
    assert ".SH EXIT STATUS\n0 fine, 1 failed" in found["zsched.1"]


def test_no_text_is_taken_for_a_request_of_roff() -> None:
    known = (".TH ", ".SH ", ".TP", ".PP", ".B ")
    for name, page in pages(typer.main.get_command(app)).items():
        odd = [line for line in page.splitlines() if line[:1] in (".", "'") and not line.startswith(known)]
        assert odd == [], name


@pytest.mark.skipif(shutil.which("man") is None, reason="no man here")
def test_man_reads_the_pages_without_a_warning() -> None:
    command = ["man", "--warnings", "-E", "UTF-8", "-l", str(ROOT / "man" / "zsched-status.1")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert "Seconds between two" in done.stdout
