"""A daemon's operator socket, behind which recorded statuses answer.

Knows: the requests of verbs. Does not know: verbs.
"""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any, Self

from zsched.host.operator_socket import OperatorSocket

RECORDED = Path(__file__).parents[1] / "unit" / "commands" / "recorded_status"
Json = dict[str, Any]


class Daemon:
    """An operator socket in ``folder`` that answers like a daemon, and remembers what it was asked."""

    def __init__(self, folder: Path, node: str = "robot1", status: str = "healthy") -> None:
        self.status: Json = json.loads((RECORDED / f"{status}.json").read_text())
        self.result: Json = {"outcome": "ok", "detail": "committed", "revision": 2}
        self.asked: list[Json] = []
        self.delay_s = 0.0
        self.lines: list[Json] = []
        self.is_here = True
        self._socket = OperatorSocket(folder / f"{node}.sock", self._answer)

    def _answer(self, request: Json) -> Json:
        self.asked.append(request)
        time.sleep(self.delay_s)
        if request["verb"] in ("tune", "restart"):
            return self.result
        if request["verb"] == "lines":
            lines = [one for one in self.lines if one["number"] > request["after"]][:2]
            newest = max((one["number"] for one in self.lines), default=0)
            return {"node": request["node"], "task": "echo", "lines": lines, "newest": newest, "is_here": self.is_here}
        if "error" in self.status:
            return self.status
        return {**self.status, "node": request.get("node", self.status["node"])}

    def __enter__(self) -> Self:
        self._socket.open()
        return self

    def __exit__(self, *_error: object) -> None:
        self._socket.close()
