"""docs/guide/fleet-file.md says what the schema says, and its examples are real."""

import re
from pathlib import Path

import pytest

from zsched.config.editing import add_entries
from zsched.config.load import check_bytes
from zsched.config.schema import SCHEDULING, reference
from zsched.core.values.fleet import (
    DEFAULT_BONUS,
    DEFAULT_SCORE,
)

GUIDE = Path(__file__).parents[3] / "docs" / "guide"
DOC = (GUIDE / "fleet-file.md").read_text()


def test_reference_is_the_schemas() -> None:
    written = DOC.split("<!-- reference: begin -->\n")[1].split("<!-- reference: end -->")[0]
    assert written == reference(), "paste the output of zsched.config.schema.reference() between the two marks"


def test_defaults_that_hang_on_each_other_are_the_codes() -> None:
    assert SCHEDULING.items["bonus"].default == f"`{DEFAULT_BONUS:g}`"
    assert SCHEDULING.items["score"].default == f"`{DEFAULT_SCORE}`"


def test_the_shown_report_is_what_the_checker_prints() -> None:
    """The two faults of the first example, in the same words and under the same carets."""
    lines = [""] * 20
    lines[12] = "    weights: {cpu: 0.5, memory: 1.5, network: 0.0}"
    lines[15] = "    worker: {command: [python, -m, zsched.tasks.map_merge], standby: warm, standbye: cold}"
    lines[0] = "fleet: f"
    lines[1] = "nodes: {r1: {kind: robot}}"
    lines[9:12] = ["tasks:", "  map_merge:", "    candidates: [r1]"]
    text = "\n".join(lines)
    shown = DOC.split("$ zsched check fleet.yaml\n")[1].split("```")[0].strip("\n")
    result = check_bytes(text.encode(), "fleet.yaml")
    report = "\n".join(fault.render("fleet.yaml") for fault in result.faults)
    assert report == shown


def test_whole_fleet_files_of_the_guide_have_no_fault_and_no_warning() -> None:
    examples = re.findall(r"^```yaml\n(fleet: .*?)^```", DOC, re.MULTILINE | re.DOTALL)
    assert examples
    for text in examples:
        assert check_bytes(text.encode(), "fleet-file.md").report() == ""


LISTEN = "listen: {control: tcp/0.0.0.0:7457, data: tcp/0.0.0.0:7458}"
HALL = f"""
fleet: hall-a
nodes: {{robot1: {{kind: robot}}, edge1: {{kind: edge, host: 192.0.2.11, {LISTEN}}}}}
tasks: {{}}
"""
BLOCKS = [
    pytest.param(text, id=f"{page.name} {number}")
    for page in sorted(GUIDE.glob("*.md"))
    for number, text in enumerate(re.findall(r"^```yaml\n(.*?)^```", page.read_text(), re.MULTILINE | re.DOTALL), 1)
    if "candidates:" in text and not text.startswith("fleet:")
]


@pytest.mark.parametrize("text", BLOCKS)
def test_a_task_of_the_guide_is_taken_as_it_stands(text: str) -> None:
    """By `zsched task add`, and without a fault in a fleet with a robot and an edge."""
    result = check_bytes(add_entries(HALL, "tasks", text).encode())
    assert result.fleet is not None, result.report()
