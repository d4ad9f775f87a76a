"""shout: gives every question back in capitals, with the name of the machine that answers, to the robot that asked."""

from zsched.worker import Output, Received, Worker


def main() -> None:
    """Answer until the daemon says stop."""
    outputs: dict[str, Output] = {}

    def on_question(question: Received) -> None:
        robot = question.key.split("/")[-2]
        if robot not in outputs:
            outputs[robot] = worker.publisher(f"{{prefix}}/{{epoch}}/{robot}/answer", reliable=True)
        here = worker.prefix.split("/")[0]
        outputs[robot].put(f"{question.payload.to_string().upper()} (by {here})".encode())

    with Worker.from_env(standalone="shout") as worker:  # leaving it closes the session
        worker.subscribe("{prefix}/*/question", on_question)
        worker.ready()
        while worker.wait(1.0):
            pass


if __name__ == "__main__":
    main()
