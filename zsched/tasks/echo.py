"""The reference echo worker: every input sample goes back to its robot, payload and attachment unchanged.

Knows: `zsched.worker`. Does not know: what is in a payload; tests and benchmarks put sequence numbers there and count
lost, doubled and reordered ones at the application.

``{node}/{task}/<name>/in`` comes back as ``{node}/{task}/<epoch>/<name>/out``, with the node's name as the schema of
its encoding (so that a receiver can tell who answered). Rules for it::

    inputs:  [{from: "{robot}/in", to: "{target}/echo/{robot}/in", class: reliable}]
    outputs: [{from: "{target}/echo/{epoch}/{robot}/out", to: "{robot}/out", class: reliable, handover: all}]

It also answers requests to ``{node}/{task}/<name>/ask`` with their own payload, attachment and its node's name::

    services: [{from: "{robot}/ask", to: "{target}/echo/{robot}/ask"}]

``python -m zsched.tasks.echo [--latest] [--delay-ms N] [--standalone]``
"""

from __future__ import annotations

import argparse
import sys
import time

from zsched.core.values.errors import ConfigError
from zsched.core.values.exits import EXIT_CONFIG
from zsched.worker import Answer, Output, Received, Request, Worker


def main(arguments: list[str] | None = None) -> int:
    """Run the worker until it is told to stop; the exit code."""
    options = _options(arguments)
    try:
        worker = Worker.from_env(standalone="echo" if options.standalone else "")
    except ConfigError as error:
        print(f"echo: {error}", file=sys.stderr)
        return EXIT_CONFIG
    with worker:
        echo = Echo(worker, latest=options.latest, delay_s=options.delay_ms / 1000)
        worker.subscribe("{prefix}/*/in", echo.on_sample, keep_last=None, depth=100_000)
        worker.serve("{prefix}/*/ask", echo.on_request, depth=256)
        worker.ready()
        while worker.wait(1.0):
            pass
    return 0


class Echo:
    """One output per name, declared when its first input comes."""

    def __init__(self, worker: Worker, *, latest: bool, delay_s: float) -> None:
        self._worker = worker
        self._is_latest = latest
        self._delay_s = delay_s
        self._outputs: dict[str, Output] = {}
        self._encoding = f"application/octet-stream;{worker.prefix.split('/')[0]}"

    def on_sample(self, received: Received) -> None:
        """Send one sample back."""
        if self._delay_s:
            time.sleep(self._delay_s)
        name = received.key.split("/")[-2]
        output = self._outputs.get(name)
        if output is None:
            template = f"{{prefix}}/{{epoch}}/{name}/out"
            output = self._worker.publisher(template, latest=self._is_latest, reliable=not self._is_latest)
            self._outputs[name] = output
        output.put(received.payload, attachment=received.attachment, encoding=self._encoding)

    def on_request(self, request: Request) -> Answer:
        """Answer a request with what is in it."""
        if self._delay_s:
            time.sleep(self._delay_s)
        return Answer(payload=request.payload or b"", attachment=request.attachment, encoding=self._encoding)


def _options(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m zsched.tasks.echo", description="zsched's reference echo worker")
    parser.add_argument("--latest", action="store_true", help="outputs of class latest (default: reliable)")
    parser.add_argument("--delay-ms", type=float, default=0.0, help="work this long on each sample")
    parser.add_argument("--standalone", action="store_true", help="without a daemon: owner on zenoh's default session")
    return parser.parse_args(arguments)


if __name__ == "__main__":
    sys.exit(main())
