"""Builds `zsched_VERSION_ARCH.deb`: `make deb`. Needs Python 3.11, pip, dpkg-deb and the index; no root.

    python package/deb/build.py [--arch aarch64] [--python 3.11 ...] [--python-dist FILE] [--out DIR]

Everything that runs comes from wheels, pinned and hashed in `package/requirements.lock`; decision 0068 says why it is
built so. Parts: `Payload` (what goes to /opt/zsched), `furnish` (what the system finds), `control` (what dpkg is told).
"""

from __future__ import annotations

import argparse
import datetime as dt
import gzip
import hashlib
import os
import platform
import re
import shutil
import subprocess
import sys
import tarfile
import zipfile
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from email.utils import formatdate
from pathlib import Path, PurePosixPath

HERE = Path(__file__).parent
REPO = HERE.parents[1]
sys.path.insert(0, str(REPO / "package"))
from wheel import BuildError, FetchError, own_wheel, pip  # noqa: E402 - a script: its neighbours are no package

LOCK = REPO / "package" / "requirements.lock"
PYTHONS = ("3.11", "3.12", "3.13", "3.14")
"""Whose C extensions go in, side by side: Debian 12 and 13, Ubuntu 24.04 and 26.04."""
DEBIAN_ARCH = {"x86_64": "amd64", "aarch64": "arm64"}
GLIBC = (2, 35)
"""Wheels may need at most this glibc: Ubuntu 22.04's, so JetPack 6's."""
HOME = PurePosixPath("opt/zsched")
NOT_NEEDED = ("test", "tests", "idlelib", "tkinter", "turtledemo", "lib2to3", "__pycache__", "pydoc_data")
"""Folders of a private interpreter's library that no robot needs."""
MAINTAINER = "The zsched developers <zsched@example.invalid>"


@dataclass(frozen=True, slots=True, kw_only=True)
class Order:
    """What is to be built."""

    arch: str
    pythons: tuple[str, ...]
    """Minor versions of Python, the private one's alone if there is one."""
    python_dist: Path | None
    out: Path
    work: Path
    compression: str


# --- what goes to /opt/zsched ----------------------------------------------------------------------------------------


def platforms(arch: str) -> Iterator[str]:
    """Tags of wheels that machines of ``arch`` run, newest first."""
    yield from (f"manylinux_{GLIBC[0]}_{minor}_{arch}" for minor in range(GLIBC[1], 16, -1))
    yield f"manylinux2014_{arch}"


def fetched(order: Order, python: str) -> list[Path]:
    """The locked wheels for one version of Python; each one's hash is that of the lock, or pip refuses it."""
    key = hashlib.sha256(LOCK.read_bytes()).hexdigest()[:12]
    folder = order.work / "wheels" / f"{order.arch}-{python}-{key}"
    if not folder.exists():
        part = folder.with_suffix(f".part{os.getpid()}")
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir(parents=True)
        tags = [word for tag in platforms(order.arch) for word in ("--platform", tag)]
        pip(
            *("download", "--quiet", "--no-deps", "--only-binary=:all:", "--require-hashes", "-r", str(LOCK)),
            *("--implementation", "cp", "--python-version", python, *tags, "-d", str(part)),
        )
        for path in part.glob("colorama-*"):  # for Windows: pip reads that marker on this machine, not always rightly
            path.unlink()
        part.rename(folder)
    return sorted(folder.glob("*.whl"))


class Payload:
    """/opt/zsched: laid out as a virtual environment, so that every path of a pip installation is right here, too."""

    def __init__(self, root: Path) -> None:
        self.home = root / HOME
        self.site = self.home / "lib" / "site-packages"
        self.site.mkdir(parents=True)
        self.glibc = (2, 17)

    def unpack(self, wheel: Path) -> None:
        """Put a wheel in. One wheel for two versions of Python may differ in C extensions only, which carry its name.

        Raises:
            BuildError: it differs elsewhere.
        """
        self.glibc = max(self.glibc, glibc_of(wheel.name))
        with zipfile.ZipFile(wheel) as archive:
            for info in archive.infolist():
                if not info.is_dir():
                    self._place(wheel, info, archive.read(info))

    def _place(self, wheel: Path, info: zipfile.ZipInfo, content: bytes) -> None:
        path = PurePosixPath(info.filename)
        if path.is_absolute() or ".." in path.parts:
            raise BuildError(f"{wheel.name}: {path} leads out of its folder")
        target = self.site / path
        if path.parts[0].endswith(".data"):
            if path.parts[1] not in {"data", "purelib", "platlib"}:
                return  # scripts of libraries; ours is written below
            target = (self.home if path.parts[1] == "data" else self.site).joinpath(*path.parts[2:])
        if path.parts[0].endswith(".dist-info") and path.name in {"RECORD", "WHEEL", "INSTALLER"}:
            content = _joined(target, content) if path.name != "INSTALLER" else content
        elif target.exists() and target.read_bytes() != content:
            if path.parts[0].endswith(".dist-info"):
                return  # the first one's SBOM, or notice, stands for all
            raise BuildError(f"{wheel.name}: {path} differs between versions of Python")
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(content)
        when = formatted_time(info)
        os.utime(target, (when, when))  # a relay goes by the library's time (zsched/ipc/takeover.py)

    def finish(self, order: Order) -> None:
        """Make it an environment: the interpreter, the programs."""
        for folder in self.site.glob("*.dist-info"):
            (folder / "INSTALLER").write_text("dpkg\n")
        if order.python_dist is None:
            home, interpreter = "/usr/bin", "/usr/bin/python3"
        else:
            home, interpreter = f"/{HOME}/python/bin", f"../python/bin/python{order.pythons[0]}"
        (self.home / "pyvenv.cfg").write_text(f"home = {home}\ninclude-system-site-packages = true\n")
        for python in order.pythons:
            (self.home / "lib" / f"python{python}").mkdir()
            (self.home / "lib" / f"python{python}" / "site-packages").symlink_to("../site-packages")
        programs = self.home / "bin"
        programs.mkdir()
        for name in ("python", "python3"):
            (programs / name).symlink_to(interpreter)
        (programs / "zsched").write_text(
            f"#!/{HOME}/bin/python\nimport sys\n\nfrom zsched.__main__ import main\n\nsys.exit(main())\n"
        )
        (self.home / "share/zsched/schemas").symlink_to("../../lib/site-packages/zsched/schemas")


def _joined(target: Path, content: bytes) -> bytes:
    """The lines of both, each one once: a wheel's list of files, or of its tags."""
    if not target.exists():
        return content
    lines = target.read_text().splitlines()
    more = [line for line in content.decode().splitlines() if line not in lines]
    return ("\n".join([*lines, *more]) + "\n").encode()


def formatted_time(info: zipfile.ZipInfo) -> float:
    """The time of a file in a wheel, as seconds since 1970."""
    year, month, day, hour, minute, second = info.date_time
    return dt.datetime(year, month, day, hour, minute, second, tzinfo=dt.UTC).timestamp()


def glibc_of(wheel: str) -> tuple[int, int]:
    """The oldest glibc that a wheel runs with, by its name.

    >>> glibc_of("a-1-cp311-abi3-manylinux2014_x86_64.manylinux_2_28_x86_64.whl")
    (2, 17)
    >>> glibc_of("a-1-py3-none-any.whl")
    (2, 17)
    """
    found = [(int(a), int(b)) for a, b in re.findall(r"manylinux_(\d+)_(\d+)_", wheel)]
    found += [(2, 17)] if "manylinux2014" in wheel or not found else []
    return max((2, 17), min(found))


def dist_python(file: Path) -> str:
    """The minor version of Python that a tarball with ``python/bin/python3.x`` has. Raises `BuildError`."""
    try:
        with tarfile.open(file) as archive:
            found = {match[1] for name in archive.getnames() if (match := _INTERPRETER.fullmatch(name))}
    except (OSError, tarfile.TarError) as error:
        raise BuildError(f"{file}: no tarball of Python: {error}; take one of python-build-standalone") from error
    if len(found) != 1:
        raise BuildError(
            f"{file}: no python/bin/python3.x in it; take an 'install_only' one of python-build-standalone"
        )
    minor = found.pop()
    if minor not in PYTHONS:
        raise BuildError(f"{file}: it has Python {minor}; zsched is packed for {', '.join(PYTHONS)}")
    return minor


_INTERPRETER = re.compile(r"(?:\./)?python/bin/python(3\.\d+)")


def private_python(file: Path, minor: str, home: Path) -> None:
    """Unpack the interpreter to ``home/python``, without what no robot needs."""
    with tarfile.open(file) as archive:
        archive.extractall(home, filter="tar")
    python = home / "python"
    for name in ("include", "share"):
        shutil.rmtree(python / name, ignore_errors=True)
    for path in [*python.glob("lib/*.a"), *python.glob("lib/pkgconfig"), *python.glob("lib/t[ck]*[0-9]*")]:
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    library = python / "lib" / f"python{minor}"
    for path in [*library.rglob("*.a"), *library.glob(f"config-{minor}-*")]:
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    for folder in sorted(library.rglob("*")):
        if folder.is_dir() and folder.name in NOT_NEEDED:
            shutil.rmtree(folder)


# --- what the system finds -------------------------------------------------------------------------------------------


def furnish(root: Path, home: Path, version: str, when: int) -> None:
    """Put units, the user, completion, manual pages and documents where Debian has them."""
    share, commands = home / "share", home / "lib/site-packages/zsched/commands/completions"
    copies = {
        "usr/lib/systemd/system": [
            file for kind in ("service", "socket", "timer") for file in share.glob(f"zsched/*.{kind}")
        ],
        "usr/lib/systemd/system/zsched.service.d": [share / "zsched/zsched.service.d/10-user.conf"],
        "usr/lib/systemd/system/zsched-relay.service.d": [share / "zsched/zsched-relay.service.d/10-user.conf"],
        "usr/lib/systemd/system/zsched-web.service.d": [share / "zsched/zsched-web.service.d/10-user.conf"],
        "usr/share/bash-completion/completions": [commands / "zsched"],
        "usr/share/zsh/vendor-completions": [commands / "_zsched"],
        "usr/share/fish/vendor_completions.d": [commands / "zsched.fish"],
        "usr/share/lintian/overrides": [HERE / "lintian-overrides"],
    }
    for folder, files in copies.items():
        (root / folder).mkdir(parents=True)
        for file in files:
            shutil.copy(file, root / folder / ("zsched" if file.parent == HERE else file.name))
    (root / "usr/lib/sysusers.d").mkdir(parents=True)
    shutil.copy(share / "zsched/zsched.sysusers", root / "usr/lib/sysusers.d/zsched.conf")
    (root / "usr/share/man/man1").mkdir(parents=True)
    for page in sorted((share / "man/man1").iterdir()):
        _zip(root / "usr/share/man/man1" / f"{page.name}.gz", page.read_bytes())
    shutil.rmtree(share / "man")
    documents = root / "usr/share/doc/zsched"
    documents.mkdir(parents=True)
    (documents / "guide").symlink_to(f"/{HOME}/share/doc/zsched")
    shutil.copy(HERE / "copyright", documents / "copyright")
    entry = f"zsched ({version}) stable; urgency=medium\n\n  * See /{HOME}/share/doc/zsched/CHANGELOG.md.\n\n"
    _zip(documents / "changelog.gz", f"{entry} -- {MAINTAINER}  {formatdate(when)}\n".encode())
    (root / "usr/bin").mkdir(parents=True)
    (root / "usr/bin/zsched").symlink_to(f"/{HOME}/bin/zsched")
    (root / "etc/zsched").mkdir(parents=True)


def _zip(path: Path, content: bytes) -> None:
    path.write_bytes(gzip.compress(content, 9, mtime=0))


# --- what dpkg is told -----------------------------------------------------------------------------------------------


def debian_version(version: str) -> str:
    """A version as Debian sorts it: what comes before a release is before it.

    >>> debian_version("0.2.dev3+g12ab"), debian_version("1.0rc1"), debian_version("1.0")
    ('0.2~dev3+g12ab', '1.0~rc1', '1.0')
    """
    return re.sub(r"\.?(dev|a|b|rc)(\d+)", r"~\1\2", version, count=1)


def control(order: Order, version: str, glibc: tuple[int, int], installed_kb: int) -> str:
    """The text of DEBIAN/control."""
    depends = [f"libc6 (>= {glibc[0]}.{glibc[1]})", "passwd"]
    if order.python_dist is None:
        minors = sorted(int(python.partition(".")[2]) for python in order.pythons)
        depends += [f"python3 (>= 3.{minors[0]})", f"python3 (<< 3.{minors[-1] + 1})"]
    return f"""Package: zsched
Version: {version}
Architecture: {DEBIAN_ARCH[order.arch]}
Maintainer: {MAINTAINER}
Installed-Size: {installed_kb}
Depends: {", ".join(depends)}
Recommends: systemd
Suggests: python3-numpy, python3-opencv
Section: net
Priority: optional
Description: masterless scheduling of shared robot tasks over zenoh
 Several robots share one heavy task. zsched decides which machine runs it,
 moves it when that machine gets busy, loses its radio link or dies, and
 reroutes the task's streams while they flow. Every robot and every edge
 computer runs one daemon; there is no master and no broker.
"""


def tidy(root: Path, latest: int) -> None:
    """Modes as Debian wants them, and no time later than that of the sources, so that two builds are the same."""
    for path in sorted(root.rglob("*")):
        if path.is_symlink():
            os.utime(path, (latest, latest), follow_symlinks=False)
            continue
        is_program = path.is_file() and (path.parent.name == "bin" or "DEBIAN" in path.parts) and _runs(path)
        path.chmod(0o755 if path.is_dir() or is_program else 0o644)
        if path.is_dir() or path.stat().st_mtime > latest:
            os.utime(path, (latest, latest))


def _runs(path: Path) -> bool:
    with path.open("rb") as file:
        return file.read(2) == b"#!" or path.parent.name == "bin"


def source_time() -> int:
    """``SOURCE_DATE_EPOCH``, else the time of the last commit, else 2026-01-01."""
    if os.environ.get("SOURCE_DATE_EPOCH"):
        return int(os.environ["SOURCE_DATE_EPOCH"])
    done = subprocess.run(
        ["git", "-C", str(REPO), "log", "-1", "--format=%ct"], capture_output=True, text=True, timeout=60, check=False
    )
    return int(done.stdout) if done.returncode == 0 and done.stdout.strip() else 1767225600


def build(order: Order, wheel: Path | None = None) -> Path:
    """Build the package; answers its file. ``wheel``: zsched's own, where it is built already.

    Raises:
        BuildError: it cannot be built.
    """
    if shutil.which("dpkg-deb") is None:
        raise BuildError("dpkg-deb is missing: build on Debian or Ubuntu (it is in every one of them)")
    when = source_time()
    os.environ["SOURCE_DATE_EPOCH"] = str(when)
    root = order.work / f"tree-{os.getpid()}"
    shutil.rmtree(root, ignore_errors=True)
    own = wheel or own_wheel(order.work / f"own-{os.getpid()}")
    pep440 = own.name.split("-")[1]
    payload = Payload(root)
    for python in order.pythons:
        for one in fetched(order, python):
            payload.unpack(one)
    payload.unpack(own)
    if order.python_dist is not None:
        private_python(order.python_dist, order.pythons[0], payload.home)
    payload.finish(order)
    version = debian_version(pep440) + ("" if order.python_dist is None else f"+py{order.pythons[0]}")
    furnish(root, payload.home, version, when)
    meta = root / "DEBIAN"
    meta.mkdir()
    for name in ("preinst", "postinst", "prerm", "postrm"):
        shutil.copy(HERE / name, meta / name)
    files = [
        path
        for path in sorted(root.rglob("*"))
        if path.is_file() and not path.is_symlink() and meta not in path.parents
    ]
    (meta / "md5sums").write_text("".join(_sums(root, files)))
    kilobytes = sum((path.stat().st_size + 1023) // 1024 for path in files)
    (meta / "control").write_text(control(order, version, payload.glibc, kilobytes))
    tidy(root, when)
    order.out.mkdir(parents=True, exist_ok=True)
    target = order.out / f"zsched_{version}_{DEBIAN_ARCH[order.arch]}.deb"
    command = ["dpkg-deb", "--root-owner-group", *order.compression.split(), "--build", str(root), str(target)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=900, check=False)
    if done.returncode != 0:
        raise BuildError(f"dpkg-deb failed: {done.stderr.strip()}")
    for folder in (root, order.work / f"own-{os.getpid()}"):
        shutil.rmtree(folder, ignore_errors=True)
    return target


def _sums(root: Path, files: Iterable[Path]) -> Iterator[str]:
    for path in files:
        digest = hashlib.md5(path.read_bytes(), usedforsecurity=False).hexdigest()
        yield f"{digest}  {path.relative_to(root)}\n"


def main(arguments: list[str] | None = None) -> int:
    """Build what the command line says."""
    parser = argparse.ArgumentParser(prog="build.py", description="Build zsched's Debian package.")
    parser.add_argument("--arch", choices=sorted(DEBIAN_ARCH), default=platform.machine())
    parser.add_argument("--python", action="append", choices=PYTHONS, help="only for these (again and again)")
    parser.add_argument("--python-dist", type=Path, help="a tarball of python-build-standalone, which goes in")
    parser.add_argument("--wheel", type=Path, help="zsched's own wheel, instead of building it")
    parser.add_argument("--out", type=Path, default=REPO / "dist")
    parser.add_argument("--work", type=Path, default=REPO / "build" / "deb", help="where wheels are kept")
    parser.add_argument("--compression", default="-Zxz", help="for dpkg-deb")
    parser.add_argument("--fetch", action="store_true", help="only fetch the wheels")
    given = parser.parse_args(arguments)
    try:
        pythons = (dist_python(given.python_dist),) if given.python_dist else tuple(given.python or PYTHONS)
        order = Order(
            arch=given.arch,
            pythons=pythons,
            python_dist=given.python_dist,
            out=given.out,
            work=given.work,
            compression=given.compression,
        )
        if given.fetch:
            for python in pythons:
                fetched(order, python)
            return 0
        target = build(order, given.wheel)
    except BuildError as error:
        print(f"deb: {error}", file=sys.stderr)
        return 3 if isinstance(error, FetchError) else 1
    print(f"{target} ({target.stat().st_size / 1e6:.1f} MB)")
    return 0


if __name__ == "__main__":
    sys.exit(main())
