"""The page's own functions, run by node where there is one."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest

from zsched.tools.watch import web
from zsched.tools.watch.web import PING_S

SCRIPT = (Path(web.__file__).parent / "page" / "page.js").read_text(encoding="utf-8")
SILENT = re.compile(r"SILENT_MS = (\d+);")
RUN = """
const says = (text) => new TextEncoder().encode(text);
const fetch = async (path, { signal }) => ({ ok: true, status: 200, body: { getReader: () => ({
  isFirst: true,
  read() {
    if (this.isFirst) { this.isFirst = false; return Promise.resolve({ value: says("event: now\\ndata: {}\\n\\n") }); }
    return new Promise((_, fail) => signal.addEventListener("abort", () => fail(signal.reason)));
  },
}) } });
let words = 0;
const SILENT_MS = 200, byId = () => ({}), bearer = () => ({}), takers = { now() { words += 1; } };
FUNCTIONS
listen().then(() => console.log("ended"), (error) => console.log(`${words} words, then: ${error.message}`));
"""


def test_the_page_waits_longer_than_the_server_is_silent() -> None:
    (silent_ms,) = SILENT.findall(SCRIPT)
    assert PING_S < int(silent_ms) / 1000 < 2 * PING_S


@pytest.mark.skipif(shutil.which("node") is None, reason="no node here (Debian: nodejs)")
def test_a_server_that_falls_silent_without_an_end_is_left() -> None:
    """A machine without power, or a tunnel that hangs: the page showed its last word as fresh, for good."""
    functions = SCRIPT[SCRIPT.index("async function listen()") : SCRIPT.index("async function live()")]
    said = subprocess.run(
        ["node", "-e", RUN.replace("FUNCTIONS", functions)], capture_output=True, text=True, timeout=30, check=False
    )
    assert said.stdout == "1 words, then: no word for 0.2 s\n", said.stderr
