"""The page's pictures in the documents, of a real fleet: ``docs/img/web.png`` and ``docs/img/web-phone.png``.

``python -m benchmarks.pictures [--out docs/img] [--seconds 90]``. Three robots, three edges, two tasks on this machine;
robots have the signals that the file gives them. Tasks are moved while the page is open; then a headless Chromium takes
the pictures at the width of a desk and of a phone. Beside them it prints `zsched top` as 80x24 and 120x40 show it, and,
where Prometheus is installed, what each panel of the Grafana dashboard gets from it.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from functools import partial
from pathlib import Path

from PIL import Image

REPO = Path(__file__).parents[1]
sys.path.insert(0, str(REPO / "tests"))
from benchmarks.panels import PROMETHEUS, answers, prometheus  # noqa: E402 - as above
from benchmarks.web import web_server  # noqa: E402 - as above
from support import browser  # noqa: E402 - as above
from zsched_lab.fleet.pace import at_pace  # noqa: E402 - the browser is the tests'
from zsched_lab.fleet.testbed import TASK, Json, Testbed, echo_fleet  # noqa: E402 - as above

SIGNALS = {"robot1": (-57, -61, -65), "robot2": (-66, -70, -74), "robot3": (-73, -77, -81)}
"""dBm of each robot to each edge."""
SIZES = {"web": (1280, 1180), "web-phone": (390, 1250)}
SCREENS = ((80, 24), (120, 40))
WAIT_S = 60.0


def fleet() -> Json:
    """The fleet file."""
    tree = echo_fleet(scheduling={"bonus": 0.3})
    for name, signals in SIGNALS.items():
        node = tree["nodes"][name]
        del node["wired"]
        node["links"] = {f"edge{number}": {"fixed": dbm} for number, dbm in enumerate(signals, 1)}
        node["fixed"] = signals[0]
    tree["tasks"]["detect"] = {
        **tree["tasks"][TASK],
        "inputs": [{"from": "{robot}/scan", "to": "{target}/detect/{robot}/in"}],
        "outputs": [{"from": "{target}/detect/{epoch}/{robot}/out", "to": "{robot}/boxes"}],
    }
    return tree


def zsched(bed: Testbed, *words: str, columns: int = 100, lines: int = 40) -> str:
    """What a verb prints, asked of robot1."""
    command = [sys.executable, "-m", "zsched.cli", *words, "--runtime-dir", str(bed.folder), "--node", "robot1"]
    size = {"COLUMNS": str(columns), "LINES": str(lines)}
    done = subprocess.run(command, capture_output=True, text=True, timeout=WAIT_S, check=False, env=os.environ | size)
    return done.stdout + done.stderr


def taken(bed: Testbed, seconds: float, folder: Path) -> list[Path]:
    """Move tasks for this time, then take the pictures."""
    found = []
    with ExitStack() as stack:
        _, (host, port) = stack.enter_context(web_server(str(bed.folder)))
        page = stack.enter_context(browser.browsing(bed.folder))
        scraped = stack.enter_context(prometheus(bed.folder, f"{host}:{port}")) if PROMETHEUS else ""
        page.open(f"http://{host}:{port}/", *SIZES["web"])
        page.wait_for("document.body.innerText.includes('fleet testbed')")
        for task, edge in ((TASK, "edge2"), ("detect", "edge3"), (TASK, "edge1")):
            time.sleep(seconds / 4)
            zsched(bed, "move", task, edge, "--yes")
        time.sleep(seconds / 4)
        for name, size in SIZES.items():
            page.open(f"http://{host}:{port}/", *size)
            page.wait_for("document.querySelectorAll('#tasks path').length >= 3")
            time.sleep(2.0)
            page.picture(folder / f"{name}.png")
            found.append(folder / f"{name}.png")
        print(*(answers(scraped) if scraped else ["no Prometheus here: panels are not asked"]), sep="\n")
    return found


def main() -> None:
    """Take both pictures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=REPO / "docs/img")
    parser.add_argument("--seconds", type=float, default=90.0)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as name, Testbed(Path(name), fleet()) as bed, ExitStack() as stack:
        bed.init()
        bed.start()
        bed.wait_settled(WAIT_S)
        app = bed.app("robot1")
        for key, hz, size in (("robot1/in", 20.0, 400), ("robot1/scan", 5.0, 4000)):
            publisher = app.declare_publisher(key)
            stack.enter_context(at_pace(hz, partial(publisher.put, b"1" * size)))
        for file in taken(bed, given.seconds, given.out):
            Image.open(file).convert("RGB").quantize(256, Image.Quantize.MAXCOVERAGE).save(file, optimize=True)
            print(file)
        for columns, lines in SCREENS:
            print(f"--- top, {columns}x{lines}", zsched(bed, "top", "--once", columns=columns, lines=lines), sep="\n")


if __name__ == "__main__":
    main()
