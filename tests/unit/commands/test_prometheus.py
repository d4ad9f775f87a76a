"""The alerts and the dashboard that are shipped: a real parser reads every expression, every name and label is real."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import promql_parser as promql
import pytest
from prometheus_client.parser import text_string_to_metric_families
from ruamel.yaml import YAML

from zsched.tools.metrics import metrics_text

ROOT = Path(__file__).parents[3]
RULES = ROOT / "configs" / "prometheus" / "zsched.rules.yml"
DASHBOARD = ROOT / "configs" / "grafana" / "dashboards" / "zsched.json"
PROMTOOL = shutil.which("promtool")
FROM_PROMETHEUS = {"up": {"job", "instance"}}
EVERYWHERE = {"instance", "job"}


def yaml(file: Path) -> Any:
    return YAML(typ="safe", pure=True).load(file.read_text(encoding="utf-8"))


def rules() -> list[dict[str, Any]]:
    return [rule for group in yaml(RULES)["groups"] for rule in group["rules"]]


def dashboard() -> dict[str, Any]:
    found: dict[str, Any] = json.loads(DASHBOARD.read_text(encoding="utf-8"))
    return found


def told() -> dict[str, set[str]]:
    """{name: its labels} of all that zsched tells, by another implementation's parser."""
    here = Path(__file__).parent
    files = [*(here / "recorded_status").glob("*.json"), here.parent / "tools" / "watch" / "recorded" / "fleet.json"]
    found: dict[str, set[str]] = dict(FROM_PROMETHEUS)
    for file in files:
        for family in text_string_to_metric_families(metrics_text(json.loads(file.read_text()))):
            for sample in family.samples:
                found.setdefault(sample.name, set()).update(sample.labels)
    return found


def expressions() -> Iterator[tuple[str, str]]:
    for rule in rules():
        yield rule["alert"], rule["expr"]
    for panel in dashboard()["panels"]:
        for target in panel["targets"]:
            yield panel["title"], target["expr"]
    for note in dashboard()["annotations"]["list"]:
        yield note["name"], note["expr"]


def parsed(expression: str) -> Any:
    """Grafana's variables stand for a duration or a pattern."""
    plain = expression.replace("$__rate_interval", "1m").replace("$__interval", "5s").replace("$instance", ".*")
    assert "$" not in plain, expression
    return promql.parse(plain)


def parts(node: Any) -> Iterator[Any]:
    """An expression and all below it."""
    yield node
    for name in ("lhs", "rhs", "expr", "vector_selector", "vs"):
        below = getattr(node, name, None)
        if isinstance(below, promql.Expr) and below is not node:
            yield from parts(below)
    for below in getattr(node, "args", None) or ():
        if isinstance(below, promql.Expr):
            yield from parts(below)


def faults(expression: str, known: dict[str, set[str]]) -> list[str]:
    """Names and labels of an expression that nothing tells."""
    found = []
    labels = set(EVERYWHERE)
    for part in parts(parsed(expression)):
        if isinstance(part, promql.VectorSelector):
            name = part.name
            if name not in known:
                found.append(f"no metric {name}")
                continue
            labels |= known[name]
            wrong = {matcher.name for matcher in part.matchers.matchers} - known[name] - EVERYWHERE
            found += [f"{name} has no label {label}" for label in sorted(wrong)]
    named = re.findall(r"\b(?:by|on)\s*\(([^)]*)\)", expression)
    used = {label.strip() for group in named for label in group.split(",")}
    return found + [f"no label {label}" for label in sorted(used - labels)]


@pytest.mark.parametrize(("where", "expression"), list(expressions()), ids=[name for name, _ in expressions()])
def test_every_expression_is_read_and_names_what_is_told(where: str, expression: str) -> None:
    assert faults(expression, told()) == [], where


def test_planted_wrong_names_are_found() -> None:
    known = told()
    assert faults("zsched_task_ovner == 0", known) == ["no metric zsched_task_ovner"]
    assert faults('max by (task) (rate(zsched_task_epoch{tsk="a"}[5m]))', known) == [
        "zsched_task_epoch has no label tsk"
    ]
    assert faults("sum by (stram) (zsched_task_epoch) / zsched_uptime_seconds", known) == ["no label stram"]
    with pytest.raises(ValueError, match="parenthesis"):
        faults("sum(zsched_up", known)


def test_every_alert_says_what_is_wrong_what_to_do_and_how_bad_it_is() -> None:
    names = [rule["alert"] for rule in rules()]
    assert len(set(names)) == len(names)
    for rule in rules():
        assert re.fullmatch(r"Zsched[A-Z][A-Za-z]+", rule["alert"])
        assert set(rule["annotations"]) == {"summary", "action"}
        assert rule["labels"]["severity"] in ("critical", "warning")
        assert re.fullmatch(r"\d+[sm]", rule.get("for", "0s"))


def test_what_alerts_say_by_a_label_is_kept_by_their_expression() -> None:
    """``max by (task)`` drops the instance, so a summary must not name it."""
    for rule in rules():
        outer = re.match(r"(?:max|sum|count) by \(([^)]*)\)", rule["expr"])
        kept = None if outer is None else {label.strip() for label in outer[1].split(",")}
        used = set(re.findall(r"\$labels\.(\w+)", " ".join(rule["annotations"].values())))
        assert kept is None or used <= kept, rule["alert"]


def test_what_is_taken_over_several_nodes_stays_within_a_fleet() -> None:
    """Of two halls with a task of one name it was said for ever that its owners differ."""
    outer = [re.match(r"(?:max|sum|count) by \(([^)]*)\)", rule["expr"]) for rule in rules()]
    kept = [{label.strip() for label in one[1].split(",")} for one in outer if one is not None]
    assert len(kept) > 5
    assert all(labels & {"instance", "fleet"} for labels in kept)


@pytest.mark.parametrize("alert", ["ZschedStreamDrops", "ZschedFramesDropped"])
def test_a_count_that_is_there_for_the_first_time_is_seen(alert: str) -> None:
    """What `rate` and `increase` see is a rise; a reason's first burst is none."""
    (rule,) = [rule for rule in rules() if rule["alert"] == alert]
    risen, appeared = rule["expr"].split(" or ")
    assert re.search(r"(?:rate|increase)\((.+?)\[(\d+)m\]\)", risen)
    counted, window = re.findall(r"(?:rate|increase)\((.+?)\[(\d+)m\]\)", risen)[0]
    name = counted.partition("{")[0]
    heard = f"and on (instance) (zsched_up offset {window}m == 1)"
    assert f"(({counted} unless {name} offset {window}m) {heard}) > " in appeared, "a node that is back is not new"


def test_a_node_that_was_never_heard_is_told_as_one_that_is_gone() -> None:
    (rule,) = [rule for rule in rules() if rule["alert"] == "ZschedNodeGone"]
    assert 'state=~"gone|unknown"' in rule["expr"]


def test_a_legend_says_all_that_grafanas_schema_asks_for() -> None:
    """As `tests/live/grafana_schema.py` found, by the types that Grafana writes itself by."""
    legends = [panel["options"]["legend"] for panel in dashboard()["panels"] if "legend" in panel["options"]]
    assert len(legends) > 5
    for legend in legends:
        assert legend.keys() >= {"displayMode", "placement", "showLegend", "calcs"}


def test_panels_of_the_dashboard_have_their_places() -> None:
    panels = dashboard()["panels"]
    assert [panel["id"] for panel in panels] == list(range(1, len(panels) + 1))
    taken: set[tuple[int, int]] = set()
    for panel in panels:
        at = panel["gridPos"]
        cells = {(x, y) for x in range(at["x"], at["x"] + at["w"]) for y in range(at["y"], at["y"] + at["h"])}
        assert at["x"] + at["w"] <= 24
        assert not taken & cells, panel["title"]
        taken |= cells
        assert panel["description"]
        for target in panel["targets"]:
            assert target["datasource"]["uid"] == "${datasource}"
            assert all(label in target["expr"] for label in re.findall(r"{{(\w+)}}", target["legendFormat"])) or (
                "by (" not in target["expr"]
            )
    variables = {variable["name"] for variable in dashboard()["templating"]["list"]}
    assert variables == {"datasource", "instance"}


def test_grafana_finds_the_dashboard_and_its_source() -> None:
    base = ROOT / "configs" / "grafana" / "provisioning"
    (source,) = yaml(base / "datasources" / "zsched.yml")["datasources"]
    assert (source["type"], source["url"]) == ("prometheus", "http://127.0.0.1:9090")
    (provider,) = yaml(base / "dashboards" / "zsched.yml")["providers"]
    assert provider["options"]["path"] == "/etc/grafana/dashboards"
    assert dashboard()["uid"] == "zsched"
    assert yaml(RULES.parent / "prometheus.yml")["rule_files"] == [RULES.name]


# --- Prometheus' own tool --------------------------------------------------------------------------------------------

SERIES = {
    'zsched_quorum_ok{instance="robot1"}': "1x2 0x30",
    'zsched_info{fleet="hall-a", node="robot1", instance="robot1"}': "1x40",
    'zsched_info{fleet="hall-b", node="robot9", instance="robot9"}': "1x40",
    'zsched_task_owner{task="echo", node="edge2", instance="robot9"}': "1x40",
    'zsched_node_state{node="edge3", state="unknown", instance="robot1"}': "1x40",
    'zsched_events_total{event="dropped_beat_seal", instance="robot1"}': "_x5 37x35",
    'zsched_task_owner{task="echo", node="edge1", instance="robot1"}': "1x2 0x30",
    'zsched_task_owner{task="echo", node="edge2", instance="robot1"}': "0x2 0x30",
    'zsched_task_owner{task="detect", node="edge2", instance="robot1"}': "1x40",
}


@pytest.mark.skipif(PROMTOOL is None, reason="no promtool here (Debian: prometheus)")
def test_promtool_takes_the_rules_and_alerts_fire_by_them(tmp_path: Path) -> None:
    fired = [
        {
            "eval_time": "60s",
            "alertname": name,
            "exp_alerts": [{"exp_labels": {"severity": "critical", **labels}, "exp_annotations": notes}],
        }
        for name, labels, notes in (
            ("ZschedNoQuorum", {"instance": "robot1"}, expected("ZschedNoQuorum", instance="robot1")),
            (
                "ZschedTaskWithoutOwner",
                {"task": "echo", "fleet": "hall-a"},
                expected("ZschedTaskWithoutOwner", task="echo", fleet="hall-a"),
            ),
        )
    ]
    fired += [
        {
            "eval_time": "180s",
            "alertname": name,
            "exp_alerts": [
                {"exp_labels": {"severity": "warning", **labels}, "exp_annotations": expected(name, **labels)}
            ],
        }
        for name, labels in (
            ("ZschedNodeGone", {"fleet": "hall-a", "node": "edge3"}),
            ("ZschedFramesDropped", {"instance": "robot1", "event": "dropped_beat_seal"}),
        )
    ]
    quiet: list[dict[str, Any]] = [
        {"eval_time": "10s", "alertname": name, "exp_alerts": []} for name in ("ZschedNoQuorum", "ZschedDown")
    ]
    quiet.append({"eval_time": "60s", "alertname": "ZschedOwnersDiffer", "exp_alerts": []})
    series = [{"series": name, "values": values} for name, values in SERIES.items()]
    body = {
        "rule_files": [str(RULES)],
        "evaluation_interval": "5s",
        "tests": [{"interval": "5s", "input_series": series, "alert_rule_test": [*quiet, *fired]}],
    }
    file = tmp_path / "test.yml"
    file.write_text(json.dumps(body))
    done = subprocess.run([str(PROMTOOL), "test", "rules", str(file)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def expected(alert: str, **labels: str) -> dict[str, str]:
    """Its annotations with the labels filled in."""
    notes: dict[str, str] = next(rule["annotations"] for rule in rules() if rule["alert"] == alert)
    return {
        name: re.sub(r"{{ \$labels\.(\w+) }}", lambda found: labels[found[1]], text) for name, text in notes.items()
    }
