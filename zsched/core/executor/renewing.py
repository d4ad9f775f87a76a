"""EXECUTOR, beside the handover: when a worker that runs by an old recipe is started again, candidate by candidate.

A *recipe* is all that a worker's process is made with: command, environment, session. A changed fleet file changes it,
and a process keeps the one that it was started with. So each candidate starts its worker again, and the owner is the
last:

* A candidate that does not own the task does so when no other living one with a lower name still has to, and none is
  starting.
* The owner waits for all of these. Then it gives the task away: its profile says so, and the robots leave it as they
  leave an owner that drains, for a candidate with a new worker. Afterwards it is a candidate like the others.
* Where nobody can take the task (one candidate, a pause, a pin), or nobody has taken it within `GIVE_AWAY_S`, the owner
  starts its worker again in place, and says so.

Nobody waits for a candidate that is not heard, drains, or has failed for good. Profiles tell what is to be done, and a
profile of before the change tells nothing: so all wait first until every living candidate goes by the same file.

Knows: which workers here run by an old recipe, what profiles tell of the others. Does not know: processes, commands,
how a task moves.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from enum import StrEnum

from zsched.core.values.fleet import Standby, TaskSpec
from zsched.core.values.instructions import RecordStory, RenewWorker
from zsched.core.values.model import Allocation, NodeId, TaskId
from zsched.core.values.profile import Profile, Renewal, WorkerState
from zsched.core.values.struct import Struct, field
from zsched.core.values.todo import ToDo

SAME_FILE_S = 1.0
"""A candidate has beaten by the same fleet file for this long: its profile tells of its own worker."""
OTHER_FILE_S = 30.0
"""A worker that is to start again waits at most this long for candidates with another fleet file."""
GIVE_AWAY_S = 30.0
"""An owner that nobody replaces within this time starts its worker again in place."""


class Step(StrEnum):
    """What a node does about a worker of its own that runs by an old recipe."""

    WAIT = "wait"
    GIVE_AWAY = "give away"
    RENEW = "renew"
    RENEW_IN_PLACE = "renew in place"


def step(
    spec: TaskSpec, me: NodeId, allocation: Allocation, profiles: Mapping[NodeId, Profile], *, is_at_work: bool
) -> Step:
    """The next step of node ``me``, whose worker runs by an old recipe.

    Args:
        spec: the task.
        me: this node.
        allocation: the newest value that it has learnt.
        profiles: fresh profiles of living candidates, this node left out.
        is_at_work: the worker here still has a role: it is the owner's, or drains.
    """
    others = {name: profile for name, profile in sorted(profiles.items()) if name in spec.candidates and name != me}
    others = {name: profile for name, profile in others.items() if _takes_part(spec, profile)}
    behind = [name for name, profile in others.items() if _renewal(spec, profile) is not Renewal.NONE]
    starting = [name for name, profile in others.items() if _is_starting(spec, profile)]
    if allocation.owner != me:
        is_my_turn = not [name for name in behind if name < me and name != allocation.owner]
        is_quiet = not [name for name in starting if name != allocation.owner]
        return Step.RENEW if is_my_turn and is_quiet and not is_at_work else Step.WAIT
    if behind or starting:
        return Step.WAIT
    if not others or allocation.paused or allocation.pinned:
        return Step.RENEW_IN_PLACE
    return Step.GIVE_AWAY


def _takes_part(spec: TaskSpec, profile: Profile) -> bool:
    """Whether a candidate could have the task, now or when its worker is ready."""
    state = _state(spec, profile)
    is_absent = state is WorkerState.STOPPED and not spec.worker.command
    return not profile.draining and state is not WorkerState.FAILED and state is not None and not is_absent


def _is_starting(spec: TaskSpec, profile: Profile) -> bool:
    """Whether a candidate's worker will be ready, or will have failed, without anybody asking it to start.

    A warm worker that its daemon starts is stopped for the moment between two of its processes only.
    """
    is_warm = bool(spec.worker.command) and spec.worker.standby is Standby.WARM
    state = _state(spec, profile)
    return state is WorkerState.STARTING or (is_warm and state is WorkerState.STOPPED)


def _state(spec: TaskSpec, profile: Profile) -> WorkerState | None:
    load = profile.worker(spec.name)
    return None if load is None else load.state


def _renewal(spec: TaskSpec, profile: Profile) -> Renewal:
    load = profile.worker(spec.name)
    return Renewal.NONE if load is None else load.renewal


class Renewing(Struct):
    """One node's workers that run by an old recipe."""

    me: NodeId
    _behind: dict[TaskId, Renewal] = field(default_factory=dict)
    _files: dict[NodeId, tuple[str, float]] = field(default_factory=dict)
    """{node: (its fleet file, since when it beats by it)}, of beats since a worker here is behind."""
    _behind_since: dict[TaskId, float] = field(default_factory=dict)
    _since: dict[TaskId, float] = field(default_factory=dict)
    """{task: since when this owner gives it away}."""
    _ordered: set[TaskId] = field(default_factory=set)
    """Whose worker is told to start again."""

    @property
    def told(self) -> Mapping[TaskId, Renewal]:
        """{task: what this node's profile says of its worker}, of those that run by an old recipe."""
        return self._behind

    def on_compared(self, task: TaskId, *, is_old: bool) -> None:
        """The supervisor has compared a process with its recipe; a process that has ended is not behind."""
        if is_old and task not in self._behind:
            self._behind = {**self._behind, task: Renewal.DUE}
        elif not is_old:
            self.forget(task)

    def hear(self, node: NodeId, fleet_file: str, now: float) -> None:
        """A peer beats by that fleet file; it need not be told while no worker here is behind."""
        if node not in self._files or self._files[node][0] != fleet_file:
            self._files[node] = (fleet_file, now)

    def _is_one_file(self, task: TaskId, others: Iterable[NodeId], fleet_file: str, now: float) -> bool:
        if now >= self._behind_since.setdefault(task, now) + OTHER_FILE_S:
            return True
        known = (self._files.get(name, ("", now)) for name in others)
        return all(file == fleet_file and now >= since + SAME_FILE_S for file, since in known)

    def forget(self, task: TaskId) -> None:
        """The task has no worker here, or a new one."""
        self._behind_since.pop(task, None)
        self._behind = {name: renewal for name, renewal in self._behind.items() if name != task}
        self._since.pop(task, None)
        self._ordered.discard(task)
        if not self._behind:
            self._files.clear()

    def tend(
        self,
        spec: TaskSpec,
        allocation: Allocation,
        profiles: Mapping[NodeId, Profile],
        todo: ToDo,
        now: float,
        *,
        is_at_work: bool,
        fleet_file: str,
    ) -> None:
        """Do the next step for one task whose worker here runs by an old recipe (arguments as of `step`).

        ``fleet_file``: the hash of the file by which this node goes.
        """
        if spec.name in self._ordered or not self._is_one_file(spec.name, profiles, fleet_file, now):
            return
        chosen = step(spec, self.me, allocation, profiles, is_at_work=is_at_work)
        why = ""
        if chosen is Step.GIVE_AWAY:
            since = self._since.setdefault(spec.name, now)
            if now - since < GIVE_AWAY_S:
                self._say(spec.name, Renewal.LEAVES)
                return
            chosen, why = Step.RENEW_IN_PLACE, f"nobody has taken the task within {GIVE_AWAY_S:g} s"
        elif chosen is Step.WAIT:
            self._say(spec.name, Renewal.DUE)
            return
        if chosen is Step.RENEW_IN_PLACE:
            why = f", in place: {why or 'no other candidate can take the task'}"
        self._ordered.add(spec.name)
        text = f"the worker starts again, by the changed fleet file{why}"
        todo.add(RenewWorker(task=spec.name), RecordStory(stage="executor", text=text, task=spec.name))

    def _say(self, task: TaskId, renewal: Renewal) -> None:
        if renewal is not Renewal.LEAVES:
            self._since.pop(task, None)
        if self._behind[task] is not renewal:
            self._behind = {**self._behind, task: renewal}
