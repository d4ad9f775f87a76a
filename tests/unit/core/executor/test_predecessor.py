"""Who is asked for the state of an epoch: the owner of the one before, while it is there."""

import pytest

from support.allocations import allocation_of
from support.fleets import task_of
from support.todos import done
from zsched.core.executor.handover import Executor
from zsched.core.values.fleet import WorkerSpec
from zsched.core.values.instructions import Instruction, SetRole
from zsched.core.values.plan import Role, WorkerRole


def edge(*, exclusive: bool = False) -> Executor:
    spec = task_of(exclusive=exclusive, worker=WorkerSpec(command=("merge",)))
    return Executor(spec=spec, me="edge1", has_streams=False)


def execute(one: Executor, owner: str, epoch: int) -> tuple[Instruction, ...]:
    return done(one.execute, allocation_of(epoch, owner), 0.0)


def role(out: tuple[Instruction, ...]) -> Role:
    (found,) = [one.role for one in out if isinstance(one, SetRole)]
    return found


def test_an_owner_that_is_gone_is_not_asked() -> None:
    one = edge()
    execute(one, "edge2", 1)
    done(one.on_gone, "edge2")
    assert role(execute(one, "edge1", 2)).predecessor is None


def test_an_owner_that_is_back_is_asked_whoever_else_was_away() -> None:
    """This machine lost its link for a while: it missed everybody, and the task stayed where it was."""
    for back, expected in ((("edge3",), None), (("edge3", "edge2"), "edge2")):
        one = edge()
        execute(one, "edge2", 1)
        for node in ("edge2", "edge3"):
            done(one.on_gone, node)
        for node in back:
            one.on_back(node)
        assert role(execute(one, "edge1", 2)).predecessor == expected


def test_somebody_elses_going_changes_nothing_and_is_forgotten_with_the_epoch() -> None:
    one = edge()
    execute(one, "edge3", 1)
    done(one.on_gone, "edge2")
    done(one.on_gone, "edge3")
    execute(one, "edge2", 2)
    assert role(execute(one, "edge1", 3)).predecessor == "edge2"


def test_who_comes_back_to_itself_asks_nobody() -> None:
    """This node has missed the owner in between: its own worker has the newest state it knows of."""
    one = edge()
    execute(one, "edge1", 1)
    assert role(execute(one, "edge1", 3)).predecessor is None


def test_a_lease_keeps_the_predecessor() -> None:
    one = edge(exclusive=True)
    execute(one, "edge2", 1)
    execute(one, "edge1", 2)
    assert role(done(one.set_lease, 5.0, 1.0)).predecessor == "edge2"


def test_so_does_one_that_comes_after_the_worker_had_to_stop() -> None:
    """Its worker may still be starting, or waiting for the state: it works in that epoch all the same."""
    one = edge(exclusive=True)
    execute(one, "edge2", 1)
    execute(one, "edge1", 2)
    assert role(done(one.leave)).role is WorkerRole.IDLE
    assert role(done(one.set_lease, 5.0, 1.0)).predecessor == "edge2"


@pytest.mark.parametrize(("step", "what"), [("on_gone", "edge2"), ("on_role_ended", 2)])
def test_but_not_where_that_machine_has_gone_meanwhile_or_the_worker_had_the_state(step: str, what: object) -> None:
    one = edge(exclusive=True)
    execute(one, "edge2", 1)
    execute(one, "edge1", 2)
    done(one.leave)
    done(getattr(one, step), what)
    assert role(done(one.set_lease, 5.0, 1.0)).predecessor is None


def test_an_owner_that_goes_while_it_is_asked_is_waited_for_no_longer() -> None:
    """It died in a move away from it, or this node hears of its death later than of the new owner."""
    one = edge()
    execute(one, "edge2", 1)
    execute(one, "edge1", 2)
    assert not any(isinstance(step, SetRole) for step in done(one.on_gone, "edge3"))
    found = role(done(one.on_gone, "edge2"))
    assert (found.role, found.epoch, found.predecessor) == (WorkerRole.ACTIVE, 2, None)
    assert not any(isinstance(step, SetRole) for step in done(one.on_gone, "edge2")), "once"


def test_who_works_after_a_worker_that_has_worked_is_not_given_the_state_of_before_the_epoch() -> None:
    """It has ended behind the state that it had; what it did since is not in that."""
    one = edge()
    execute(one, "edge2", 1)
    execute(one, "edge1", 2)
    assert not done(one.on_role_ended, 1), "that was another epoch"
    found = role(done(one.on_role_ended, 2))
    assert (found.role, found.epoch, found.predecessor) == (WorkerRole.ACTIVE, 2, None)
    assert not any(isinstance(step, SetRole) for step in done(one.on_role_ended, 2)), "once"


def test_one_that_hears_of_its_epoch_at_its_end_knows_whose_state_it_begins_with() -> None:
    """Who follows it asks it, also where the task moved on before its worker had heard anything."""
    one = edge()
    execute(one, "edge2", 1)
    execute(one, "edge1", 2)
    found = role(execute(one, "edge3", 3))
    assert (found.role, found.epoch, found.predecessor) == (WorkerRole.DRAINING, 2, "edge2")
