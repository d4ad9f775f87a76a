"""What the driver `container` makes of words, statuses and session files; engines are stand-in programs here."""

from __future__ import annotations

import doctest
import json
import os
from pathlib import Path

import pytest

from zsched.drivers import container
from zsched.drivers.container import Container, look
from zsched.drivers.engine import Look, ask
from zsched.drivers.place import Place

IMAGE = "acme/merge:2"


def test_examples_in_the_module_hold() -> None:
    assert doctest.testmod(container).failed == 0


def place(folder: Path) -> Place:
    session = folder / "edge1-merge.zenoh.json5"
    tls = {"connect_certificate": "/s/a.pem", "connect_private_key": "/s/a.key", "enable_mtls": True}
    session.write_text(json.dumps({"transport": {"link": {"tls": tls}}}))
    told = (("ZSCHED_NODE", "edge1"), ("SECRET", "x y"))
    return Place(fleet="f", node="edge1", task="merge", session=session, variables=told)


def engine(folder: Path, monkeypatch: pytest.MonkeyPatch, script: str, name: str = "podman") -> None:
    """A stand-in for an engine's program, alone in PATH but for a shell's own words."""
    program = folder / "bin" / name
    program.parent.mkdir(exist_ok=True)
    program.write_text(f"#!/bin/sh\n{script}\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(program.parent))


def made(folder: Path, *words: str) -> Container:
    given = container._parser().parse_args([f"--image={IMAGE}", *words])
    return Container(given, place(folder))


def test_no_value_of_a_variable_is_in_the_command_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    engine(tmp_path, monkeypatch, "exit 0")
    command = made(tmp_path, "--option=--gpus=all", "--mount=/data:/d:ro", "--arg=a", "--arg=-b").run()
    text = " ".join(command)
    assert "x y" not in text
    assert "--env ZSCHED_NODE --env SECRET" in text
    session = tmp_path / "edge1-merge.zenoh.json5"
    mounts = f"--volume {session}:{session}:ro --volume /s/a.key:/s/a.key:ro --volume /s/a.pem:/s/a.pem:ro"
    assert f"{mounts} --volume /data:/d:ro --gpus=all {IMAGE} a -b" in text
    assert f"--name zsched-f-edge1-merge-{os.getpid()} --label zsched.worker=f/edge1/merge --pull=never" in text


def test_a_dead_drivers_container_is_removed_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    said = tmp_path / "said"
    gone = f"[ $1 = rm ] && : > {said}.rm; [ $1 = ps ] && [ ! -e {said}.rm ] && echo 12ab"
    engine(tmp_path, monkeypatch, f'echo "$@" >> {said}; {gone}; exit 0')
    assert made(tmp_path).begin(lambda _: None) is None
    assert said.read_text().splitlines() == [
        f"image inspect --format {{{{.Id}}}} {IMAGE}",
        "ps --all --quiet --filter label=zsched.worker=f/edge1/merge",
        "kill --signal=KILL 12ab",
        "rm --force 12ab",
        "ps --all --quiet --filter label=zsched.worker=f/edge1/merge",
    ]


@pytest.mark.parametrize(
    ("script", "expected"),
    [
        (
            f"echo 'Error: {IMAGE}: image not known' >&2; exit 125",
            Look(told=f"the image {IMAGE} is not on this machine", fix=f"podman pull {IMAGE}"),
        ),
        (
            f"echo 'Error: No such image: {IMAGE}' >&2; exit 1",
            Look(told=f"the image {IMAGE} is not on this machine", fix=f"podman pull {IMAGE}"),
        ),
        (
            "echo 'permission denied' >&2; exit 1",
            Look(
                told="podman does not answer: permission denied",
                fix=f"podman image inspect {IMAGE} must work for the daemon's user",
                is_fatal=False,
            ),
        ),
        ("echo sha256:0123456789abcdef", Look(told=f"{IMAGE} is there (podman, 0123456789ab)")),
    ],
)
def test_what_doctor_says_of_an_image(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, script: str, expected: Look
) -> None:
    engine(tmp_path, monkeypatch, script)
    assert look([f"--image={IMAGE}"], "edge1", "merge") == expected


def test_docker_is_taken_where_there_is_no_podman(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    engine(tmp_path, monkeypatch, "echo sha256:0123456789abcdef", name="docker")
    assert look([f"--image={IMAGE}"], "edge1", "merge").told == f"{IMAGE} is there (docker, 0123456789ab)"
    refused = look([f"--image={IMAGE}", "--engine=podman"], "edge1", "merge")
    assert refused == Look(told="there is no podman on this machine", fix="install podman")
    monkeypatch.setenv("PATH", str(tmp_path))
    assert look([f"--image={IMAGE}"], "edge1", "merge").fix == "install podman or docker"


def test_a_folder_to_be_mounted_must_be_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    engine(tmp_path, monkeypatch, "echo sha256:0123456789abcdef")
    gone = tmp_path / "gone"
    assert (
        look([f"--image={IMAGE}", f"--mount={gone}:/x"], "edge1", "merge").told == f"there is no {gone} to be mounted"
    )


def test_words_of_an_engine_that_are_no_utf_8_are_taken_as_far_as_they_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A worker's last line is one of them: the driver ended by it, and a status of 78 counted as a crash."""
    engine(tmp_path, monkeypatch, r"printf 'no camera: gr\374n'; exit 78")
    done = ask("podman", "logs")
    assert (done.returncode, done.stdout) == (78, "no camera: gr\ufffdn")
