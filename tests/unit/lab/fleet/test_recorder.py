from __future__ import annotations

from pathlib import Path

from zsched_lab.fleet.recorder import Follower, Recorder, read_records


def test_what_is_written_is_read(tmp_path: Path) -> None:
    with Recorder(tmp_path / "records") as recorder:
        recorder.write("robot1", {"kind": "map", "t_s": 1.5})
        recorder.write("robot1", {"kind": "map", "t_s": 2.5})
        recorder.write("events", {"kind": "move"})
        # Still open: an interrupted run keeps what was written so far.
        assert [record["t_s"] for record in read_records(tmp_path / "records" / "robot1.ndjson")] == [1.5, 2.5]

    assert read_records(tmp_path / "records" / "events.ndjson") == [{"kind": "move"}]


def test_follower_gives_each_whole_line_once_and_skips_damaged_ones(tmp_path: Path) -> None:
    path = tmp_path / "a.ndjson"
    follower = Follower(path)
    assert follower.new() == []
    path.write_bytes(b'{"n":1}\n{"n":2')
    assert follower.new() == [{"n": 1}]
    assert follower.new() == []
    with path.open("ab") as file:
        file.write(b'}\nnot json\n[1]\n{"n":3}\n')
    assert follower.new() == [{"n": 2}, {"n": 3}]
