"""A fleet file becomes a Fleet, or every fault in it is reported at once with its place."""

import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from zsched.config.load import CheckResult, check_bytes, check_file, load_fleet
from zsched.core.values.fleet import (
    Fleet,
    OnIsolation,
    Standby,
    WorkerLink,
    electorate_hash,
    fleet_hash,
)
from zsched.core.values.model import NodeKind, Reach
from zsched.core.values.plan import Direction, HandoverRule, ReadyWhen, StreamClass

ROOT = Path(__file__).parents[3]
CONFIGS = sorted((ROOT / "configs").rglob("*.yaml"))

GOOD = """\
fleet: warehouse
timing: wifi
seeds: [edge1, edge2]
nodes:
  robot1: {kind: robot, wifi: wlan0}
  robot2: {kind: robot, fixed: -60, links: {edge1: {fixed: -55}, robot1: {mac: "aa:BB:cc:00:11:22", wifi: wlan1}}}
  robot3: {kind: robot, wired: true, links: {edge2: {trace: {file: drive.csv, column: rssi, offset_s: 120}}}}
  edge1: {kind: edge, host: 192.0.2.11, labels: {gpu: "no"}, listen: {control: tcp/0.0.0.0:7457, data: tcp/0.0.0.0:7458}}
  edge2: {kind: edge, host: 192.0.2.12, labels: {gpu: yes}, listen: {control: tcp/0.0.0.0:7457, data: tcp/0.0.0.0:7458}}
tasks:
  map_merge:
    candidates: {kind: edge}
    weights: {cpu: 0.5, memory: 0.5, network: 0.0}
    demand: {cpu_cores: 0.4, memory_mb: 250}
    scheduling: {bonus: 0.10, price_s: 0.4}
    worker: {command: [python, -m, zsched.tasks.map_merge], standby: warm}
    inputs:   [{from: "{robot}/map", to: "{target}/map_merge/{robot}/map", class: latest, keep_last: 1}]
    outputs:  [{from: "{target}/map_merge/global_map", to: "{robot}/global_map", class: latest}]
zenoh: {config: zenoh.json5}
"""  # noqa: E501 - one line per node, as operators write it


def check(text: str) -> CheckResult:
    return check_bytes(text.encode())


def fleet_of(text: str) -> Fleet:
    result = check(text)
    assert result.fleet is not None, result.report()
    return result.fleet


def places(result: CheckResult) -> list[tuple[int, int]]:
    return [(fault.line, fault.col) for fault in result.faults]


def only_fault(text: str, said: str, at: str) -> None:
    """The text has one fault, its message holds ``said`` and its caret stands at the (unique) text ``at``."""
    result = check(text)
    assert len(result.faults) == 1, result.report()
    (fault,) = result.faults
    assert said in fault.message, fault.message
    assert text.count(at) == 1
    before = text[: text.index(at)]
    assert (fault.line, fault.col) == (before.count("\n") + 1, len(before.rpartition("\n")[2]) + 1), result.report()
    assert result.fleet is None


def swapped(old: str, new: str, text: str = GOOD) -> str:
    assert text.count(old) >= 1, old
    return text.replace(old, new, 1)


# --- good files ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.name)
def test_every_shipped_file_loads(path: Path) -> None:
    fleet = load_fleet(path)
    assert fleet.tasks[0].name == "map_merge"
    warnings = check_file(path).warnings
    assert bool(warnings) == (path.name == "minimal.yaml")


def test_shipped_files_are_there() -> None:
    assert {path.name for path in CONFIGS} >= {
        "fleet.yaml",
        "ros2.yaml",
        "ros2-node.yaml",
        "demo.yaml",
        "robots-only.yaml",
        "minimal.yaml",
    }


def test_the_designs_file_loads_with_every_feature() -> None:
    fleet = fleet_of(GOOD)
    assert fleet.name == "warehouse"
    assert [node.name for node in fleet.nodes] == ["edge1", "edge2", "robot1", "robot2", "robot3"]
    assert fleet.voters == fleet.electors == ("robot1", "robot2", "robot3")
    assert fleet.seeds == ("edge1", "edge2")
    assert fleet.node("edge1").labels == (("gpu", "no"),)
    assert fleet.node("edge2").labels == (("gpu", "yes"),), "YAML 1.2: yes is text"
    assert fleet.node("edge1").kind is NodeKind.EDGE
    assert fleet.zenoh_config.endswith("/zenoh.json5")
    task = fleet.task("map_merge")
    assert task.candidates == ("edge1", "edge2")
    assert (task.demand.cpu_cores, task.demand.memory_mb) == (0.4, 250)
    assert task.worker.command == ("python", "-m", "zsched.tasks.map_merge")
    assert [rule.direction for rule in task.rules] == [Direction.INPUT, Direction.OUTPUT]
    assert task.rules[0].settings.stream_class is StreamClass.LATEST


def test_a_bad_name_is_told_with_a_good_one_and_is_not_taken_for_no_node_at_all() -> None:
    text = "fleet: hall\nnodes: {Edge One: {kind: edge}}\ntasks: {}\n"
    (fault,) = check(text).faults
    assert (fault.line, fault.col) == (2, 9)
    assert fault.message.endswith("and a letter or digit first; for example edge-one")
    (fault,) = check("fleet: hall\nnodes: {}\ntasks: {}\n").faults
    assert fault.message == "the fleet has no nodes"


SCHEDULED = "    scheduling: {bonus: 0.10, price_s: 0.4}\n"


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ("{objective: latency}", ("objective latency needs a deadline", "deadline_ms: 100")),
        ("{deadline_ms: 80}", ("deadline_ms counts for objective latency only", "add objective: latency")),
        ("{objective: service, deadline_ms: 80}", ("deadline_ms counts for objective latency only",)),
        ("{objective: latency, deadline_ms: 80, score: paper}", ("the paper's score knows no deadlines",)),
        ("{objective: latency, deadline_ms: 0}", ("0 is not in the allowed range 1..3600000 ms",)),
        ("{objective: speed}", ("objective", "speed")),
        ("{objective: latencey, deadline_ms: 80}", ("objective", "latencey")),
    ],
)
def test_half_an_objective_is_a_fault_that_says_what_is_missing(given: str, words: tuple[str, ...]) -> None:
    result = check_bytes(swapped(SCHEDULED, f"    scheduling: {given}\n").encode())
    assert result.fleet is None
    assert len(result.faults) == 1, result.report()
    for word in words:
        assert word in result.report()


def test_a_deadline_of_a_worker_that_tells_nothing_is_worth_a_word() -> None:
    text = swapped(SCHEDULED, "    scheduling: {objective: latency, deadline_ms: 80}\n")
    assert "judged by service" not in check_bytes(text.encode()).report()
    foreign = text.replace("    worker: {", "    worker: {ready: matching, ")
    assert foreign != text
    assert "judged by service, whatever the deadline" in check_bytes(foreign.encode()).report()


def test_every_setting_of_a_task_arrives() -> None:
    text = swapped(
        "    scheduling: {bonus: 0.10, price_s: 0.4}\n    worker: {command: "
        "[python, -m, zsched.tasks.map_merge], standby: warm}\n",
        """\
    scheduling:
      {bonus: 0.2, reach: all,
       price_s: 0.7, memory_s: 60}
    link: {nu_dbm: -75, rho_dbm: -45}
    on_isolation: local
    drain_s: 5
    worker:
      command: [run, 8080, 1.10]
      standby: cold
      ready: matching
      link: client
      env: {PORT: 0x10, GREETING: "hello you"}
      start_deadline_s: 60
      stop_grace_s: 1
      output_deadline_s: 9
      max_failures: 5
      failure_window_s: 30
""",
    ).replace("class: latest}]", "class: reliable, depth: 99, handover: all}]")
    task = fleet_of(text).task("map_merge")
    assert (task.tuning.bonus, task.price_s, task.memory_s) == (0.2, 0.7, 60)
    assert task.reach is Reach.ALL
    assert (task.limits.nu_dbm, task.limits.rho_dbm) == (-75, -45)
    assert (task.on_isolation, task.drain_s) == (OnIsolation.LOCAL, 5)
    worker = task.worker
    assert worker.command == ("run", "8080", "1.10"), "text stays as written"
    assert (worker.standby, worker.ready_when, worker.link) == (Standby.COLD, ReadyWhen.MATCHING, WorkerLink.CLIENT)
    assert worker.env == (("GREETING", "hello you"), ("PORT", "0x10"))
    assert (worker.start_deadline_s, worker.stop_grace_s, worker.output_deadline_s) == (60, 1, 9)
    assert (worker.max_failures, worker.failure_window_s) == (5, 30)
    output = task.rules[1].settings
    assert (output.stream_class, output.depth, output.handover) == (StreamClass.RELIABLE, 99, HandoverRule.ALL)


PREFERRED = swapped(
    SCHEDULED,
    "    scheduling: {prefer: {edge1: 0.05, site=hall: 0.1}, together: {plan: 0.2}, spread: {watch: 0.3}, "
    "priority: 2}\n",
).replace('labels: {gpu: "no"}', "labels: {site: hall}")
for _name in ("plan", "watch"):
    _task = f"  {_name}: {{candidates: {{kind: edge}}, weights: {{cpu: 1, memory: 0, network: 0}}}}\n"
    PREFERRED = PREFERRED.replace("zenoh:", f"{_task}zenoh:")


def test_what_a_task_prefers_is_resolved_to_nodes_and_tasks() -> None:
    task = fleet_of(PREFERRED).task("map_merge")
    assert task.prefer == (("edge1", 0.1),), "the larger one, where its name and a label of it are named"
    assert task.beside == (("plan", 0.2), ("watch", -0.3))
    assert task.priority == 2


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("{edge1: 0.05", "{edge9: 0.05", "there is no node 'edge9'"),
        ("site=hall: 0.1}", "site=yard: 0.1}", "there is no label 'site=yard'"),
        ("{plan: 0.2}", "{plane: 0.2}", "map_merge names 'plane', which is no other task"),
        ("{plan: 0.2}", "{map_merge: 0.2}", "map_merge names 'map_merge', which is no other task"),
        ("{plan: 0.2}", "{watch: 0.2}", "'watch' is under `together` as well"),
    ],
)
def test_who_prefers_what_is_not_there_is_told_so(old: str, new: str, said: str) -> None:
    result = check(swapped(old, new, PREFERRED))
    assert [fault.message for fault in result.faults if said in fault.message], result.report()
    assert len(result.faults) == 1, result.report()


@pytest.mark.parametrize(
    ("said", "is_auto", "electors"),
    [
        ("", True, ("robot1", "robot2", "robot3")),
        ("electorate: auto\n", True, ("robot1", "robot2", "robot3")),
        ("electorate: {kind: edge}\n", False, ("edge1", "edge2")),
        ("electorate: [robot1, robot2, robot3]\n", False, ("robot1", "robot2", "robot3")),
    ],
)
def test_electors_that_nobody_names_are_replaced_by_themselves(
    said: str, is_auto: bool, electors: tuple[str, ...]
) -> None:
    fleet = fleet_of(GOOD + said)
    assert (fleet.is_auto, fleet.electors) == (is_auto, electors)


def test_few_electors_are_advised_by_warning_only() -> None:
    one = check(swapped("tasks:", "electorate: [robot1]\ntasks:"))
    assert one.fleet is not None
    assert "only elector" in one.report()
    two = check(swapped("tasks:", "electorate: [robot1, edge1]\ntasks:"))
    assert two.fleet is not None
    assert "hint: electorate: [edge1, robot1, robot2]" in two.report()
    four = check(swapped("tasks:", "electorate: [robot1, robot2, robot3, edge1]\ntasks:"))
    assert "survive the loss of 1, as 3 would" in four.report()


def test_the_hint_for_few_electors_is_no_worse_than_one() -> None:
    """Two electors need both, so they are no better than one."""
    pair = """\
fleet: pair
nodes:
  robot1: {kind: robot, host: 192.0.2.1, listen: {control: tcp/0.0.0.0:7457, data: tcp/0.0.0.0:7458}}
  edge1: {kind: edge, host: 192.0.2.2, listen: {control: tcp/0.0.0.0:7457, data: tcp/0.0.0.0:7458}}
tasks: {}
"""
    (only,) = (one for one in check(pair).warnings if "only elector" in one.message)
    assert only.hint == ""
    (only,) = (one for one in check(pair.replace("tasks:", "  edge2: {kind: edge}\ntasks:")).warnings if one.hint)
    assert only.hint == "electorate: [edge1, edge2, robot1]"


MANY_FAULTS = """\
fleet: hall
nodes:
  robot1: {kind: robot, host: 127.0.0.1, listen: {control: tcp/127.0.0.1:21480, data: tcp/127.0.0.1:21481}}
  edge1: {kind: edgy, host: 127.0.0.1, listen: {control: tcp/127.0.0.1:21480, data: tcp/127.0.0.1:21482}}
  edge2: {kind: edge}
tasks:
  adder:
    candidates: [edge9]
    weights: {cpu: 1, memory: 0, network: 0}
    inputs:  [{from: "{robot}/number", to: "{target}/adder/{robot}/number", class: relible}]
    outputs: [{from: "{target}/adder/{robot}/number", to: "{robot}/number"}]
  summer:
    candidates: [edge2]
    weights: {cpu: 1, memory: 0, network: 0}
    inputs:  [{from: "{robot}/part", to: "{target}/summer/{robot}/part"}]
    outputs: [{from: "{target}/summer/total", to: total, handover: sometimes}]
"""


def test_a_fault_hides_no_other_that_can_be_judged_beside_it() -> None:
    """What a stranger mended only to be told of three more."""
    result = check(MANY_FAULTS)
    told = [(fault.line, fault.message) for fault in result.faults]
    for line, said in (
        (4, "edgy"),
        (4, "tcp/127.0.0.1:21480 is already robot1's control session"),
        (8, "there is no node 'edge9'"),
        (10, "relible"),
        (11, "loop, relays feed each other"),
        (16, "'total': it lacks {robot}"),
        (16, "sometimes"),
    ):
        assert any(at == line and said in message for at, message in told), (line, said, told)
    assert len(told) == 7, told
    assert result.report().endswith("what hangs on a faulty part cannot be judged")
    assert "more may follow" not in check(GOOD).report(), "there are warnings only"


def test_relative_files_are_relative_to_the_fleet_file(tmp_path: Path) -> None:
    (tmp_path / "drive.csv").write_text("")
    (tmp_path / "zenoh.json5").write_text("{}")
    (tmp_path / "fleet.yaml").write_text(GOOD)
    result = check_file(tmp_path / "fleet.yaml")
    assert result.fleet is not None
    assert result.warnings == ()
    assert result.fleet.zenoh_config == str(tmp_path / "zenoh.json5")


def test_an_anchor_may_be_set_again() -> None:
    text = swapped('{gpu: "no"}', '&l {gpu: "no"}').replace("{gpu: yes}", "&l {gpu: yes}")
    assert fleet_of(text).node("edge2").labels == (("gpu", "yes"),)


# --- hashes and endpoints --------------------------------------------------------------------------------------------


def test_hashes_ignore_the_folder_and_see_every_setting(tmp_path: Path) -> None:
    fleet = fleet_of(GOOD)
    elsewhere = check_bytes(GOOD.encode(), str(tmp_path / "fleet.yaml")).fleet
    assert elsewhere is not None
    assert elsewhere != fleet
    assert fleet_hash(elsewhere) == fleet_hash(fleet)
    assert re.fullmatch(r"[0-9a-f]{16}", fleet_hash(fleet))
    for old, new in (
        ("bonus: 0.10", "bonus: 0.11"),
        ("wlan0", "wlan9"),
        ("timing: wifi", "timing: wan"),
        ('/global_map"', '/g"'),
    ):
        other = fleet_of(swapped(old, new))
        assert fleet_hash(other) != fleet_hash(fleet), old
        assert electorate_hash(other) == electorate_hash(fleet)


def test_electorate_hash_sees_electors_and_fleet_name_only() -> None:
    fleet = fleet_of(GOOD)
    assert electorate_hash(replace(fleet, electors=("robot1",))) != electorate_hash(fleet)
    assert electorate_hash(replace(fleet, name="other")) != electorate_hash(fleet)


def test_hashes_are_the_same_in_another_process(tmp_path: Path) -> None:
    (tmp_path / "fleet.yaml").write_text(GOOD)
    code = (
        "import sys; from zsched.config.load import load_fleet;"
        "from zsched.core.values.fleet import fleet_hash, electorate_hash;"
        "f = load_fleet(sys.argv[1]); print(fleet_hash(f), electorate_hash(f))"
    )
    run = [sys.executable, "-c", code, str(tmp_path / "fleet.yaml")]
    printed = subprocess.run(run, capture_output=True, text=True, check=True, timeout=60).stdout.split()
    fleet = load_fleet(tmp_path / "fleet.yaml")
    assert printed == [fleet_hash(fleet), electorate_hash(fleet)]


# --- faults ----------------------------------------------------------------------------------------------------------


def test_five_faults_of_different_kinds_are_reported_at_once_with_their_places() -> None:
    text = GOOD
    for old, new in (
        ("timing: wifi", "timing: wify"),  # an unknown word
        ("memory: 0.5,", "memory: 1.5,"),  # out of range
        ("standby: warm", "standby: warm, standbye: cold"),  # an unknown key
        ("seeds: [edge1, edge2]", "seeds: [edge1, edge9]"),  # a name that is no node
        ("{robot}/global_map", "{robo}/global_map"),  # an unknown placeholder
    ):
        text = swapped(old, new, text)
    result = check_bytes(text.encode(), "fleet.yaml")
    report = result.report()
    assert places(result) == [(2, 9), (3, 16), (13, 33), (16, 76), (18, 60)], report
    for line in (
        "fleet.yaml:2:9: error: 'wify' is not `wired` or `wifi` or `wan`",
        "fleet.yaml:13:33: error: 1.5 is not in the allowed range 0..1",
        "fleet.yaml:16:76: error: a worker has no key 'standbye'",
        "    hint: did you mean 'standby'?",
        "fleet.yaml:3:16: error: there is no node 'edge9'",
        "fleet.yaml:18:60: error: '{robo}/global_map': there is no placeholder {robo}",
        "    hint: did you mean 'robot'?",
    ):
        assert line in report.split("\n"), report
    with_caret = report.split("\n")
    at = with_caret.index("fleet.yaml:13:33: error: 1.5 is not in the allowed range 0..1")
    assert with_caret[at + 1 : at + 3] == ["        weights: {cpu: 0.5, memory: 1.5, network: 0.0}", " " * 36 + "^~~"]


def test_missing_file_is_a_fault_not_an_exception(tmp_path: Path) -> None:
    result = check_file(tmp_path / "none.yaml")
    assert result.fleet is None
    assert "none.yaml: error: cannot be read: No such file or directory" in result.report()
    assert check_file(tmp_path).fleet is None
    assert check_file("a\0b").fleet is None


@pytest.mark.parametrize(("given", "hint"), [("20", "a share: 20 % is 0.2"), ("1.2", ""), ("200", "")])
def test_a_percentage_in_place_of_a_share_is_told_as_one(given: str, hint: str) -> None:
    weights = "    weights: {cpu: 1, memory: 0, network: 0}\n"
    text = (
        "fleet: f\nnodes:\n"
        "  r1: {kind: robot, wired: true, host: h, listen: {control: tcp/0.0.0.0:1, data: tcp/0.0.0.0:2}}\n"
        "  edge1: {kind: edge}\ntasks:\n  t:\n    candidates: {kind: edge}\n"
        f"{weights}    limits: {{battery: {given}}}\n    worker: {{command: [x]}}\n"
    )
    (fault,) = check_bytes(text.encode()).faults
    assert (fault.message, fault.hint) == (f"{given} is not in the allowed range 0..1", hint)


ONE_FAULT = [
    ("fleet: warehouse", "fleet: Ware", "is not a name", "Ware"),
    ("  robot3: {kind", "  Robot3: {kind", "is not a name", "Robot3"),
    ("kind: robot, wifi", "kind: robt, wifi", "'robt' is not `robot` or `edge`", "robt,"),
    ("kind: robot, wifi: wlan0", "wifi: wlan0", "a node lacks the key 'kind'", "{wifi: wlan0}"),
    ("wifi: wlan0", "wifi: wlan0, wired: true", "a link has one source", "true}\n  robot2"),
    ("wired: true", "wired: yes", "expected `true`", "yes, links"),
    ("fixed: -60", "fixed: 60", "not in the allowed range -120..0 dBm", "60, links"),
    ("fixed: -60", "fixed: strong", "expected a number -120..0 dBm", "strong"),
    ("{fixed: -55}", "{}", "the link to 'edge1' has no source", "edge1: {}"),
    ('mac: "aa:BB:cc:00:11:22", wifi: wlan1', "mac: aabb", "six pairs", "aabb"),
    (", wifi: wlan1", "", "no `wifi` interface", '"aa:BB'),
    ("links: {edge1", "links: {robot2", "is this node itself", "robot2: {fixed"),
    ("host: 192.0.2.11", "host: 192.0.2.311", "not an address", "192.0.2.311"),
    ("tcp/0.0.0.0:7457", "tpc/0.0.0.0:7457", "it must begin with", "tpc/"),
    ("tcp/0.0.0.0:7457", "tcp/0.0.0.0:77457", "PORT 0..65535", "tcp/0.0.0.0:77457"),
    ("tcp/0.0.0.0:7457", "tcp/fd00::1:7457", "stands in brackets", "tcp/fd00"),
    ("data: tcp/0.0.0.0:7458", "data: tcp/0.0.0.0:7457", "already edge1's control", "tcp/0.0.0.0:7457}}\n  edge2"),
    ("host: 192.0.2.12", "host: 192.0.2.11", None, None),
    ("host: 192.0.2.11, ", "", "cannot be dialled", "edge1, edge2]"),
    ("seeds: [edge1", "seeds: [robot1", "cannot be dialled", "robot1, edge2]"),
    ("seeds: [edge1", "seeds: [edge2", "is there twice", "edge2]\n"),
    ("candidates: {kind: edge}", "candidates: {labels: {gpu: maybe}}", "no node is a cand", "{labels: {gpu: m"),
    ("candidates: {kind: edge}", "candidates: {}", "the selection is empty", "{}"),
    ("candidates: {kind: edge}", "candidates: []", "expected", "[]"),
    ("candidates: {kind: edge}", "candidates: edge1", "expected", "edge1\n"),
    ("network: 0.0", "network: 0.1", "the sum is 1.1, not 1", "{cpu: 0.5"),
    ("network: 0.0", "network: 0.0, netwrk: 1", "has no key 'netwrk'", "netwrk"),
    ("cpu_cores: 0.4", "cpu_cores: .nan", "expected a number", ".nan"),
    ("cpu_cores: 0.4", 'cpu_cores: "0.4"', "expected a number", '"0.4"'),
    ("bonus: 0.10,", "bonus: 0.10, bonus: 0.2,", "the key 'bonus' is there twice", "bonus: 0.2"),
    ("[python, -m, zsched.tasks.map_merge]", "python -m x", "expected a list", "python -m x"),
    ("[python, -m, zsched.tasks.map_merge]", "[]", "expected a list", "[]"),
    ("standby: warm", "env: {ZSCHED_NODE: x}", "is set by zsched itself", "ZSCHED_NODE"),
    ("command: [python, -m, zsched.tasks.map_merge], standby: warm", "standby: cold", "no `command`", "cold"),
    ("    outputs:  ", "    link: {nu_dbm: -40}\n    outputs:  ", "must be below rho_dbm (-40)", "-40}"),
    ("keep_last: 1", "keep_last: 1001", "not in the allowed range 0..1000", "1001"),
    ("keep_last: 1", "keep_last: 1.5", "expected a whole number", "1.5"),
    ("class: latest, keep_last: 1", "keep_last: 1", "only streams of class latest", "1}]"),
    ("keep_last: 1", "handover: all", "only outputs have a handover", "all}]"),
    ("keep_last: 1", "max_hz: 0", "not in the allowed range 0.01..10000 Hz", "0}]"),
    ("class: latest, keep_last: 1", "class: reliable, max_hz: 5", "class reliable loses nothing", "5}]"),
    ("class: latest, keep_last: 1", "class: latest, on_crash: replay", "only inputs of class reliable", "replay}]"),
    ('"{robot}/map"', '"{target}/map"', "whoever owns", '"{target}/map"'),
    ("{target}/map_merge/{robot}/map", "{target}/map_merge/map", "would both publish", '"{target}/map_merge/map"'),
    ('"{robot}/map"', '"@zsched/x"', "belong to zsched itself", '"@zsched/x"'),
    ("    outputs:  ", "    exclusive: true\n    outputs:  ", "needs {epoch}", '"{robot}/global_map"'),
    ("timing: wifi", "timing: {confirm_s: 0.1}", "it must be >= 0.2 s (beat_s)", "0.1}"),
    ("timing: wifi", "timing: {zenoh_lease_s: 2.6}", "must be < 2.5 s", "2.6"),
    ("timing: wifi", "timing: {zenoh_lease_s: 0.9, lease_s: 0.6}", "must be >= 1 s", "0.9, lease"),
    ("timing: wifi", "timing: {gather_s: 0.6, ballot_s: 0.6}", "a round must end", "0.6, ballot"),
    ("timing: wifi", "timing: {profile_ttl_s: 1.5}", "one lost profile", "1.5}"),
    ("timing: wifi", "timing:", "expected", None),
    ("zenoh: {config: zenoh.json5}", "zenoh: zenoh.json5", "expected a mapping {config}", "zenoh.json5"),
    ("zenoh: {config: zenoh.json5}", "zenho: {config: zenoh.json5}", "no key 'zenho'", "zenho"),
    ("zenoh: {config: zenoh.json5}", "electorate: [robot1, ghost]", "there is no node 'ghost'", "ghost"),
]  # fmt: skip


@pytest.mark.parametrize(("old", "new", "said", "at"), ONE_FAULT)
def test_one_fault_is_reported_once_at_its_place(old: str, new: str, said: str | None, at: str | None) -> None:
    text = swapped(old, new)
    if said is None:  # two addresses on one machine: control and data both clash
        assert [fault.message.split(" is ")[1] for fault in check(text).faults] == [
            "already edge1's control session",
            "already edge1's data session",
        ]
    elif at is None:
        assert [said in fault.message for fault in check(text).faults] == [True]
    else:
        only_fault(text, said, at)


@pytest.mark.parametrize(
    ("old", "new", "key", "instead"),
    [
        ("price_s: 0.4", "price_s: 0.4, patience: 0.4", "patience", "price_s: 0.3"),
        ("price_s: 0.4", "price_s: 0.4, cool_down_s: 2", "cool_down_s", "price_s: 2"),
        ("price_s: 0.4", "price_s: 0.4, memory_floor_ratio: 0.1", "memory_floor_ratio", "demand: {memory_mb"),
        ("price_s: 0.4", "price_s: 0.4, max_moves_per_minute: 9", "max_moves_per_minute", "it is 6"),
        ("    outputs:", "    link: {foresee_s: 3}\n    outputs:", "foresee_s", "delete it"),
    ],
)
def test_a_key_that_files_had_once_changes_nothing_and_a_warning_says_what_to_write(
    old: str, new: str, key: str, instead: str
) -> None:
    """An upgrade must not take the file of a machine, or the agreed document, out of force."""
    result = check(swapped(old, new))
    assert result.fleet == check(GOOD).fleet
    (warned,) = (fault for fault in result.warnings if f"no key {key!r} any more" in fault.message)
    assert instead in warned.hint
    assert result.fleet is not None


def test_relay_loop_names_every_rule_with_its_place() -> None:
    text = swapped("{target}/map_merge/{robot}/map", "{target}/map").replace(
        "candidates: {kind: edge}", "candidates: {kind: robot}"
    )
    result = check(text)
    loop = next(fault for fault in result.faults if "loop, relays feed each other" in fault.message)
    assert (loop.line, loop.col) == (17, 42)
    assert loop.hint == "rules: map_merge/in/0 at 17:42"


def test_a_reliable_output_that_says_nothing_of_the_handover_is_warned_of() -> None:
    def warned(more: str) -> list[str]:
        result = check(GOOD.replace("class: latest}]", f"class: reliable{more}}}]"))
        assert result.fleet is not None
        return [fault.hint for fault in result.warnings if "last answers are dropped" in fault.message]

    assert warned("") == ["handover: all; or handover: latest, if that is meant"]
    assert warned(", handover: all") == warned(", handover: latest") == []


def test_exclusive_task_needs_a_worker_that_holds_the_lease() -> None:
    text = swapped("{target}/map_merge/global_map", "{target}/map_merge/{epoch}/global_map")
    text = swapped("standby: warm", "standby: warm, ready: matching", text)
    result = check(swapped("    inputs:  ", "    exclusive: true\n    on_isolation: local\n    inputs:  ", text))
    assert len(result.faults) == 2
    assert "hold the lease" in result.report()
    assert "cut off" in result.report()


def test_a_worker_that_shows_itself_by_matching_must_be_given_something() -> None:
    told = "nothing tells whether it is there"
    text = swapped("standby: warm", "standby: warm, ready: matching")
    assert not [warning for warning in check(text).warnings if told in warning.message]
    without = "\n".join(line for line in text.splitlines() if not line.startswith("    inputs:"))
    assert [warning for warning in check(without).warnings if told in warning.message]


def test_an_input_with_a_fault_is_given_all_the_same() -> None:
    result = check(
        swapped(
            "class: latest, keep_last: 1", "class: lates", swapped("standby: warm", "standby: warm, ready: matching")
        )
    )
    assert "lates" in result.report()
    assert not [warning for warning in result.warnings if "nothing tells whether it is there" in warning.message]


def test_a_worker_that_acknowledges_nothing_cannot_be_reliable() -> None:
    told = "acknowledges nothing"
    text = swapped("class: latest, keep_last: 1", "class: reliable")
    assert not [warning for warning in check(text).warnings if told in warning.message]
    foreign = check(swapped("standby: warm", "standby: warm, ready: matching", text))
    assert foreign.fleet is not None
    warning = next(warning for warning in foreign.warnings if told in warning.message)
    assert (warning.line, "zsched.worker" in warning.hint) == (17, True)
    replay = swapped("class: reliable", "class: reliable, on_crash: replay", text)
    assert check(replay).fleet is not None
    faults = check(swapped("standby: warm", "standby: warm, ready: matching", replay)).faults
    assert ["left undone" in fault.message for fault in faults] == [True]


def test_a_listen_section_that_names_streams_says_how_an_application_joins() -> None:
    listen = "{data: tcp/0.0.0.0:7458, streams: tcp/0.0.0.0:7459}"
    told = check(f"fleet: f\nnodes:\n  r1: {{kind: robot, host: 192.0.2.1, listen: {listen}}}\n").report()
    assert "an application joins its robot's relay as a client of zenoh" in told


def test_nodes_that_nobody_can_dial_are_refused() -> None:
    text = "fleet: f\nnodes:\n  r1: {kind: robot}\n  r2: {kind: robot}\n"
    assert "no node can be dialled" in check(text).report()
    assert check("fleet: f\nnodes:\n  r1: {kind: robot}\n").fleet is not None
    where = "host: 192.0.2.1, listen: {control: '0.0.0.0:7457', data: 'tcp/0.0.0.0:7458'}"
    told = check(f"fleet: f\nnodes:\n  r1: {{kind: robot, {where}}}\n  r2: {{kind: robot}}\n").report()
    assert "is not a zenoh endpoint" in told
    assert "no node can be dialled" not in told, "that follows from it"


@pytest.mark.parametrize(
    ("nodes", "mute"),
    [
        ("r1: {kind: robot, wifi: wlan0}, e1: {kind: edge}", "of any candidate"),
        ("r1: {kind: robot, wifi: wlan0}, e1: {kind: edge, wired: true}", ""),
        ("r1: {kind: robot, wifi: wlan0}, e1: {kind: edge, wired: true}, e2: {kind: edge}", "of e2:"),
        ("r1: {kind: robot, wifi: wlan0}, e1: {kind: edge, wired: true}, e2: {kind: edge, wired: true}", ""),
        ("r1: {kind: robot, links: {e1: {fixed: -50}, e2: {fixed: -60}}}, e1: {kind: edge}, e2: {kind: edge}", ""),
    ],
)
def test_a_candidate_whose_link_nobody_measures_beside_others_is_a_warning(nodes: str, mute: str) -> None:
    """It was refused for good, and only `explain` on a running fleet said why."""
    task = "{candidates: {kind: edge}, weights: {cpu: 0.5, network: 0.5}}"
    host = 'host: 192.0.2.1, listen: {control: "tcp/0.0.0.0:7457", data: "tcp/0.0.0.0:7458"}, kind: edge'
    nodes = nodes.replace("e1: {kind: edge", f"e1: {{{host}")
    result = check(f"fleet: f\nnodes: {{{nodes}}}\ntasks: {{t: {task}}}\n")
    assert result.fleet is not None, result.report()
    found = [one.message for one in result.warnings if "nobody measures a link" in one.message]
    assert len(found) == bool(mute)
    assert all(mute in message for message in found)


@pytest.mark.parametrize(
    ("settings", "word"),
    [
        ("weights: {cpu: 0.5, gpu: 0.5}", "the GPU has a weight"),
        ("weights: {cpu: 1}, limits: {gpu: 0.9}", "the GPU has a limit"),
        ("weights: {cpu: 0.5, gpu: 0.5}, demand: {gpu: 0.3}", ""),
        ("weights: {cpu: 1}, limits: {gpu: 0.9}, demand: {gpu: 0.3}", ""),
        ("weights: {cpu: 1}, limits: {gpu: 1}", ""),
        ("weights: {cpu: 0.5, battery: 0.5}, limits: {battery: 0.2}", ""),
    ],
)
def test_a_gpu_that_counts_without_the_task_s_use_of_it_is_a_warning(settings: str, word: str) -> None:
    text = f"fleet: f\nnodes: {{r1: {{kind: robot}}}}\ntasks: {{t: {{candidates: [r1], {settings}}}}}\n"
    result = check(text)
    assert result.fleet is not None, "a running fleet may have such a file"
    found = [one for one in result.warnings if "GPU" in one.message]
    assert len(found) == bool(word)
    for warning in found:
        assert word in warning.message
        assert "demand: {gpu: 0.3}" in warning.hint
        assert text.splitlines()[warning.line - 1][: warning.col - 1].endswith("gpu: ")


@pytest.mark.parametrize(
    ("settings", "above", "hint"),
    [
        ("limits: {gpu: 0.35}, demand: {gpu: 0.3}", "0.25", "{gpu: 0.4}, or more"),
        ("limits: {gpu: 0.05}, demand: {gpu: 0.3}", "0", "{gpu: 0.4}, or more"),
        ("limits: {gpu: 0.95}, demand: {gpu: 0.95}", "0.85", "{gpu: 1}, or more"),
        ("limits: {gpu: 0.4}, demand: {gpu: 0.3}", "", ""),
        ("limits: {gpu: 1}, demand: {gpu: 1}", "", ""),
        ("limits: {gpu: 0.05}", "", ""),
    ],
)
def test_a_limit_that_the_task_itself_breaks_everywhere_is_a_warning(settings: str, above: str, hint: str) -> None:
    """It was never placed, and nobody said why."""
    task = f"{{candidates: [r1], weights: {{cpu: 1}}, {settings}}}"
    result = check(f"fleet: f\nnodes: {{r1: {{kind: robot}}}}\ntasks: {{t: {task}}}\n")
    assert result.fleet is not None
    found = [one for one in result.warnings if "no machine can get the task" in one.message]
    assert [one.hint.endswith(hint) for one in found] == ([True] if above else [])
    assert all(f"is above {above}, which" in one.message for one in found)
    assert all(("from another one" in one.message) == ("0.35" in settings or "0.95" in settings) for one in found)


# --- the price -------------------------------------------------------------------------------------------------------


def test_importing_config_loads_neither_the_yaml_reader_nor_anything_heavy() -> None:
    code = "import sys, zsched.config.load; print(*sorted({name.split('.')[0] for name in sys.modules}))"
    printed = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60
    ).stdout
    assert not set(printed.split()) & {"ruamel", "pydantic", "numpy", "asyncio", "zenoh", "msgpack"}


@pytest.mark.parametrize(
    ("line", "said", "at"),
    [
        ("weights: {cpu: 0.5, gpu: 0.3}", "the sum is 0.8, not 1", "{cpu: 0.5, gpu"),
        ("weights: {cpu: 1}\n    limits: {battery: 20}", "20 is not in the allowed range 0..1", "20}\n"),
        ("weights: {cpu: 1}\n    limits: {temperature: 85}", "temperature", "temperature: 85"),
    ],
)
def test_faults_of_weights_and_limits_are_shown_where_they_stand(line: str, said: str, at: str) -> None:
    only_fault(GOOD.replace("weights: {cpu: 0.5, memory: 0.5, network: 0.0}", line), said, at)
