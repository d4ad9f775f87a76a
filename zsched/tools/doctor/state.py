"""Checks of the state folder: the state in it, and the disk that it is on.

Knows: the state file, fsync, free space. Does not know: what else needs the disk.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import statistics
from pathlib import Path
from typing import Final

from zsched.core.values.fleet import electorate_hash
from zsched.core.values.startup import NoState
from zsched.host.clock import monotonic_s
from zsched.host.paths import is_there
from zsched.host.state_file import StateFile
from zsched.tools.doctor.model import SEAT_ADVICE, Result, Scene, failed, passed, skipped, warned

SYNC_TRIES: Final = 5
SLOW_SYNC_S: Final = 0.05
"""A save takes two; an SD card in order takes tens of milliseconds."""
SYNC_BYTES: Final = 4096
LOW_BYTES, FULL_BYTES = 64 << 20, 1 << 20
LOW_FILES: Final = 16


def valid(scene: Scene) -> Result:
    """Whether there is a state, whole and this node's own."""
    folder = scene.state_folder
    if is_hidden(folder):
        return skipped(f"user {os.geteuid()} may not look into {folder}: run the doctor as root")
    found = StateFile(folder, fleet=scene.fleet.name, node=scene.node).load()
    if found.state is not None:
        return passed(f"{folder}: generation {found.state.generation}, start {found.state.incarnation}")
    told, role = found.problem or "no state", "an elector" if scene.node in scene.fleet.electors else "no elector"
    first = "before it, if the state was lost, bring what `zsched fleet export` writes on a living node as that file"
    fix = f"sudo zsched init --config {scene.file} --node {scene.node}, with the daemon stopped; {first}"
    if found.no_state is not NoState.MISSING:
        fix = "zsched fleet recover --help says how a node becomes an elector again; do not copy a state from elsewhere"
    if found.no_state is NoState.ANOTHER_NODE:
        fix = "the fleet file and name of that state, or zsched leave; zsched init refuses here"
    if scene.node not in scene.fleet.electors:
        return warned(told, f"{scene.node} is {role}: it works without", fix=fix)
    return failed(told, f"{scene.node} is {role} and cannot vote", fix=fix)


def makes_an_elector(scene: Scene) -> Result:
    """Whether the state is one of these electors, not lost and not disputed."""
    if scene.node in scene.unseated:
        told = f"{scene.node} is no elector, and {scene.source} names it as one"
        return warned(told, fix=SEAT_ADVICE.format(names=scene.node))
    if scene.node not in scene.fleet.electors:
        return skipped(f"{scene.node} is no elector")
    if is_hidden(scene.state_folder):
        return skipped(f"user {os.geteuid()} may not look into {scene.state_folder}: run the doctor as root")
    state = StateFile(scene.state_folder, fleet=scene.fleet.name, node=scene.node).load().state
    if state is None:
        return skipped("there is no valid state")
    if scene.document is None and state.electorate != electorate_hash(scene.fleet):  # an agreed value names seats
        fix = "bring the fleet file of the others here, or see docs/guide/service.md, Add or remove a machine"
        return failed("the state is one of other electors than the fleet file names", fix=fix)
    if state.disputed:
        return failed(
            state.disputed,
            fix="remove the other machine of this name, stop zsched here, zsched fleet recover --settle, and start it",
        )
    if state.lost:
        return failed(str(state.lost), fix="zsched fleet recover --help says how this node becomes an elector again")
    return passed(f"{scene.node} is one of {len(scene.fleet.electors)} electors, and its state is theirs")


def syncs_quickly(scene: Scene) -> Result:
    """Whether a save in the state folder is on disk soon enough for a ballot."""
    folder = scene.state_folder
    if not os.access(folder, os.W_OK | os.X_OK):
        return skipped(f"{folder} is not there, or not to be written by user {os.geteuid()}")
    try:
        took_s = _sync_s(folder)
    except OSError as error:
        fix = f"df -h {folder}; mount shows whether its disk is read-only"
        return failed(f"{folder}: nothing can be written: {error.strerror}", fix=fix)
    return judged_sync(took_s, scene.fleet.timing.ballot_s, folder)


def judged_sync(took_s: float, ballot_s: float, folder: Path) -> Result:
    """What a write and fsync of ``took_s`` means for an elector, which makes two per answer."""
    told = f"{folder}: write and fsync take {1000 * took_s:.1f} ms (median of {SYNC_TRIES}), a save takes two"
    fix = "put the state folder on another disk (--state-dir), or see what else writes: iotop"
    if 2 * took_s > ballot_s:
        return failed(told, f"an elector must answer within ballot_s = {ballot_s:g} s", fix=fix)
    return warned(told, fix=fix) if took_s > SLOW_SYNC_S else passed(told)


def _sync_s(folder: Path) -> float:
    took_s = []
    for _ in range(SYNC_TRIES):
        probe = folder / f"doctor-{secrets.token_hex(4)}"
        began = monotonic_s()
        fd = os.open(probe, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
        try:
            os.write(fd, b"\0" * SYNC_BYTES)
            os.fsync(fd)
            took_s.append(monotonic_s() - began)
        finally:
            os.close(fd)
            probe.unlink()
    return statistics.median(took_s)


def has_space(scene: Scene) -> Result:
    """Whether the state folder's disk has room and may be written."""
    folder, facts = _disk_of(scene.state_folder)
    return judged_space(
        folder,
        free=facts.f_bavail * facts.f_frsize,
        files=facts.f_favail if facts.f_files else None,
        is_read_only=bool(facts.f_flag & os.ST_RDONLY),
    )


def _disk_of(folder: Path) -> tuple[Path, os.statvfs_result]:
    """(the folder or the nearest one above it that is there for us, what is known of its disk)."""
    for one in (folder, *folder.parents):
        with contextlib.suppress(OSError):
            return one, os.statvfs(one)
    return Path("/"), os.statvfs("/")


def judged_space(folder: Path, *, free: int, files: int | None, is_read_only: bool) -> Result:
    """What this room means: ``free`` bytes, and ``files`` more of them (``None``: without limit)."""
    fix = f"free space on it: df -h {folder}; df -i {folder}"
    if is_read_only:
        return failed(f"the disk of {folder} is read-only: no state can be saved", fix=f"mount -o remount,rw; {fix}")
    told = f"the disk of {folder} has {free >> 20} MiB left"
    if free < FULL_BYTES or (files is not None and files < LOW_FILES):
        return failed(told if files is None else f"{told}, and {files} files", fix=fix)
    return warned(told, fix=fix) if free < LOW_BYTES else passed(told)


def is_hidden(folder: Path) -> bool:
    """Whether this user may not see what is in the folder."""
    return is_there(folder) and not os.access(folder, os.R_OK | os.X_OK)
