"""A container engine of this machine, and an image that a worker can run in without anything being pulled.

The image holds empty folders; this machine's own programs and libraries are mounted into it.
"""

from __future__ import annotations

import io
import os
import resource
import shutil
import subprocess
import sys
import sysconfig
import tarfile
from dataclasses import dataclass
from pathlib import Path

from zsched.core.values.errors import ZschedError

REPO = Path(__file__).parents[3]
SYSTEM = ("/bin", "/lib", "/lib64", "/usr")
EMPTY = ("etc", "tmp", "root", "proc", "sys", "dev", "run")
RUN_S = 60.0
MOST_PROCESSES = 4096


class NoEngineError(ZschedError):
    """No container can be run here; says why."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Host:
    """An engine that works, an image, and what a worker's file says of them."""

    engine: str
    image: str
    mounts: tuple[str, ...]
    options: tuple[str, ...]

    def ask(self, *words: str) -> str:
        """One command of the engine; what it has printed."""
        done = subprocess.run((self.engine, *words), capture_output=True, text=True, timeout=RUN_S, check=False)
        return (done.stdout + done.stderr).strip()

    def containers(self, fleet: str) -> list[str]:
        """The names of a fleet's containers, of those that have ended, too."""
        listed = self.ask("ps", "--all", "--format", "{{.Names}}", "--filter", "label=zsched.worker")
        return sorted(name for name in listed.split() if name.startswith(f"zsched-{fleet}-"))


def container_host() -> Host:
    """What this machine offers.

    Raises:
        NoEngineError: there is no engine, or it runs nothing here.
    """
    engine = next((name for name in ("podman", "docker") if shutil.which(name) is not None), None)
    if engine is None:
        raise NoEngineError("neither podman nor docker is installed")
    image = f"localhost/zsched-test-{os.getpid()}:1"
    archive = io.BytesIO()
    with tarfile.open(fileobj=archive, mode="w") as tar:
        for folder in (*SYSTEM, *EMPTY):
            member = tarfile.TarInfo(folder.lstrip("/"))
            member.type, member.mode = tarfile.DIRTYPE, 0o755
            tar.addfile(member)
    made = subprocess.run(
        (engine, "import", "-", image), input=archive.getvalue(), capture_output=True, timeout=RUN_S, check=False
    )
    if made.returncode != 0:
        raise NoEngineError(f"{engine} takes no image: {made.stderr.decode(errors='replace').strip()[-200:]}")
    python = {str(Path(sys.executable).resolve().parents[1]), sys.base_prefix, sys.prefix}
    folders = {*SYSTEM, *python, str(REPO), sysconfig.get_paths()["purelib"]}
    outermost = [one for one in folders if not any(one != two and Path(one).is_relative_to(two) for two in folders)]
    mounts = tuple(f"{folder}:{folder}:ro" for folder in sorted(outermost) if Path(folder).is_dir())
    said = ""
    for options in ((), _limits()):
        host = Host(engine=engine, image=image, mounts=mounts, options=options)
        words = tuple(word for mount in mounts for word in ("--volume", mount))
        said = host.ask("run", "--rm", "--network=host", *options, *words, image, "/bin/echo", "it runs")
        if said.splitlines()[-1:] == ["it runs"]:
            return host
    subprocess.run((engine, "rmi", image), capture_output=True, timeout=RUN_S, check=False)
    raise NoEngineError(f"{engine} runs nothing here: {said[-200:]}")


def _limits() -> tuple[str, ...]:
    """Limits that this process may set: an engine that may not raise them must not try to."""
    files = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    processes = resource.getrlimit(resource.RLIMIT_NPROC)[1]
    found = {"nofile": files, "nproc": min(processes, MOST_PROCESSES) if processes > 0 else MOST_PROCESSES}
    return tuple(f"--ulimit={name}={limit}:{limit}" for name, limit in found.items())
