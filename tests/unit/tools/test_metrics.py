"""Prometheus text: another implementation's parser reads it, names and units are by convention, files are whole."""

from __future__ import annotations

import json
import os
import re
import signal
from pathlib import Path
from typing import Any

import pytest
from prometheus_client.parser import text_string_to_metric_families
from typer.testing import CliRunner

from zsched.cli import app
from zsched.host.operator_socket import OperatorSocket
from zsched.tools.metrics import down_text, metrics_text

RECORDED = Path(__file__).parents[1] / "commands" / "recorded_status"


def recorded(name: str = "healthy") -> dict[str, Any]:
    status: dict[str, Any] = json.loads((RECORDED / f"{name}.json").read_text())
    return status


def parsed(text: str) -> dict[str, Any]:
    """{family: what prometheus_client reads}."""
    return {family.name: family for family in text_string_to_metric_families(text)}


def values(text: str, name: str) -> dict[tuple[str, ...], float]:
    """{label values: value} of one name."""
    found = [sample for family in parsed(text).values() for sample in family.samples if sample.name == name]
    return {tuple(sample.labels.values()): sample.value for sample in found}


@pytest.mark.parametrize("name", ["healthy", "edge", "degraded"])
def test_another_parser_reads_every_line(name: str) -> None:
    text = metrics_text(recorded(name))
    lines = [line for line in text.splitlines() if not line.startswith("#")]
    assert sum(len(family.samples) for family in parsed(text).values()) == len(lines) > 50
    assert text.endswith("\n")


def test_names_and_kinds_are_by_convention() -> None:
    for name, family in parsed(metrics_text(recorded())).items():
        assert re.fullmatch(r"zsched_[a-z_]+", name)
        assert family.documentation.endswith(".")
        assert family.type == ("counter" if family.samples[0].name.endswith("_total") else "gauge"), name
        assert not name.endswith(("_mb", "_s", "_ms"))


@pytest.mark.parametrize(
    ("state", "is_told"), [("alive", True), ("suspect", True), ("gone", False), ("unknown", False)]
)
def test_the_last_figures_of_a_node_that_is_gone_are_no_samples(state: str, is_told: bool) -> None:
    """An alert on a failed worker went on for a machine that was switched off."""
    status = recorded()
    node = status["nodes"][0]
    node |= {
        "state": state,
        "gauges": {"battery": 0.5},
        "links": [{"peer": None, "source": "wireless", "rssi_dbm": -60.0}],
    }
    assert node["workers"]
    text = metrics_text(status)
    told = {
        name for name, family in parsed(text).items() if any(s.labels.get("node") == "edge1" for s in family.samples)
    }
    always = {"zsched_node_state", "zsched_node_profile_age_seconds", "zsched_task_owner", "zsched_task_utility_ratio"}
    assert always <= told
    figures = {"zsched_node_cpu_cores", "zsched_node_cpu_used_cores", "zsched_node_memory_bytes", "zsched_node_gauge"}
    figures |= {"zsched_link_rssi_dbm", "zsched_worker_state", "zsched_node_draining"}
    assert figures & told == (figures if is_told else set())


def test_a_task_that_no_other_candidate_could_take_is_told() -> None:
    status = recorded()
    assert values(metrics_text(status), "zsched_task_without_spare") == {("echo",): 0}
    status["tasks"][0]["problems"] = ["another one", "no other candidate can take it"]
    status["tasks"][0]["problem_kinds"] = ["other", "no_spare"]
    assert values(metrics_text(status), "zsched_task_without_spare") == {("echo",): 1}
    del status["tasks"][0]["problem_kinds"]
    assert values(metrics_text(status), "zsched_task_without_spare") == {}, "an older daemon does not tell"


def test_names_of_others_cannot_break_a_line() -> None:
    status = recorded()
    status["tasks"][0]["streams"][0]["drops"] = {'a"b\\c\nd': 3}
    assert values(metrics_text(status), "zsched_stream_dropped_total") == {("echo", "in/0", 'a"b\\c\nd'): 3}


# --- the verbs -------------------------------------------------------------------------------------------------------


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("ZSCHED_RUNTIME_DIR", str(tmp_path))
    monkeypatch.delenv("ZSCHED_NODE", raising=False)
    return tmp_path


def test_print_and_write_say_the_same_and_the_file_is_for_all_to_read(folder: Path) -> None:
    status = recorded()
    daemon = OperatorSocket(folder / "robot1.sock", lambda _request: status)
    daemon.open()
    file = folder / "zsched.prom"
    file.write_text("of before")
    try:
        printed = CliRunner().invoke(app, ["metrics", "print"])
        written = CliRunner().invoke(app, ["metrics", "write", str(file)])
    finally:
        daemon.close()
    assert (printed.exit_code, written.exit_code, written.stdout) == (0, 0, "")
    assert file.read_text() == printed.stdout == metrics_text(status)
    assert file.stat().st_mode & 0o777 == 0o644
    assert [path.name for path in folder.iterdir() if "prom" in path.name] == ["zsched.prom"], "nothing half-written"


def test_without_a_daemon_the_file_says_so_and_no_old_figure_stays(folder: Path) -> None:
    file = folder / "zsched.prom"
    file.write_text(metrics_text(recorded()))
    result = CliRunner().invoke(app, ["metrics", "write", str(file)])
    assert (result.exit_code, file.read_text()) == (3, down_text())
    assert values(down_text(), "zsched_up") == {(): 0}
    assert "no daemon in" in result.stderr


def test_without_this_machine_s_certificate_no_old_figure_stays(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    listen = "listen: {control: tls/127.0.0.1:1, data: tls/127.0.0.1:2}"
    config, file = folder / "fleet.yaml", folder / "zsched.prom"
    config.write_text(
        f"fleet: hall\nnodes: {{robot1: {{kind: robot, {listen}}}}}\ntasks: {{}}\nsecurity: {{folder: {folder}}}\n"
    )
    monkeypatch.setenv("ZSCHED_CONFIG", str(config))
    file.write_text(metrics_text(recorded()))
    result = CliRunner().invoke(app, ["metrics", "write", str(file), "--connect", "tls/127.0.0.1:1"])
    assert (result.exit_code, file.read_text()) == (78, down_text())
    assert "certificate.pem" in result.stderr


def test_who_is_interrupted_while_it_writes_leaves_the_new_file_and_no_other(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    set_mode = os.fchmod

    def interrupt(descriptor: int, mode: int) -> None:
        signal.raise_signal(signal.SIGINT)
        set_mode(descriptor, mode)

    monkeypatch.setattr(os, "fchmod", interrupt)
    file = folder / "zsched.prom"
    result = CliRunner().invoke(app, ["metrics", "write", str(file)])
    assert (result.exit_code, file.read_text()) == (3, down_text())
    assert [path.name for path in folder.iterdir()] == ["zsched.prom"]


def told_names() -> set[str]:
    """The names of docs/guide/cli.md; `_alive` behind `zsched_quorum_electors` is `zsched_quorum_alive`."""
    page = (Path(__file__).parents[3] / "docs" / "guide" / "cli.md").read_text(encoding="utf-8")
    table = page.partition("| names | labels |")[2].partition("\n\n")[0]
    found = set()
    for line in table.splitlines():
        family = ""
        for name in re.findall(r"`(\w+)`", line.split(" | ")[0]):
            family = "_".join(name.split("_")[:2]) if name.startswith("zsched_") else family
            found.add(name if name.startswith("zsched_") else family + name)
    return found


def test_the_page_of_the_command_line_names_every_metric() -> None:
    status = recorded()
    status["nodes"][0]["gauges"] = {"gpu": 0.5}
    names = {sample.name for family in parsed(metrics_text(status)).values() for sample in family.samples}
    assert names - told_names() == set()
