"""With `--ros2` each message carries rmw_zenoh's attachment: gapless numbers, one gid, the time."""

from __future__ import annotations

from zsched.core.route.ros2 import Attachment, decode_attachment
from zsched.tasks.map_merge.ros import RosPublisher


def test_numbers_are_gapless_over_what_went_out() -> None:
    sent: list[Attachment | None] = []
    answers = iter([True, False, False, True])

    def put(payload: bytes, attachment: bytes) -> bool:
        is_out = next(answers)
        if is_out:
            assert payload == b"map"
            assert len(attachment) == 33
            sent.append(decode_attachment(attachment))
        return is_out

    publisher = RosPublisher(put, clock_ns=lambda: 1_700_000_000_000_000_000)
    assert [publisher.put(b"map") for _ in range(4)] == [True, False, False, True]
    assert [one.sequence for one in sent if one is not None] == [1, 2]
    assert {one.stamp_ns for one in sent if one is not None} == {1_700_000_000_000_000_000}
    assert len({one.gid for one in sent if one is not None}) == 1
