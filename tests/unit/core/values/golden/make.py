"""Write the golden frames that are missing; what is there is never written again.

One file per kind of frame and wire version: what an older node once sent must be read for ever. Run it after a kind
was added: ``python tests/unit/core/values/golden/make.py``. A value here is frozen with its file; a new shape gets
a new entry. Only what passes between a daemon and its relay may be made anew: a relay of another build is replaced
first.
"""

from __future__ import annotations

from pathlib import Path

from zsched.core.values import codec as wire
from zsched.core.values import (
    decision,
    document,
    durable,
    electorate,
    events,
    messages,
    model,
    plan,
    rehearsal,
    relay_protocol,
    snapshot,
)
from zsched.core.values.beat import Beat
from zsched.core.values.profile import Link, LinkSource, Profile, WorkerLoad, WorkerState
from zsched.link.pipe import frames as relay_pipe
from zsched.link.pipe import protocol

HERE = Path(__file__).parent

_WEIGHTS = model.Weights(cpu=0.5, memory=0.25, network=0.25)
_TUNING = model.Tuning(weights=_WEIGHTS, bonus=0.125)
"""Its frames hold a ``time_to_trigger_s`` and an ``aggregate``, of before: a field that is gone is read over."""
_VALUE = model.Allocation(
    task="map_merge", revision=7, epoch=4, owner="edge1", tuning=_TUNING, pinned=True, paused=True
)
_ASKED = model.Asked(by="ada@robot1", reason="new battery")
_BALLOT = model.Ballot(counter=12, node="robot1", incarnation=3)
_ACCEPTANCE = model.Acceptance(ballot=_BALLOT, value=_VALUE)
_WORKER = WorkerLoad(task="map_merge", state=WorkerState.READY, cpu_cores=0.5, memory_mb=200.0)
_LINK = Link(source=LinkSource.NL80211, peer="edge1", rssi_dbm=-61.5, bitrate_mbps=433.3, retry_ratio=0.05)
_FLEET_VALUE = electorate.FleetValue(
    fleet="lab",
    generation_id="0a1b",
    revision=3,
    number=2,
    electors=(electorate.Elector(name="robot1"), electorate.Elector(name="robot2", disk="d2", joining=1)),
    settled=False,
    lease_s=1.0,
    guard_lease_s=2.0,
    creations=1,
    tasks=(electorate.Creation(task="map_merge", number=1, exclusive=True),),
    document="0d0e",
)
_DOCUMENT = document.Document(
    text=document.Text("fleet: lab  # the hall's\n"),
    flags=(
        document.Flag(kind=document.FlagKind.DRAIN, subject="robot2", reason="a new wheel", by="ana", for_s=3600.0),
    ),
)
_UTILITY = model.Utility(candidate="edge1", value=0.5, cpu=0.75, memory=0.25, network=0.5, reachable=False)
_VECTOR = model.UtilityVector(
    voter="robot1", task="map_merge", revision=7, utilities=(_UTILITY,), refused=(("edge2", "draining"),)
)
_DECISION = decision.Decision(
    figures=decision.Figures(
        task="map_merge",
        now=1234.5,
        rules=decision.Rules(
            candidates=("edge1", "edge2"),
            reach=model.Reach.MAJORITY,
            max_moves_per_minute=6,
            price_s=0.3,
            memory_s=1000.0,
            start_deadline_s=20.0,
            has_command=True,
        ),
        allocation=_VALUE,
        voters=("robot1", "robot2"),
        present=("robot1", "robot2"),
        vectors=(_VECTOR,),
        electors=("robot1", "robot2"),
        electors_heard=("robot1",),
        settled_for_s=17.25,
        owner_state=model.PeerState.ALIVE,
        is_called=True,
        out=("edge2",),
        first="other",
        judge=decision.JudgeMemory(
            not_ready_since=1230.25,
        ),
    ),
    verdict=decision.Verdict(
        outcome="wait",
        candidate="edge1",
        aggregate=0.5,
        reason="edge2 leads",
        aggregates=(("edge1", 0.5), ("edge2", 0.75)),
    ),
    needs=(decision.Need(candidate="edge1", cpu_cores=0.5, memory_mb=200.0),),
)
_ROUTE = plan.Route(
    stream="map_merge/in/0",
    direction=plan.Direction.INPUT,
    from_expr="robot1/map",
    to_expr="edge1/map_merge/robot1/map",
    settings=plan.StreamSettings(
        stream_class=plan.StreamClass.LATEST, keep_last=3, depth=32, handover=plan.HandoverRule.ALL
    ),
)
_SLOT = plan.Slot(
    epoch=4,
    owner="edge1",
    routes=(_ROUTE,),
    ready_when=plan.ReadyWhen.MATCHING,
)

_COUNT = plan.StreamCount(stream="map_merge/in/0", messages=10, bytes=4096, drops=(("overflow", 2),), last_seen_s=0.5)
_NODE_STATUS = snapshot.NodeStatus(
    name="edge1",
    kind="edge",
    state="alive",
    age_s=0.5,
    incarnation=3,
    cpu_cores=4.0,
    cpu_used_cores=1.0,
    cpu_ratio=0.25,
    memory_mb=8000.0,
    memory_used_mb=2000.0,
    memory_ratio=0.25,
    links=(_LINK,),
    workers=(_WORKER,),
    draining=True,
)
_TASK_STATUS = snapshot.TaskStatus(
    name="map_merge",
    owner="edge1",
    epoch=4,
    revision=7,
    since_s=12.5,
    owner_state="alive",
    phase="settled",
    tuning=_TUNING,
    candidates=("edge1", "edge2"),
    decision=snapshot.DecisionStatus(
        outcome="wait",
        winner="edge2",
        reason="edge2 leads",
        age_s=0.25,
        aggregates=(("edge1", 0.5),),
        utilities=(("robot1", (_UTILITY,)),),
        vetoed=(("edge3", "out of memory"),),
        silent=("robot3",),
    ),
    vote=snapshot.VoteStatus(base_revision=6, votes=(("robot1", "edge1"),), outcome="won", winner="edge1", age_s=12.5),
    streams=(_COUNT,),
    history=(snapshot.PastAllocation(epoch=3, revision=5, owner="edge2", age_s=60.0, reason="first placement"),),
    problems=("edge3 has no worker",),
)

SAMPLES: dict[str, object] = {
    "beat": Beat(
        node="robot1", incarnation=3, sequence=99, loop_lag_s=0.25, learnt=(("map_merge", 7, 4),), suspects=("edge2",)
    ),
    "profile": Profile(
        node="edge1",
        incarnation=3,
        sequence=99,
        cpu_cores=4.0,
        cpu_used_cores=1.5,
        memory_mb=8000.0,
        memory_used_mb=2000.0,
        links=(_LINK,),
        workers=(_WORKER,),
        draining=True,
    ),
    "proposal": model.Proposal(
        voter="robot1",
        task="map_merge",
        base_revision=7,
        candidate="edge1",
        aggregate=0.75,
        is_escape=True,
        reason="edge2 is gone",
    ),
    "utilities": messages.Utilities(voter="robot1", vectors=(_VECTOR,)),
    "prepare": messages.Prepare(task="map_merge", ballot=_BALLOT, electorate="0123456789abcdef"),
    "promise": messages.Promise(elector="robot2", task="map_merge", ballot=_BALLOT, accepted=_ACCEPTANCE),
    "accept": messages.Accept(task="map_merge", acceptance=_ACCEPTANCE, electorate="0123456789abcdef"),
    "accepted": messages.Accepted(elector="robot2", task="map_merge", ballot=_BALLOT),
    "refused": messages.Refused(
        elector="robot2", task="map_merge", ballot=_BALLOT, refusal=messages.Refusal.LEASE, promised=_BALLOT
    ),
    "learnt": messages.Learnt(node="robot2", values=(_VALUE,)),
    "move_task": messages.MoveTask(
        task="map_merge", node="edge1", asked=_ASKED, origin="edge2", base_revision=7, is_plan=True
    ),
    "hold_task": messages.HoldTask(
        task="map_merge",
        hold=messages.Hold.PIN,
        asked=_ASKED,
        node="edge1",
        is_hard=True,
        for_s=7200.0,
        base_revision=7,
    ),
    "tune_task": messages.TuneTask(task="map_merge", tuning=_TUNING, base_revision=7, asked=_ASKED),
    "explain_task": messages.ExplainTask(task="map_merge"),
    "explanation": decision.Explanation(
        node="robot1",
        kind="robot",
        task="map_merge",
        allocation=_VALUE,
        robots=("robot1", "robot2"),
        decision=_DECISION,
        age_s=0.25,
        vote=snapshot.VoteStatus(
            base_revision=6, votes=(("robot1", "edge1"),), outcome="won", winner="edge1", age_s=1.5
        ),
    ),
    "ballots": messages.Ballots(
        prepares=(messages.Prepare(task="other", ballot=_BALLOT, electorate="0a", generation_id="0a1b", number=2),),
        accepts=(
            messages.Accept(
                task="map_merge", acceptance=_ACCEPTANCE, electorate="0a", creation=1, generation_id="0a1b", number=2
            ),
        ),
    ),
    "votes": messages.Votes(
        promises=(
            messages.Promise(elector="robot2", task="map_merge", ballot=_BALLOT, accepted=_ACCEPTANCE, disk="d2"),
        ),
        accepted=(messages.Accepted(elector="robot2", task="map_merge", ballot=_BALLOT, disk="d2", joining=1),),
        refused=(
            messages.Refused(
                elector="robot2", task="other", ballot=_BALLOT, refusal=messages.Refusal.NUMBER, promised=_BALLOT
            ),
        ),
    ),
    "fleet_question": messages.FleetQuestion(
        accept=messages.Accept(
            task="lab",
            acceptance=model.Acceptance(ballot=_BALLOT, value=_FLEET_VALUE),
            electorate="0123456789abcdef",
            generation_id="0a1b",
            number=2,
        )
    ),
    "fleet_answer": messages.FleetAnswer(
        promise=messages.Promise(
            elector="robot2",
            task="lab",
            ballot=_BALLOT,
            accepted=model.Acceptance(ballot=_BALLOT, value=_FLEET_VALUE),
            disk="d2",
            joining=1,
        )
    ),
    "ask_document": messages.AskDocument(document="0d0e"),
    "document": _DOCUMENT,
    "read_fleet": messages.ReadFleet(with_document=False),
    "fleet_told": messages.FleetTold(
        node="robot1", value=_FLEET_VALUE, fleet_file="0123456789abcdef", disk="d1", content=_DOCUMENT
    ),
    "change_fleet": messages.ChangeFleet(document=_DOCUMENT, base_revision=3, reason="a third robot"),
    "restart_task": messages.RestartTask(task="map_merge"),
    "take_certificate": messages.TakeCertificate(certificate=document.Text("-----BEGIN CERTIFICATE-----")),
    "read_lines": messages.ReadLines(task="map_merge", after=12),
    "worker_lines": messages.WorkerLines(
        node="edge1",
        task="map_merge",
        lines=(messages.WorkerLine(number=13, age_s=1.5, text="merged 3 maps"),),
        newest=14,
    ),
    "read_history": messages.ReadHistory(cursor="4711:65536"),
    "history_told": messages.HistoryTold(
        node="edge1",
        now=1_790_000_100.5,
        lines=(
            decision.HistoryLine(
                at=1_790_000_000.25,
                life=3,
                task="map_merge",
                epoch=4,
                text="learnt edge1",
                move=decision.Move(epoch=4, revision=7, left="edge2", owner="edge1", reason="edge2 is gone"),
            ),
        ),
        cursor="4711:70000",
        has_more=True,
    ),
    "strike": rehearsal.Strike(task="map_merge", step=rehearsal.Step.LINK, asked=_ASKED, cut_s=5.0, is_plan=True),
    "keep_rehearsal": rehearsal.KeepRehearsal(
        task="map_merge", name="20261124-002423", body=document.Text("{}"), told="2 steps", asked=_ASKED
    ),
    "read_rehearsals": rehearsal.ReadRehearsals(task="map_merge", name="20261124-002423"),
    "rehearsals_told": rehearsal.RehearsalsTold(
        node="robot1",
        timing="wifi",
        promised=(rehearsal.Promised(step=rehearsal.Step.DAEMON, gap_s=1.75, decide_s=1.5, whole=("map_merge/in/0",)),),
        names=("20261124-002423",),
        body=document.Text("{}"),
    ),
    "command_result": messages.CommandResult(
        outcome=messages.CommandOutcome.CONFLICT, detail="the value had changed", revision=8
    ),
    "state": durable.DurableState(
        fleet="lab",
        node="robot1",
        incarnation=3,
        generation=1,
        hardware="4c4c4544",
        electorate="0123456789abcdef",
        registers=(model.RegisterState(task="map_merge", promised=_BALLOT, accepted=_ACCEPTANCE, learnt=_VALUE),),
    ),
    "status": snapshot.Snapshot(
        schema=snapshot.SCHEMA,
        version="0.1.0",
        fleet="lab",
        node="robot1",
        kind="robot",
        incarnation=3,
        up_s=90.0,
        loop_lag_s=0.005,
        quorum=snapshot.QuorumStatus(electors=3, needed=2, alive=3, ok=True, this_node="elector"),
        nodes=(_NODE_STATUS,),
        tasks=(_TASK_STATUS,),
        counters=(("frames_dropped", 2),),
        problems=("robot2 is silent",),
    ),
    "role": plan.Role(task="map_merge", role=plan.WorkerRole.DRAINING, epoch=4),
    "route_plan": plan.RoutePlan(
        task="map_merge", phase=plan.RoutePhase.FLIP, current=_SLOT, predecessors=(_SLOT, _SLOT)
    ),
    "relay_stop": relay_protocol.RelayStop(),
    "task_ended": relay_protocol.TaskEnded(task="map_merge"),
    "relay_pulse": protocol.RelayPulse(counted_s=0.5),
    "relay_greeting": protocol.RelayHello(
        protocol=3, fleet="warehouse", node="robot1", threads=12, listen="tcp/0.0.0.0:7448", tasks=("map_merge",)
    ),
    "relay_question": protocol.RelayQuestion(),
    "relay_present": protocol.RelayHere(version="1.4.0", listen="tcp/0.0.0.0:7448"),
    "relay_refused": protocol.RelayRefused(reason="it is not ours"),
    "relay_started": relay_protocol.RelayStarted(pid=4711, zid="a1b2c3"),
    "worker_seen": relay_protocol.WorkerSeen(node="edge1", task="map_merge", incarnation="3-1", is_present=True),
    "worker_watch": relay_protocol.WorkerWatch(
        task="map_merge",
        inputs=("edge1/map_merge/*/map",),
        strangers=("Nobody/map_merge/*/map",),
        services=(("edge1/map_merge/robot1/now",),),
        standbys=(_ROUTE,),
    ),
    "worker_matched": relay_protocol.WorkerMatched(
        task="map_merge", is_matched=False, is_certain=False, missing="nobody subscribes to edge1/map_merge/*/map"
    ),
    "worker_trouble": relay_protocol.WorkerTrouble(
        task="map_merge", incarnation="12300001", count=2088, text="ValueError: no such map"
    ),
    "worker_jobs": events.WorkerJobs(
        task="map_merge",
        incarnation="12300001",
        at_s=61.4,
        done=2088,
        skipped=12,
        waiting=2,
        time_s=73.08,
        cpu_s=70.9,
        wait_s=1.5,
        age_s=80.25,
        late=7,
    ),
    "frame_dropped": events.FrameDropped(kind="trouble", reason="garbage"),
    "end_marker": relay_protocol.EndMarker(epoch=4, count=1000),
    "snapshot_chunk": relay_protocol.SnapshotChunk(
        index=1, count=3, size=600_000, checksum="00112233445566778899aabbccddeeff"
    ),
    "stream_acks": relay_protocol.StreamAcks(
        acks=(
            relay_protocol.StreamAck(
                eid=7, first=3, arrived=40, processed=38, lost=1, doubled=2, reordered=1, has_gap=True
            ),
        )
    ),
    "slot_lost": relay_protocol.SlotLost(task="map_merge", epoch=3, owner="edge1", samples=12),
    "slot_ready": events.SlotReady(task="map_merge", epoch=4, is_ready=False),
    "slot_flipped": events.SlotFlipped(task="map_merge", epoch=4, replayed=3),
    "slot_drained": events.SlotDrained(task="map_merge", epoch=3),
    "role_ended": events.RoleEnded(task="map_merge", epoch=3),
    "streams_counted": events.StreamsCounted(counts=(_COUNT,)),
    "problem_reported": events.ProblemReported(source="relay", problem="target edge1 is stalled"),
}


def golden_path(kind: str) -> Path:
    """Where the golden frame of ``kind`` in this wire version lies."""
    return HERE / f"{kind}.v{wire.VERSION}.bin"


def main() -> None:
    """Write what is missing."""
    assert relay_pipe.REPORTS  # imported for its kinds
    for kind, sample in SAMPLES.items():
        path = golden_path(kind)
        if not path.exists():
            path.write_bytes(wire.encode(sample))
            print(f"wrote {path.name}")


if __name__ == "__main__":
    main()
