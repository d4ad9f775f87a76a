"""`zsched install` and `zsched uninstall`: what a machine's system finds of a pip installation, and takes away again.

Knows: where systemd, the shells and man look, what of it is ours. Does not know: what the units do, the fleet
(`zsched uninstall` leaves it and the state, and says which node this machine still is). The Debian package brings the
same to other places (`package/deb/build.py`).
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Final

import typer

from zsched.commands.base.common import CliError, say
from zsched.commands.base.options import PlanOption
from zsched.commands.base.renewing import TIMER, UNIT_FOLDER
from zsched.commands.completion import SCRIPTS, script_file
from zsched.commands.members.belongings import whose
from zsched.core.values.errors import AdapterError
from zsched.core.values.exits import EXIT_FAILED, EXIT_OK, EXIT_WOULD_CHANGE
from zsched.core.values.struct import Struct
from zsched.host.installer import is_debian_package
from zsched.host.paths import authority_folders, is_there
from zsched.host.state_file import STATE_NAME

UNITS: Final = (
    "zsched.service",
    "zsched-relay.service",
    "zsched-web.service",
    "zsched-renew.service",
    "zsched-renew.timer",
    "zsched-worker@.service",
    "zsched-worker@.socket",
)
DROP_INS: Final = tuple(f"{unit}.service.d/10-user.conf" for unit in ("zsched", "zsched-relay", "zsched-web"))
MOST_LINKS: Final = 40
"""As the kernel follows."""
OPT: Final = "/opt/zsched"
"""The installation that the units as shipped are for."""
USERS: Final = ("zsched", "zsched-worker")
"""The daemon's, and its workers'."""
MANUAL: Final = "man/man1"
OLD_PAGE: Final = "manual page of a verb that this version has not"
HIDDEN: Final = ("/home", "/root", "/tmp", "/var/tmp", "/run/user")  # noqa: S108 - what the unit hides from the service
COMPLETIONS: Final = {
    "bash": "usr/local/share/bash-completion/completions",
    "zsh": "usr/local/share/zsh/site-functions",
    "fish": "usr/local/share/fish/vendor_completions.d",
}
SYSTEM_FOLDERS: Final = (
    ".",
    "etc",
    "etc/systemd",
    "etc/systemd/system",
    "usr/local/bin",
    "usr/local/share",
    "usr/local/share/man",
)
"""Folders that are not ours, empty or not."""
TOOL_S: Final = 60.0


class Piece(Struct, frozen=True, kw_only=True):
    """One file that the system finds: a text, or a link into the installation."""

    path: Path
    what: str
    text: str = ""
    target: Path | None = None

    def is_there(self) -> bool:
        """Whether it is as we would make it."""
        if self.target is not None:
            return self.path.is_symlink() and self.path.readlink() == self.target
        return self.path.is_file() and not self.path.is_symlink() and _read(self.path) == self.text

    def is_ours(self) -> bool:
        """Whether we made it, of this version or another: a link into the installation, or a unit that starts it."""
        if self.path.is_symlink():
            leads_to = self.path.readlink()
            return self.target is not None and (leads_to == self.target or leads_to.is_relative_to(sys.prefix))
        return self.path.is_file() and self.target is None and _first_line(self.path) == self.text.split("\n", 1)[0]

    def is_in_the_way(self) -> bool:
        """Whether something else has this name."""
        return (self.path.exists() or self.path.is_symlink()) and not self.is_ours()

    def make(self) -> None:
        """Write it; what stood there is replaced at once, or not at all."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        part = self.path.with_name(f".{self.path.name}.{os.getpid()}")
        try:
            if self.target is not None:
                part.symlink_to(self.target)
            else:
                part.write_text(self.text, encoding="utf-8")
                part.chmod(0o644)
            part.replace(self.path)
        except OSError:
            part.unlink(missing_ok=True)
            raise


def install(plan: PlanOption = False, root: RootOption = Path("/")) -> int:
    """Let the system find a zsched that pip installed: units, the user, completion, manual pages, the program.

    Example: sudo /opt/zsched/bin/zsched install

    It links or copies, says each step, and starts and enables nothing. Once more, it renews what is old.
    """
    root = root.absolute()
    prefix = Path(sys.prefix)
    _check(prefix, root)
    pieces = list(_pieces(prefix, root))
    if blocked := [piece.path for piece in pieces if piece.is_in_the_way()]:
        raise CliError(
            EXIT_FAILED,
            f"{blocked[0]}: is there and not zsched's{_and_others(len(blocked))}; move it away. Nothing was written",
        )
    missing = [piece for piece in pieces if not piece.is_there()]
    old = _old_pages(prefix, root, pieces)
    needs_users = _is_this_machine(root) and not _has_users(*USERS)
    if plan:
        _tell("would make ", ((piece.path, piece.what) for piece in missing))
        _tell("would remove ", ((path, OLD_PAGE) for path in old))
        _print([f"would make the users {', '.join(USERS)}"] if needs_users else [])
        return EXIT_WOULD_CHANGE if missing or old or needs_users else EXIT_OK
    _need_rights(root)
    for piece in missing:
        _carefully(piece.path, piece.make)
    for path in old:
        _carefully(path, path.unlink)
    _tell("", ((piece.path, piece.what) for piece in missing))
    _tell("removed ", ((path, OLD_PAGE) for path in old))
    if needs_users:
        _make_user(root)
        _print([f"users {', '.join(USERS)}: members of the group {USERS[0]} may ask the daemon and give orders"])
    _reload(root)
    if not missing and not old and not needs_users:
        _print(["everything is there already"])
    _print([f"next: {_next(root)}"])
    return EXIT_OK


def uninstall(plan: PlanOption = False, root: RootOption = Path("/")) -> int:
    """Stop the services and take away what `zsched install` made. Fleet file, state and the program stay.

    Example: sudo zsched uninstall
    """
    root = root.absolute()
    prefix = Path(sys.prefix)
    _check(prefix, root)
    pieces = list(_pieces(prefix, root))
    pieces += [Piece(path=path, what=OLD_PAGE, target=path.readlink()) for path in _old_pages(prefix, root, pieces)]
    ours = [piece for piece in pieces if piece.is_ours()]
    stays = [f"{piece.path}: not zsched's" for piece in pieces if piece.is_in_the_way()]
    stays += [f"{path}: a drop-in that zsched has not made" for path in _other_drop_ins(root, pieces)]
    kept = [Path("/etc/zsched"), Path("/var/lib/zsched"), Path("/var/lib/zsched-workers"), prefix]
    if plan:
        _print(_still_a_node(root / "var/lib/zsched", is_gone=False))
        _print(["would stop and disable the services"] if any(one.path.name in UNITS for one in ours) else [])
        _tell("would remove ", ((piece.path, piece.what) for piece in ours))
        _print(f"would leave {one}" for one in stays)
        _print(left(kept, os.environ) if _is_this_machine(root) else [])
        return EXIT_WOULD_CHANGE if ours else EXIT_OK
    _need_rights(root)
    _print(_still_a_node(root / "var/lib/zsched", is_gone=True))
    if _has_systemd(root):
        found = [piece.path.name for piece in ours if piece.path.name in UNITS]
        if found:
            _tool("systemctl", "disable", "--quiet", *found)
            _tool("systemctl", "stop", *(name.replace("@", "@*") for name in found))
    for piece in ours:
        _carefully(piece.path, piece.path.unlink)
    _tell("removed ", ((piece.path, piece.what) for piece in ours))
    for folder in {piece.path.parent for piece in ours}:
        _remove_empty(folder, root)
    _print(f"left {one}" for one in stays)
    _reload(root)
    _print(["nothing of it was there"] if not ours else [])
    _print(left(kept, os.environ) if _is_this_machine(root) else [])
    return EXIT_OK


def _still_a_node(state: Path, *, is_gone: bool) -> list[str]:
    """That a fleet counts on this machine, by its state folder; ``is_gone``: it cannot leave from here any more."""
    if not is_there(state / STATE_NAME):
        return []
    try:
        fleet, me = whose(state)
    except AdapterError as error:
        return [f"nobody knows whether this machine is still a node of a fleet: {error}"]
    leaves = "" if is_gone else "`sudo zsched leave` first, or "
    return [f"still {me} of fleet {fleet}, which counts on it: {leaves}elsewhere `zsched node forget {me}`"]


def _other_drop_ins(root: Path, pieces: Iterable[Piece]) -> list[Path]:
    """What operators have written for our units (`systemctl edit`)."""
    known = {piece.path for piece in pieces}
    found = (sorted((root / "etc/systemd/system" / f"{unit}.d").glob("*.conf")) for unit in UNITS)
    return [path for paths in found for path in paths if path not in known]


def left(folders: Iterable[Path], env: Mapping[str, str]) -> list[str]:
    """What an uninstallation leaves behind, of these folders and of this user's authorities, as it is told."""
    kept = ", ".join([str(path) for path in folders if path.exists()])
    said = (
        [f"what is left: {kept}, and the users {', '.join(USERS)}; docs/guide/install.md says how it goes, too"]
        if kept
        else []
    )
    return said + [
        f"what is left: {folder}, the authority of fleet {folder.name}; without its key nobody joins that fleet, and "
        f"no certificate is renewed, so keep it as long as that fleet runs. {TIMER}, which renews them from here, goes "
        f"with the program: move the folder to {UNIT_FOLDER / folder.name} on another node, and enable {TIMER} there"
        for folder in authority_folders(env)
    ]


def _check(prefix: Path, root: Path) -> None:
    """Raise `CliError` where the service could not run from here, or somebody else looks after these files."""
    if is_debian_package():
        raise CliError(EXIT_FAILED, "this zsched is a Debian package, which has done all that; apt removes it")
    if not (prefix / "share/zsched/zsched.service").is_file():
        raise CliError(
            EXIT_FAILED,
            f"{prefix}/share/zsched: no units there, so this is no installation (an editable one?); "
            f"sudo python3 -m venv {OPT} && sudo {OPT}/bin/pip install . makes one",
        )
    hidden = next((place for place in HIDDEN if prefix.is_relative_to(place)), None)
    if hidden is not None and _is_this_machine(root):
        raise CliError(
            EXIT_FAILED, f"{prefix}: the service cannot see {hidden} (ProtectHome, PrivateTmp); install zsched to {OPT}"
        )
    link = next((link for link in _ways_to(prefix / "bin/python") if any(map(link.is_relative_to, HIDDEN))), None)
    if link is not None and _is_this_machine(root):
        raise CliError(
            EXIT_FAILED,
            f"{prefix}: its Python is {link}, which the service cannot see (ProtectHome, PrivateTmp); "
            f"make {prefix} anew with a Python by its own path: sudo {link.resolve()} -m venv --clear {prefix}",
        )


def _ways_to(link: Path) -> Iterator[Path]:
    """Where a link leads, step by step."""
    for _ in range(MOST_LINKS):
        if not link.is_symlink():
            return
        link = link.parent / link.readlink()
        yield link


def _pieces(prefix: Path, root: Path) -> Iterator[Piece]:
    share = prefix / "share"
    for unit in (*UNITS, *DROP_INS):
        text = _read(share / "zsched" / unit).replace(OPT, str(prefix))
        yield Piece(path=root / "etc/systemd/system" / unit, what=f"unit of {prefix}", text=text)
    users = _read(share / "zsched/zsched.sysusers")
    yield Piece(path=root / "etc/sysusers.d/zsched.conf", what="the users of daemon and workers", text=users)
    yield Piece(path=root / "usr/local/bin/zsched", what="the program", target=prefix / "bin/zsched")
    for shell, folder in COMPLETIONS.items():
        path = root / folder / SCRIPTS[shell]
        yield Piece(path=path, what=f"completion in {shell}", target=script_file(shell))
    for page in sorted((share / MANUAL).glob("*.1")):
        yield Piece(path=root / "usr/local/share" / MANUAL / page.name, what="manual page", target=page)


def _old_pages(prefix: Path, root: Path, pieces: Iterable[Piece]) -> list[Path]:
    """Links to pages of this installation that its version no longer has: of a verb that an older one had."""
    links = sorted((root / "usr/local/share" / MANUAL).glob("*.1"))
    known, pages = {piece.path for piece in pieces}, prefix / "share" / MANUAL
    return [link for link in links if link not in known and link.is_symlink() and link.readlink().parent == pages]


def _next(root: Path) -> str:
    if not _is_this_machine(root):
        return f"take {root} where it belongs"
    if not Path("/etc/zsched/fleet.yaml").exists():
        return "sudo zsched fleet create NAME (or: sudo zsched join FILE), then sudo systemctl enable --now zsched"
    return "sudo systemctl enable --now zsched"


def _and_others(count: int) -> str:
    return f", and {count - 1} more" if count > 1 else ""


def _is_this_machine(root: Path) -> bool:
    return root == Path("/")


def _has_systemd(root: Path) -> bool:
    return _is_this_machine(root) and Path("/run/systemd/system").is_dir()


def _need_rights(root: Path) -> None:
    if _is_this_machine(root) and os.geteuid() != 0:
        raise CliError(EXIT_FAILED, "this writes to /etc and /usr/local; run it by sudo (--plan shows what it does)")


def _has_users(*names: str) -> bool:
    import pwd  # noqa: PLC0415 - the only use

    return {*names} <= {user.pw_name for user in pwd.getpwall()}


def _make_user(root: Path) -> None:
    if shutil.which("systemd-sysusers"):
        _tool("systemd-sysusers", str(root / "etc/sysusers.d/zsched.conf"))
        return
    for user in USERS:
        if not _has_users(user):
            _tool("useradd", "--system", "--user-group", "--no-create-home", "--home-dir=/nonexistent", user)


def _reload(root: Path) -> None:
    if _has_systemd(root):
        _tool("systemctl", "daemon-reload")


def _tool(*command: str) -> None:
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=TOOL_S, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise CliError(EXIT_FAILED, f"{command[0]}: {error}; do it by hand, and run this again") from error
    if done.returncode != 0:
        raise CliError(EXIT_FAILED, f"{' '.join(command)}: {done.stderr.strip()}; mend that, and run this again")


def _remove_empty(folder: Path, root: Path) -> None:
    """Remove a folder that nothing is left in, and so its parents, up to those that every system has."""
    while folder.relative_to(root).as_posix() not in SYSTEM_FOLDERS:
        try:
            folder.rmdir()
        except OSError:
            return  # somebody else's files are in it
        folder = folder.parent


def _carefully(path: Path, act: Callable[[], None]) -> None:
    try:
        act()
    except OSError as error:
        raise CliError(
            EXIT_FAILED, f"{error.filename or path}: {error.strerror}; what was done before stays. Run this again"
        ) from error


def _read(path: Path) -> str:
    return path.read_text(encoding="utf-8", errors="replace")


def _first_line(path: Path) -> str:
    return _read(path).split("\n", 1)[0]


def _print(lines: Iterable[str]) -> None:
    for line in lines:
        say(line)


def _tell(done: str, files: Iterable[tuple[Path, str]]) -> None:
    """Say what was done to files, each given with what it is: those of a kind in a folder are one line."""
    kinds: dict[tuple[Path, str], list[str]] = {}
    for path, what in files:
        kinds.setdefault((path.parent, what), []).append(path.name)
    for (folder, what), names in kinds.items():
        where = folder / names[0] if len(names) == 1 else f"{len(names)} files in {folder}"
        say(f"{done}{where}: {what}")


RootOption = Annotated[
    Path, typer.Option("--root", metavar="DIR", help="Below this folder instead; starts, stops and asks nothing.")
]
