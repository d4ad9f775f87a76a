from __future__ import annotations

import os
import signal
import sys
import time
from pathlib import Path

import pytest

from zsched_lab.demo.demo import DemoOptions, run_demo
from zsched_lab.fleet.signals import LOOK_AGAIN_S, Interrupted, interruptible


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


@pytest.mark.parametrize("inner", ["", "below"])
def test_a_folder_that_is_a_file_is_told_before_anything_starts(
    inner: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "mine").write_text("x")

    assert run_demo(DemoOptions(out=tmp_path / "mine" / inner)) == 2
    assert "--out" in capsys.readouterr().err


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


def test_foreign_code_that_drops_the_exception_only_delays_it() -> None:
    class Drops:
        def __del__(self) -> None:
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(1.0)
            reached.append("dropped")

    reached: list[str] = []
    unraisable: list[object] = []
    hook, sys.unraisablehook = sys.unraisablehook, unraisable.append

    def work() -> None:
        with interruptible():
            Drops()
            reached.append("went on")
            time.sleep(10.0)
            reached.append("was never interrupted")

    try:
        with pytest.raises(Interrupted):
            work()
    finally:
        sys.unraisablehook = hook

    assert len(unraisable) == 1
    assert reached == ["went on"]


def test_a_long_clean_up_is_not_interrupted_again() -> None:
    cleaned = []

    def work() -> None:
        with interruptible():
            try:
                os.kill(os.getpid(), signal.SIGTERM)
                signal.pause()
            finally:
                time.sleep(3 * LOOK_AGAIN_S)
                cleaned.append(True)

    with pytest.raises(Interrupted):
        work()

    assert cleaned
