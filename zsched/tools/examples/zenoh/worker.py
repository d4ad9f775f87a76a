"""shout, by plain zenoh: gives every question back in capitals, with the name of the machine that answers.

Any program that joins with the session of ``ZSCHED_ZENOH_CONFIG`` can do this, in any language that zenoh has.
"""

import os
import signal
import time

import zenoh

NODE = os.environ["ZSCHED_NODE"]
PREFIX = f"{NODE}/{os.environ['ZSCHED_TASK']}"


def main() -> None:
    """Answer until the daemon says stop."""
    ends: list[int] = []  # an Event may wait for itself in a signal's handler
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, _: ends.append(number))

    def on_question(question: zenoh.Sample) -> None:
        robot = str(question.key_expr).split("/")[-2]
        answer = f"{question.payload.to_string().upper()} (by {NODE})"
        # the question's time on its answer tells an old owner's answer from a new one's
        session.put(f"{PREFIX}/{robot}/answer", answer, timestamp=question.timestamp)

    with zenoh.open(zenoh.Config.from_file(os.environ["ZSCHED_ZENOH_CONFIG"])) as session:
        session.declare_subscriber(f"{PREFIX}/*/question", on_question)
        while not ends:
            time.sleep(0.2)  # a wait without an end may sleep through a signal


if __name__ == "__main__":
    main()
