"""Checks of the machine: its clock, limits, memory and radio.

Knows: what a daemon, its leases and its workers want of a machine. Does not know: how a node measures itself.
"""

from __future__ import annotations

import math
import resource
import threading
from collections.abc import Iterator
from typing import Final

from zsched.core.values.events import ClockCompared
from zsched.core.values.fleet import LinkSpec, SharedMemory, Standby, runs_worker
from zsched.core.values.profile import LinkSource
from zsched.core.vote.clocks import is_bad
from zsched.host.clock import ClockWatch
from zsched.host.machine import core_speed
from zsched.host.machine.device_profiler import DeviceProfiler
from zsched.host.machine.shared_memory import FOLDER
from zsched.host.procfs import names, read_file
from zsched.host.radio.nl80211 import GenericNetlink, Nl80211Error
from zsched.host.state_file import LOCK_NAME
from zsched.link.sessions.memory import shared_memory_objection
from zsched.tools.doctor.model import Result, Scene, counted, failed, joined, passed, skipped, warned

CLOCK_S: Final = 0.5
"""How long the clocks are compared for."""
ENOUGH_DESCRIPTORS: Final = 4096
NEARLY_ALL: Final = 0.8


def clock_runs_true(scene: Scene, watch: ClockWatch | None = None) -> Result:
    """Whether no time service slews the clock so fast that leases cannot be trusted."""
    watch = watch or ClockWatch()
    watch.look()
    threading.Event().wait(CLOCK_S)
    drift = watch.look()
    if drift is None:
        return skipped(f"the clocks could not be compared within {CLOCK_S:g} s")
    told = f"the clock that time services set ran by {drift.error_ratio:+.3%} against the crystal"
    event = ClockCompared(error_ratio=drift.error_ratio, jump_s=drift.jump_s, since_s=drift.since_s)
    if not is_bad(event):
        return passed(f"{told} for {CLOCK_S:g} s")
    leased = [task.name for task in scene.fleet.tasks if task.exclusive]
    fix = "wait until the time service has caught up (chronyc tracking, timedatectl), or let it step the clock at boot"
    if leased:
        return failed(told, f"this node takes no part in exclusive tasks meanwhile: {', '.join(leased)}", fix=fix)
    return warned(told, fix=fix)


def has_descriptors(scene: Scene) -> Result:
    """Whether the daemon may open enough files; without a daemon, whether one started here could."""
    fix = "LimitNOFILE=65536 in the unit (systemctl edit zsched), or ulimit -Hn in the shell that starts it"
    pid = read_file(str(scene.state_folder / LOCK_NAME)).decode(errors="replace").strip()
    limits = read_file(f"/proc/{pid}/limits").decode(errors="replace") if pid.isdecimal() else ""
    line = next((line for line in limits.splitlines() if line.startswith("Max open files")), "")
    if not line:
        hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
        most = math.inf if hard == resource.RLIM_INFINITY else float(hard)
        told = f"a daemon started here may open {most:g} files"
        return passed(told) if most >= ENOUGH_DESCRIPTORS else warned(told, fix=fix)
    soft = line.removeprefix("Max open files").split()[0]
    most = float(soft) if soft.isdecimal() else math.inf
    used = len(names(f"/proc/{pid}/fd"))
    told = f"process {pid} may open {most:g} files and has {used or 'an unknown number'} open"
    if used > NEARLY_ALL * most:
        return failed(told, fix=fix)
    return passed(told) if most >= ENOUGH_DESCRIPTORS else warned(told, fix=fix)


def shares_memory(scene: Scene) -> Result:
    """Whether shared memory can be used where the fleet file wants it."""
    if scene.fleet.shared_memory is SharedMemory.OFF:
        return skipped("the fleet file has `shared_memory: off`")
    why = shared_memory_objection(scene.fleet, scene.me)
    if why:
        fix = "mount -o remount,size=1G /dev/shm (docker run --shm-size), or set `shared_memory: off`"
        return warned(f"shared memory is off here: {why}", fix=fix)
    return passed(f"{FOLDER} can be written to and has room")


def can_do_its_tasks(scene: Scene) -> Result:
    """Whether this machine alone could do each task that it is a candidate of, by the fleet file's demands."""
    sample = DeviceProfiler(scene.root).sample({})
    speed = core_speed.kept(scene.state_folder)
    cores = sample.cpu_cores * (1.0 if speed is None else speed)
    told = f"{cores:.1f} cores of speed 1 and {sample.memory_mb:.0f} MiB here"
    mine = [task for task in scene.fleet.tasks if scene.node in task.candidates]
    if not mine:
        return skipped(f"{told}; {scene.node} is no candidate of any task")
    found = []
    for task in mine:
        if task.demand.memory_mb > sample.memory_mb:
            found.append(failed(f"{task.name} needs {task.demand.memory_mb:g} MiB; {told}", fix=_OTHER_MACHINE))
        elif task.demand.cpu_cores > cores:
            found.append(warned(f"{task.name} needs {task.demand.cpu_cores:g} cores; {told}", fix=_OTHER_MACHINE))
    return joined(found, passed(f"{told}; enough for each of {', '.join(task.name for task in mine)} alone"))


def can_do_all_at_once(scene: Scene) -> Result:
    """Whether the memory suffices for all workers that this machine keeps at the same time."""
    sample = DeviceProfiler(scene.root).sample({})
    mine = [task for task in scene.fleet.tasks if runs_worker(task, scene.node, scene.me.kind)]
    kept = [task.demand.memory_mb for task in mine if task.worker.standby is not Standby.COLD]
    cold = [task.demand.memory_mb for task in mine if task.worker.standby is Standby.COLD]
    needed = sum(kept) + max(cold, default=0.0)  # one of the cold ones is started, when the machine gets its task
    told = f"{counted(len(mine), 'workers')}: {needed:g} MiB by the fleet file; {sample.memory_mb:.0f} MiB here"
    if needed <= sample.memory_mb:
        return passed(told)
    return warned(told, fix="`standby: cold` for some of them, fewer candidates, or more memory")


_OTHER_MACHINE: Final = "take this machine out of the task's candidates, or correct its `demand:`"


def radio_stays_awake(scene: Scene, radio: GenericNetlink | None = None) -> Result:
    """Whether power save is off on every Wi-Fi interface that the fleet file names for this machine."""
    interfaces = sorted({link.value for link in _wifi(scene)})
    if not interfaces:
        return skipped("the fleet file names no Wi-Fi interface of this machine")
    try:
        asked = radio or GenericNetlink()
    except Nl80211Error as error:
        return skipped(f"{', '.join(interfaces)}: {error}")
    try:
        return joined((_power_save(asked, name) for name in interfaces), skipped("no interface"))
    finally:
        asked.close()


def _wifi(scene: Scene) -> Iterator[LinkSpec]:
    return (link for link in scene.me.links if link.source is LinkSource.NL80211)


def _power_save(radio: GenericNetlink, name: str) -> Result:
    try:
        index = next((one.index for one in radio.interfaces() if one.name == name), None)
        if index is None:
            fix = f"`wifi:` in the fleet file must name an interface of this machine: ip link; not {name}"
            return failed(f"there is no Wi-Fi interface {name}", fix=fix)
        is_on = radio.power_save(index)
    except Nl80211Error as error:
        return skipped(f"{name}: {error}")
    if is_on is None:
        return skipped(f"{name}: the driver does not tell of its power save")
    if not is_on:
        return passed(f"{name}: power save is off")
    fix = f"sudo iw dev {name} set power_save off (NetworkManager: wifi.powersave = 2)"
    return warned(f"{name}: power save is on: what is sent to this machine may wait for 0.1 s and more", fix=fix)
