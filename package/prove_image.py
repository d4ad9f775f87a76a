"""The container image, tried: built on a base made of the cached Debian (there may be no registry), run, stopped."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from proof import FailedError, SkippedError, run
from wheel import own_wheel

from support.debian import NoDebianError, debian_root
from zsched_lab.fleet.containers import Host, NoEngineError, container_host
from zsched_lab.fleet.loopback import free_endpoints

REPO = Path(__file__).parents[1]
BASE, IMAGE = "localhost/zsched-prove-base", "localhost/zsched-prove"
USER = 7457
READY_S = 60.0
FLEET = """
fleet: image
timing: wired
nodes:
  edge1: {kind: robot, wired: true, host: 127.0.0.1, listen: {control: CONTROL, data: DATA}}
tasks:
  echo:
    candidates: [edge1]
    weights: {cpu: 1}
    worker: {command: [python, -m, zsched.tasks.echo]}
    inputs: [{from: "{robot}/in", to: "{target}/echo/{robot}/in"}]
    outputs: [{from: "{target}/echo/{epoch}/{robot}/out", to: "{robot}/out"}]
"""


def as_image(folder: Path) -> None:
    """Build the image, run a node of it, ask it, stop it.

    Raises:
        SkippedError: no container can be run, or no base be made.
        FailedError: something is not as it should be.
    """
    if shutil.which("podman") is None:
        raise SkippedError("podman is not installed")
    try:
        debian, host = debian_root(), container_host()
    except (NoDebianError, NoEngineError) as error:
        raise SkippedError(str(error)) from error
    host.ask("rmi", "--force", host.image)
    try:
        build(folder, debian, host)
        live(Path(tempfile.mkdtemp(prefix="zsched-image-", dir=folder)), host)
    finally:
        podman("rmi", "--force", IMAGE, BASE)


def build(folder: Path, debian: Path, host: Host) -> None:
    """By the Containerfile, from a base with the cached Debian's python3."""
    archive = folder / "base.tar"
    run("tar", "-C", str(debian), "--exclude=./proc", "--exclude=./sys", "--exclude=./dev", "-cf", str(archive), ".")
    run("podman", "import", str(archive), BASE)
    archive.unlink()
    shutil.rmtree(REPO / "dist", ignore_errors=True)
    own_wheel(REPO / "dist")
    settings = pip_settings()
    pip = [word for key, value in settings.items() for word in ("--env", f"{key}={value}")]
    words = [word for value in settings.values() for word in value.replace("file://", "").split()]
    places = {word.removesuffix("/simple") for word in words if Path(word).exists()}
    mounts = [word for path in sorted(places) for word in ("--volume", f"{path}:{path}:ro")]
    command = ["podman", "build", "--network=host", *host.options, *pip, *mounts, "--build-arg", f"BASE={BASE}"]
    run(*command, "-f", str(REPO / "package/Containerfile"), "-t", IMAGE, str(REPO))
    whole, base = (int(run("podman", "image", "inspect", "--format", "{{.Size}}", name)) for name in (IMAGE, BASE))
    print(f"  {whole / 2**20:.0f} MiB, of which the base {base / 2**20:.0f} MiB")


def live(folder: Path, host: Host) -> None:
    """One node in a container: it becomes an owner, and hands over in order when it is stopped."""
    name = f"zsched-prove-{os.getpid()}"
    for part in ("etc", "state", "run"):
        (folder / part).mkdir(mode=0o755)
    control, data = free_endpoints(2)
    (folder / "etc/fleet.yaml").write_text(FLEET.replace("CONTROL", control).replace("DATA", data))
    for part in ("state", "run"):
        os.chown(folder / part, USER, USER)
    folder.chmod(0o755)
    inside = {"etc": "/etc/zsched:ro", "state": "/var/lib/zsched", "run": "/run/zsched"}
    volumes = [f"--volume={folder / part}:{place}" for part, place in inside.items()]
    command = ["podman", "run", "--network=host", *host.options, *volumes]
    try:
        run(*command, "--rm", IMAGE, "init", "--node", "edge1")
        run(*command, "-d", "--name", name, IMAGE, "up", "--node", "edge1")
        print(f"  {settled(name)}")
        users = re.search(r"^Uid:\s+(\d+)", podman("exec", name, "cat", "/proc/1/status"), re.MULTILINE)
        if users is None or int(users[1]) != USER:
            raise FailedError(f"it does not run as the user {USER}: {users}")
        began = time.monotonic()
        run("podman", "stop", "--time", "30", name)
        code = run("podman", "inspect", "--format", "{{.State.ExitCode}}", name).strip()
        print(f"  stopped in {time.monotonic() - began:.1f} s with {code}")
        if code != "0":
            raise FailedError(f"it ended with {code}:\n{podman('logs', name)[-2000:]}")
    finally:
        podman("rm", "--force", name)


def settled(name: str) -> str:
    """Wait until the task has an owner; the first line of `zsched status`. Raises `FailedError`."""
    until = time.monotonic() + READY_S
    while '"settled"' not in podman("exec", name, "/opt/zsched/bin/zsched", "status", "--json"):
        if time.monotonic() > until:
            raise FailedError(f"no owner within {READY_S:.0f} s:\n{podman('logs', name)[-3000:]}")
        time.sleep(0.5)
    return podman("exec", name, "/opt/zsched/bin/zsched", "status").splitlines()[0]


def podman(*words: str) -> str:
    """What podman says, whatever comes of it."""
    done = subprocess.run(["podman", *words], capture_output=True, text=True, timeout=120, check=False)
    return done.stdout + done.stderr


def pip_settings() -> dict[str, str]:
    """How pip reaches its index here: a container has to reach it by the same way."""
    listed = run(sys.executable, "-m", "pip", "config", "list").splitlines()
    found = dict(line.replace(":env:.", "global.").partition("=")[::2] for line in listed)
    wanted = ("index-url", "extra-index-url", "cert", "proxy", "trusted-host", "find-links")
    return {
        f"PIP_{key.upper().replace('-', '_')}": found[f"global.{key}"].strip("'")
        for key in wanted
        if f"global.{key}" in found
    }
