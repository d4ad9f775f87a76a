"""An application on robot1: asks twice a second and prints the answers. It knows nothing of zsched.

``python ask.py [ENDPOINT]``; without one it joins where a robot's relay listens for its own host.
In a secured fleet that is the robot's local side, as ``zsched status -v`` names it (``tcp/127.0.0.1:7460``).
"""

import itertools
import json
import sys
import time

import zenoh

ENDPOINT = sys.argv[1] if len(sys.argv) > 1 else "tcp/127.0.0.1:7458"
CONFIG = {
    "mode": "client",
    "connect": {"endpoints": [ENDPOINT]},
    "scouting": {"multicast": {"enabled": False}},
    # zenoh's default does not open where a container may lock no memory; it may stand still for a minute
    "transport": {"shared_memory": {"enabled": False}, "link": {"tx": {"lease": 60_000}}},
}


def main() -> None:
    """Ask until Ctrl-C."""
    with zenoh.open(zenoh.Config.from_json5(json.dumps(CONFIG))) as session:
        session.declare_subscriber("robot1/answer", lambda answer: print(answer.payload.to_string(), flush=True))
        questions = session.declare_publisher("robot1/question", congestion_control=zenoh.CongestionControl.BLOCK)
        for number in itertools.count():
            questions.put(f"question {number}")
            time.sleep(0.5)


if __name__ == "__main__":
    try:
        main()
    except KeyboardInterrupt:
        pass
    except zenoh.ZError as error:
        sys.exit(f"nobody listens at {ENDPOINT}; `zsched dev` prints the endpoint: {error}")
