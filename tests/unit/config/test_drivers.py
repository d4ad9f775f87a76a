"""A worker's `driver:` becomes the command of that driver's program; a key of another driver is a fault."""

from __future__ import annotations

import pytest

from zsched.config.load import CheckResult, check_bytes
from zsched.core.values.fleet import WorkerSpec

FILE = """\
fleet: f
nodes:
  robot1: {kind: robot, wired: true, host: h, listen: {control: tcp/0.0.0.0:1, data: tcp/0.0.0.0:2}}
  edge1: {kind: edge}
tasks:
  shout:
    candidates: {kind: edge}
    weights: {cpu: 1}
    worker: WORKER
    inputs: [{from: "{robot}/a", to: "{target}/{robot}/a"}]
"""


def check(worker: str) -> CheckResult:
    return check_bytes(FILE.replace("WORKER", worker).encode())


def worker_of(text: str) -> WorkerSpec:
    result = check(text)
    assert result.fleet is not None, result.report()
    return result.fleet.tasks[0].worker


def test_an_image_with_its_words_is_a_command_of_the_drivers_program() -> None:
    mounts, options = "['/data:/data:ro', /m:/n]", "[--gpus=all, --device=/dev/video0]"
    worker = worker_of(
        f"{{driver: container, image: 'acme/merge:2', args: [a, -b], mounts: {mounts}, options: {options}}}"
    )
    assert worker.command == (
        *(
            "python",
            "-m",
            "zsched.drivers.container",
            "--image=acme/merge:2",
            "--mount=/data:/data:ro",
            "--mount=/m:/n",
        ),
        *("--option=--gpus=all", "--option=--device=/dev/video0", "--arg=a", "--arg=-b"),
    )
    named = worker_of("{driver: container, image: a, engine: docker, env: {A: b}}").command
    assert named[3:] == ("--image=a", "--engine=docker", "--env", "A")


@pytest.mark.parametrize(
    ("worker", "said", "column"),
    [
        ("{driver: systemd}", "driver systemd needs the key 'unit'", 22),
        ("{driver: systemd, unit: a.service, command: [a]}", "driver systemd has no 'command'", 57),
        ("{unit: a.service}", "driver process has no 'unit'", 20),
        ("{driver: systemd, unit: a.socket}", "'a.socket' is not a systemd service: NAME.service", 37),
        ("{driver: systemd, unit: '../a.service'}", "is not a systemd service", 37),
        ("{driver: systemd, unit: '@.service'}", "is not a systemd service", 37),
        ("{driver: systemd, unit: '-f.service'}", "is not a systemd service", 37),
        ("{driver: container}", "driver container needs the key 'image'", 22),
        ("{driver: container, image: a, command: [b]}", "hint: what the container runs is `args`", 52),
        ("{driver: container, image: a, unit: a.service}", "driver container has no 'unit'", 49),
        ("{command: [a], mounts: [/a:/b]}", "driver process has no 'mounts'", 36),
        ("{driver: container, image: -a}", "'-a' is not an image", 40),
        ("{driver: container, image: a, mounts: [a:/b]}", "'a:/b' is not a mount", 52),
        ("{driver: container, image: a, options: [-v /a]}", "'-v /a' is not an option: one word", 53),
        ("{driver: container, image: a, engine: lxc}", "`podman` or `docker`", 51),
        ("{driver: systemd, unit: a.service, user: ros}", "hint: the unit has a `User=`", 54),
        ("{driver: container, image: a, user: ros}", "driver container has no 'user'", 49),
        ("{user: ros}", "it has no `command`", 20),
        ("{command: [a], user: Root}", "'Root' is not a user of the machine", 34),
        ("{driver: sysd, unit: a.service}", "did you mean 'systemd'?", 22),
    ],
)
def test_a_fault_stands_at_its_key(worker: str, said: str, column: int) -> None:
    result = check(worker)
    assert result.fleet is None
    report = result.report()
    assert said in report
    assert f"fleet.yaml:9:{column}: error" in report, report


@pytest.mark.parametrize("engine", ["docker", "podman"])
def test_an_engine_in_place_of_a_driver_is_one_fault_with_the_word_to_write(engine: str) -> None:
    faults = check(f"{{driver: {engine}, image: a}}").faults
    assert [fault.hint for fault in faults] == ["did you mean 'container'?"]


def test_a_managed_node_in_a_secured_fleet_is_refused_where_it_is_named() -> None:
    worker = "{driver: ros2_lifecycle, node: '/{target}/slam', command: [slam], ready: matching}"
    assert worker_of(worker).command[:3] == ("python", "-m", "zsched.drivers.ros2_lifecycle")
    secured = FILE.replace("WORKER", worker).replace("tcp/", "tls/") + "security: {}\n"
    (fault,) = check_bytes(secured.encode()).faults
    assert "managed node" in fault.message
    assert "driver: ros2_lifecycle" in fault.source_line
    other = secured.replace(worker, "{driver: systemd, unit: shout@.service}")
    assert check_bytes(other.encode()).faults == ()
