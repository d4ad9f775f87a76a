"""The program as a whole: words that are wrong, what is imported, the help."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from support.clinic import FLEET
from support.recorded_daemon import Daemon
from zsched.cli import app

# --- streams that are closed -----------------------------------------------------------------------------------------


def with_closed(redirection: str, *words: str) -> subprocess.CompletedProcess[str]:
    """The program in a shell that has closed some of its streams."""
    command = ["sh", "-c", f'"$0" -m zsched "$@" {redirection}', sys.executable, *words]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)


@pytest.mark.parametrize("redirection", ["<&-", ">&-", "<&- >&-"])
def test_a_verb_without_a_stdin_is_off_a_terminal(daemon: Daemon, folder: Path, redirection: str) -> None:
    words = ("restart", "echo", "--runtime-dir", str(folder))
    done = with_closed(redirection, *words)
    assert (done.returncode, "Traceback" in done.stderr) == (2, False), done.stderr
    assert f"to do it:\nzsched {' '.join(words)} --yes" in done.stderr
    assert {one["verb"] for one in daemon.asked} == {"status"}


@pytest.mark.parametrize("redirection", [">&-", "2>&-", "<&- >&- 2>&-"])
def test_a_verb_without_a_stdout_or_stderr_ends_as_ever(daemon: Daemon, folder: Path, redirection: str) -> None:
    done = with_closed(redirection, "status", "--runtime-dir", str(folder))
    assert (done.returncode, done.stderr) == (0, "")
    assert bool(done.stdout) == (">&-" not in redirection.split())
    assert daemon.asked
    wrong = with_closed(redirection, "status", "--runtime-dir", str(folder / "none"))
    assert (wrong.returncode, "Traceback" in wrong.stderr) == (3, False), wrong.stderr


def test_a_program_that_is_started_from_a_verb_has_all_three_streams() -> None:
    text = (
        "import os; from zsched.cli import open_missing; open_missing(); print(list(map(os.get_inheritable, range(3))))"
    )
    command = ["sh", "-c", '"$0" -c "$1" <&- 2>&-', sys.executable, text]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stdout) == (0, "[True, True, True]\n")


# --- words that are wrong --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (
            ("fleet", "recover", "--generation", "99999999999", "--node", "edge1"),
            "--generation 99999999999: at most 1048575",
        ),
        (("init", "--node", "edg1"), "no node 'edg1' under 'nodes' (there are"),
    ],
)
def test_a_wrong_word_for_a_state_ends_as_usage_and_writes_nothing(
    words: tuple[str, ...], says: str, tmp_path: Path
) -> None:
    file = tmp_path / "fleet.yaml"
    file.write_text(FLEET)
    state = tmp_path / "state"
    result = CliRunner().invoke(app, [*words, "--config", str(file), "--state-dir", str(state)])
    assert result.exit_code == 2, result.stderr
    assert says in result.stderr
    assert not state.exists()


def test_the_module_runs_the_verb_as_the_program_does(tmp_path: Path) -> None:
    file = tmp_path / "fleet.yaml"
    file.write_text(FLEET.replace("kind: edge", "kind: ege"))
    done = subprocess.run(
        [sys.executable, "-m", "zsched", "check", str(file)], capture_output=True, text=True, check=False
    )
    assert (done.returncode, "ege" in done.stderr + done.stdout) == (78, True)


# --- what is imported ------------------------------------------------------------------------------------------------

FOREIGN = ("zenoh", "numpy", "cv2", "pydantic", "rich", "asyncio", "psutil", "ruamel", "msgpack", "matplotlib")
LOADED = """
import sys
sys.argv = ["zsched", *{arguments!r}]
try:
    from zsched.cli import main
    main()
finally:
    print("LOADED", *sorted({{name.partition(".")[0] for name in sys.modules}}), file=sys.stderr)
"""


def loaded_by(folder: Path, *arguments: str) -> tuple[int, set[str]]:
    """(exit code, top packages) of one run in an interpreter of its own."""
    code = LOADED.format(arguments=[*arguments, "--runtime-dir", str(folder)])
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    (line,) = [line for line in done.stderr.splitlines() if line.startswith("LOADED")]
    return done.returncode, set(line.split()[1:])


def test_status_loads_nothing_heavy_even_when_nobody_answers(folder: Path) -> None:
    code, loaded = loaded_by(folder, "status")
    assert code == 3
    assert loaded & set(FOREIGN) == set()
    assert "typer" in loaded


def test_status_and_tune_load_nothing_heavy(daemon: Daemon, folder: Path) -> None:
    for arguments in (("status",), ("status", "--json", "--node", "robot1"), ("tune", "echo")):
        code, loaded = loaded_by(folder, *arguments)
        assert code == 0
        assert loaded & set(FOREIGN) == set()
    assert daemon.asked


def test_command_line_has_no_side_effect_on_import() -> None:
    command = [sys.executable, "-c", "import zsched.cli"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    assert (done.stdout, done.stderr) == ("", "")


def test_the_list_of_verbs_cuts_no_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    text = CliRunner().invoke(app, ["--help-all"]).stdout
    _, listed = text.split("The fleet:\n")
    assert "..." not in listed
    assert max(map(len, text.splitlines())) <= 80
    assert "Run this machine's daemon in the foreground (what systemd runs)." in listed
