from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from zsched.config.load import load_fleet
from zsched.core.values.errors import ConfigError
from zsched.core.values.fleet import DEFAULT_BONUS
from zsched.core.values.model import ScoreForm
from zsched.host.radio.network_profiler import parse_trace
from zsched_lab.fleet.runner import read_tree, write_fleet
from zsched_lab.paper.claims import CLAIMS
from zsched_lab.paper.load import Window, loaded_at, schedule
from zsched_lab.paper.oracle import best_nodes, changes, utilities, utility
from zsched_lab.paper.places import robots_scenario_path, scenario_path
from zsched_lab.paper.radio import drive_file, simulated_drive
from zsched_lab.paper.scenario import LinkView, LoadLevel, LoadPlan, NodeShare, Radio, Scenario, load_scenario
from zsched_lab.paper.schemes import SCHEMES, Family, candidates_of, find_schemes, scheme_tree

EDGES = ("edge1", "edge2", "edge3")
SMALL = """
name: small
fleet: fleet.yaml
duration_s: 20
seed: 5
runs: 1
level: one
levels: {one: {streams: 2}}
nodes: {edge1: {cpu_cores: 0.3, memory_mb: 512}}
"""


@pytest.fixture
def scenario() -> Scenario:
    return load_scenario(scenario_path())


def test_the_shipped_scenario_keeps_the_host_out_of_need_and_sweeps_the_load(scenario: Scenario) -> None:
    assert sum(share.cpu_cores for share in scenario.nodes.values()) < 1.5
    assert len(scenario.levels) >= 4
    assert scenario.runs == 5
    assert scenario.duration_s < 60
    assert min(scenario.nodes, key=lambda node: scenario.nodes[node].cpu_cores) == "edge1"
    assert scenario.run_seed(3) == scenario.seed + 3


def test_what_the_scenario_says_of_its_choices_holds(scenario: Scenario) -> None:
    smallest = min(abs(claim.target) for claim in CLAIMS if claim.target)
    main = scenario.levels[scenario.level]
    full = max(share.memory_mb for share in scenario.nodes.values())

    assert scenario.pressure_limit <= 0.07 + smallest / 2, "the floor that is seen without load (docs)"
    assert (main.streams, main.share, main.side) == (1, 0.6, 640)
    assert main.memory_mb / full == pytest.approx(0.2, abs=0.03)
    assert [level.streams * level.share for level in scenario.levels.values()] == pytest.approx(
        [0.3, 0.6, 1.2, 1.8, 2.4]
    )
    for share in scenario.nodes.values():  # the strongest load beside daemon, mapping and the task's worker fits
        assert share.ballast_mb + scenario.levels["four"].memory_mb + 200.0 < 0.95 * share.memory_mb


@pytest.mark.parametrize(
    ("block", "told"),
    [
        ("{one: {world: office}}", "one"),
        ("{matrix: {}}", "matrix"),
        ("{x: {links: {bandwidth_mbit: 0}}}", "bandwidth_mbit"),
        ("{x: {links: {bandwith: 3}}}", "bandwith"),
        ("{x: {runs: 0}}", "runs"),
        ("{x: {level: nine}}", "x: level 'nine' is none of one"),
        ("{x: {merge: {mode: guess}}}", "guess"),
        ("{x: {merge: {resolution_m: 0}}}", "resolution_m"),
        ("{x: {merge: {min_agreeing: 0}}}", "min_agreeing"),
        ("{x: {merge: {speed: 1}}}", "speed"),
    ],
)
def test_a_fault_in_a_block_is_named(tmp_path: Path, block: str, told: str) -> None:
    path = tmp_path / "scenario.yaml"
    path.write_text(SMALL + "blocks: {x: {links: {bandwidth_mbit: 3.5}}}\n")
    assert load_scenario(path).blocks["x"].links.bandwidth_mbit == 3.5
    path.write_text(SMALL + f"blocks: {block}\n")

    with pytest.raises(ConfigError, match=told):
        load_scenario(path)


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("cpu_cores: 0.3", "cpu_cores: 1.6", "cpu_cores"),
        ("level: one", "level: two", "two"),
        ("streams: 2", "streams: 0", "streams"),
        ("streams: 2", "stream: 2", "stream"),
        ("seed: 5", "seeds: 5", "seeds"),
        ("runs: 1\n", "", "runs"),
        ("duration_s: 20", "duration_s: 1", "duration_s"),
    ],
)
def test_a_fault_in_a_scenario_is_named(tmp_path: Path, old: str, new: str, told: str) -> None:
    path = tmp_path / "scenario.yaml"
    path.write_text(SMALL)
    assert load_scenario(path).nodes["edge1"] == NodeShare(cpu_cores=0.3, memory_mb=512)
    path.write_text(SMALL.replace(old, new))

    with pytest.raises(ConfigError, match=told):
        load_scenario(path)


def test_quotas_over_the_limit_in_all_are_refused(scenario: Scenario) -> None:
    shares = {node: NodeShare(cpu_cores=0.6, memory_mb=512) for node in EDGES}

    with pytest.raises(ValueError, match=r"1\.8 cores"):
        replace(scenario, nodes=shares)


def test_the_schedule_depends_on_the_seed_alone_and_never_loads_one_node_twice() -> None:
    plan = LoadPlan(lanes=2, busy_s=(5.0, 9.0), idle_s=(1.0, 2.0))
    seen = set()
    for seed in range(50):
        windows = schedule(plan, EDGES, 60.0, seed)
        seen.add(windows)
        assert windows == schedule(plan, tuple(reversed(EDGES)), 60.0, seed)
        assert all(window.start_s < window.end_s <= 60.0 for window in windows)
        for window in windows:
            middle = (window.start_s + window.end_s) / 2
            assert window.node in loaded_at(windows, middle)
            assert sum(w.node == window.node and w.start_s <= middle < w.end_s for w in windows) == 1
            assert len(loaded_at(windows, middle)) <= 2
    assert len(seen) == 50


def test_no_lanes_or_no_nodes_is_no_load() -> None:
    assert schedule(LoadPlan(lanes=0), EDGES, 60.0, 1) == ()
    assert schedule(LoadPlan(), (), 60.0, 1) == ()


@pytest.mark.parametrize("name", list(SCHEMES))
def test_every_scheme_makes_a_valid_fleet_file(tmp_path: Path, scenario: Scenario, name: str) -> None:
    template = tmp_path / "template.yaml"
    from ruamel.yaml import YAML

    with template.open("w") as file:
        YAML().dump(scheme_tree(read_tree(scenario.fleet), SCHEMES[name]), file)
    lab = write_fleet(template, tmp_path / "fleet.yaml", {})
    spec = load_fleet(lab.path).tasks[0]

    assert spec.candidates
    family = SCHEMES[name].family
    if family is Family.OURS:
        tuned = (spec.price_s, spec.memory_s, spec.tuning.bonus)
        assert tuned == (0.3, 1000.0, DEFAULT_BONUS), "the product as it comes"
        assert spec.tuning.score is ScoreForm.SERVICE
    elif family is not Family.FIXED:
        assert spec.price_s == 0.0
        assert spec.tuning.score is ScoreForm.PAPER, "the paper's schemes score as the paper does"
    if SCHEMES[name].weights is not None:
        assert (spec.tuning.weights.cpu, spec.tuning.weights.memory, spec.tuning.weights.network) == SCHEMES[
            name
        ].weights


def test_schemes_are_what_they_say(scenario: Scenario) -> None:
    tree = read_tree(scenario.fleet)

    assert candidates_of(tree, SCHEMES["fixed_e2"]) == ["edge2"]
    assert candidates_of(tree, SCHEMES["first_match"]) == ["edge2", "edge3"]
    assert candidates_of(tree, SCHEMES["dyna_both"]) == list(EDGES)
    ours = scheme_tree(tree, SCHEMES["zsched"])
    assert ours["tasks"]["map_merge"].get("scheduling") == tree["tasks"]["map_merge"].get("scheduling")
    assert ours["timing"] == tree["timing"]
    assert tree == read_tree(scenario.fleet)  # untouched
    assert find_schemes(("zsched",)) == (SCHEMES["zsched"],)
    with pytest.raises(ConfigError, match="nonsense"):
        find_schemes(("nonsense",))


def test_a_fixed_scheme_beyond_the_fleet_is_refused(scenario: Scenario) -> None:
    tree = scheme_tree(read_tree(scenario.fleet), SCHEMES["first_match"])

    with pytest.raises(ConfigError, match="only 2"):
        candidates_of(tree, SCHEMES["fixed_e3"])


def test_the_robots_scenario_is_three_robots_by_the_radio_alone() -> None:
    scenario = load_scenario(robots_scenario_path())
    tree = read_tree(scenario.fleet)

    assert {node["kind"] for node in tree["nodes"].values()} == {"robot"}
    assert sorted(scenario.links) == sorted(tree["nodes"])
    assert tree["tasks"]["map_merge"]["weights"]["network"] == 1.0
    assert scenario.load.lanes == 0
    assert scenario.link_view is LinkView.DIRECT
    task = tree["tasks"]["map_merge"]
    assert scheme_tree(tree, SCHEMES["zsched"])["tasks"]["map_merge"] == {**task, "candidates": sorted(tree["nodes"])}
    assert not {"scheduling", "link"} & set(task), "zsched is the product as it comes"


# --- the radio -------------------------------------------------------------------------------------------------------


def test_a_simulated_drive_is_a_drive_like_a_recorded_one() -> None:
    trace = parse_trace(simulated_drive("1/edge1"), "c_rssi")
    values = list(trace.rssi_dbm)

    assert simulated_drive("1/edge1") == simulated_drive("1/edge1") != simulated_drive("2/edge1")
    assert -95 <= min(values) < -70
    assert -60 < max(values) <= -20
    steps = sorted(abs(b - a) for a, b in zip(values[::5], values[5::5], strict=False))
    assert 3 <= steps[int(0.95 * len(steps))] <= 12  # recorded drives: 6 to 8 dB from second to second


def test_a_recorded_drive_is_taken_where_there_is_one(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(simulated_drive("x"))

    assert drive_file("edge1", Radio(file="a.csv"), tmp_path, tmp_path, 1) == tmp_path / "a.csv"
    with pytest.raises(ConfigError, match=r"b\.csv"):
        drive_file("edge1", Radio(file="b.csv"), tmp_path, tmp_path, 1)
    assert drive_file("edge1", Radio(file="b.csv"), None, tmp_path, 1).read_text() == simulated_drive("1/edge1")


# --- the oracle ------------------------------------------------------------------------------------------------------


def test_a_load_makes_a_node_worse_and_a_stronger_one_not_better() -> None:
    share = NodeShare(cpu_cores=0.45, memory_mb=640)
    slow, full = LoadLevel(share=0.3), LoadLevel(share=0.0)

    free = utility(share, full, 0.45, is_loaded=False)
    assert 0.0 < utility(share, full, 0.45, is_loaded=True) < utility(share, slow, 0.45, is_loaded=True) < free <= 1.0


def test_the_utility_by_hand() -> None:
    one = LoadLevel(streams=1, share=0.6, memory_mb=226.0)
    strong = NodeShare(cpu_cores=0.45, memory_mb=1024, ballast_mb=100.0)
    weak = NodeShare(cpu_cores=0.3, memory_mb=1024)
    large = NodeShare(cpu_cores=0.9, memory_mb=1024)
    three = replace(one, streams=3)

    # 0.45 - 0.15 for the task - 0.6 * 0.45 for the model = 0.03; 1024 - 110 - 100 - 226 = 588 MiB free.
    assert utility(strong, one, 0.45, is_loaded=True) == pytest.approx(0.5 * 0.03 / 0.45 + 0.5 * 588 / 1024)
    # Three of them take 0.54 cores of a whole edge of 0.3: 0.9 - 0.15 - 0.54 = 0.21 are left.
    assert utility(large, three, 0.3, is_loaded=True) == pytest.approx(0.5 * 0.21 / 0.9 + 0.5 * 688 / 1024)
    # The same model leaves the weak one nothing: 0.3 - 0.15 - 0.27 < 0.
    assert utility(weak, one, 0.45, is_loaded=True) == pytest.approx(0.5 * (1024 - 110 - 226) / 1024)
    assert utility(weak, one, 0.45, is_loaded=False) == pytest.approx(0.5 * 0.5 + 0.5 * 914 / 1024)


def test_the_oracle_follows_the_schedule_and_does_not_move_for_nothing(scenario: Scenario) -> None:
    level = scenario.levels[scenario.level]
    windows = (Window(node="edge2", start_s=5.0, end_s=15.0), Window(node="edge1", start_s=8.0, end_s=9.0))

    best = best_nodes(scenario, level, windows)

    assert changes(windows, 42.0) == [0.0, 5.0, 8.0, 9.0, 15.0]
    # At 8 s edge1 is loaded too, at 9 s it is free again, and a little better than edge3 with its filled memory.
    assert best == ((0.0, "edge2"), (5.0, "edge1"), (8.0, "edge3"), (9.0, "edge1"), (15.0, "edge2"))
    assert all(node not in loaded_at(windows, t_s) for t_s, node in best)
    for t_s, node in best:
        scored = utilities(scenario, level, loaded_at(windows, t_s))
        assert scored[node] == max(scored.values())
    assert best_nodes(replace(scenario, nodes={}), level, ()) == ()
