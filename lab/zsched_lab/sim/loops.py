"""The loops of simulated machines on one queue of events: what comes is handled when the loop comes to it.

Knows: virtual time, pauses, slow events, deadlines. Does not know: messages, disks, what an event means.
"""

from __future__ import annotations

import heapq
import itertools
import math
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

from zsched.core.node.node import in_parts
from zsched.core.values import events as ev
from zsched_lab.sim.parts import Machine

TICK_S = 0.0005
"""A deadline that lies in the past is served this much later: the loop's own time."""


@dataclass(slots=True, kw_only=True)
class Loops:
    """Virtual time, and every machine's loop in it; a subclass says what handling an event is."""

    now: float = 100.0
    _queue: list[tuple[float, int, Callable[..., None], tuple[Any, ...]]] = field(default_factory=list)
    _order: Iterator[int] = field(default_factory=itertools.count)

    def handle(self, machine: Machine, event: ev.Event) -> None:
        """Let a machine handle one event now."""
        raise NotImplementedError

    def absorb(self, machine: Machine, event: ev.Event) -> None:
        """Let a machine take one event in, and judge nothing until the next one is handled."""
        raise NotImplementedError

    def run(self, seconds: float) -> None:
        """Let virtual time pass."""
        end = self.now + seconds
        queue, pop = self._queue, heapq.heappop
        while queue and queue[0][0] <= end:
            self.now, _, action, arguments = pop(queue)
            action(*arguments)
        self.now = end

    def run_until(self, condition: Callable[[], bool], seconds: float) -> bool:
        """Let time pass until ``condition``, at most ``seconds``; whether it came true."""
        end = self.now + seconds
        queue, pop = self._queue, heapq.heappop
        while queue and queue[0][0] <= end:
            self.now, _, action, arguments = pop(queue)
            action(*arguments)
            if condition():
                return True
        self.now = end
        return condition()

    def later(self, seconds: float, action: Callable[..., None], *arguments: Any) -> None:
        """Do something ``seconds`` from now."""
        heapq.heappush(self._queue, (self.now + seconds, next(self._order), action, arguments))

    def at(self, when: float, action: Callable[..., None], *arguments: Any) -> None:
        """Do something at a true time: what is due at one time is done in the order in which it was asked for."""
        heapq.heappush(self._queue, (when, next(self._order), action, arguments))

    def rearm(self, machine: Machine) -> None:
        """The machine's clock has changed: its next deadline lies elsewhere in true time."""
        machine.wake_at = math.inf
        self.arm(machine)

    def arm(self, machine: Machine) -> None:
        """Make sure that the node is woken at its next deadline."""
        node = machine.node
        if node is None or machine.is_paused:
            return
        due = node.next_deadline()
        if not machine.clock.is_true:
            due = machine.clock.true(due)
        if due >= machine.wake_at:
            return
        due = max(due, self.now + TICK_S, machine.busy_until)
        if due < machine.wake_at:
            machine.wake_at = due
            heapq.heappush(self._queue, (due, next(self._order), self._wake, (machine, machine.life, due)))

    def _wake(self, machine: Machine, life: int, at: float) -> None:
        if machine.life != life or machine.wake_at != at:
            return  # another life, or an earlier wake-up has come since
        machine.wake_at = math.inf
        node = machine.node
        if node is None or machine.is_paused or machine.inbox or machine.busy_until > self.now:
            return  # its loop comes to it after what it is at
        if node.next_deadline() <= machine.clock.local(self.now):
            self.deliver(machine, ev.DeadlineReached())
        self.arm(machine)

    def deliver(self, machine: Machine, event: ev.Event) -> None:
        """An event reaches a machine: handled at once, or when its loop comes to it."""
        if machine.node is None:
            return
        if machine.is_paused or machine.inbox or machine.busy_until > self.now:
            machine.inbox.append(event)
            self.pump_later(machine)
            return
        self.handle(machine, event)

    def pause(self, machine: Machine, seconds: float) -> None:
        """The loop stands still (SIGSTOP); what comes queues up, and the clock goes on."""
        if machine.node is not None:
            machine.is_paused = True
            self.later(seconds, self.unpause, machine, machine.life)

    def unpause(self, machine: Machine, life: int) -> None:
        """The loop goes on with what has queued up; a frozen machine's clock goes on where it stood."""
        if machine.life != life or not machine.is_paused:
            return
        machine.is_paused = False
        if machine.frozen_at is not None:
            machine.clock.change(self.now, jump_s=machine.frozen_at - self.now)
            machine.frozen_at = None
            self.thawed(machine)
            self.rearm(machine)
        if machine.asleep_since is not None:
            slept_s, machine.asleep_since = self.now - machine.asleep_since, None
            machine.clock.change(self.now, jump_s=max(machine.sleep_error_s, -slept_s))
            self.woken_up(machine, slept_s)
            self.rearm(machine)
        self.pump_later(machine)

    def freeze(self, machine: Machine, seconds: float) -> None:
        """The machine stands still as a whole: loop, workers, clock."""
        if machine.node is not None and not machine.is_paused:
            machine.frozen_at = self.now
            self.frozen(machine)
            self.pause(machine, seconds)

    def suspend(self, machine: Machine, seconds: float, error_s: float = 0.0) -> None:
        """The machine sleeps: loop and workers stand still; its clock goes on, wrong by ``error_s`` when it wakes."""
        if machine.node is not None and not machine.is_paused:
            machine.asleep_since, machine.sleep_error_s = self.now, error_s
            self.frozen(machine)
            self.pause(machine, seconds)

    def woken_up(self, machine: Machine, slept_s: float) -> None:
        """A machine goes on after it has slept."""

    def frozen(self, machine: Machine) -> None:
        """A machine has begun to stand still."""

    def thawed(self, machine: Machine) -> None:
        """A machine goes on after it stood still."""

    def pump_later(self, machine: Machine) -> None:
        """Come to what has queued up, as soon as the machine is free."""
        if not machine.is_pumping and not machine.is_paused:
            machine.is_pumping = True
            self.later(max(machine.busy_until - self.now, 0.0), self._pump, machine, machine.life)

    def _pump(self, machine: Machine, life: int) -> None:
        machine.is_pumping = False
        while machine.life == life and machine.inbox and not machine.is_paused and machine.busy_until <= self.now:
            self._catch_up(machine)
            self.handle(machine, machine.inbox.popleft())
        if machine.inbox:
            self.pump_later(machine)
        else:
            self.arm(machine)

    def _catch_up(self, machine: Machine) -> None:
        """As the daemon's loop does behind a deadline: take in all that waits before time is judged.

        All but the last event of the first part; that one, and the other part, are still to be handled.
        """
        assert machine.node is not None
        if machine.node.next_deadline() <= machine.clock.local(self.now):
            first, *later = in_parts(machine.inbox)
            for event in first[:-1]:
                self.absorb(machine, event)
            machine.inbox = deque((first[-1], *(event for part in later for event in part)))
