"""The dashboard's panels without Grafana: Prometheus scrapes a page's server and answers what each panel asks.

Knows: the dashboard file, Prometheus' process and its HTTP interface. Does not know: which fleet is shown, Grafana.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import time
import urllib.parse
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from zsched_lab.fleet.loopback import free_endpoint

DASHBOARD = Path(__file__).parents[1] / "configs/grafana/dashboards/zsched.json"
PROMETHEUS = shutil.which("prometheus")
SCRAPE_S = 2
START_S = 30.0
VARIABLES = {"$__rate_interval": "30s", "$__interval": "5s", "$__range": "1h", "$instance": ".*"}


@contextmanager
def prometheus(folder: Path, target: str) -> Iterator[str]:
    """A Prometheus that scrapes ``target`` (address:port); where it answers. It must be installed."""
    host, _, port = free_endpoint().removeprefix("tcp/").rpartition(":")
    file = folder / "prometheus.yml"
    job = {"job_name": "zsched", "static_configs": [{"targets": [target]}]}
    file.write_text(json.dumps({"global": {"scrape_interval": f"{SCRAPE_S}s"}, "scrape_configs": [job]}))
    command = [str(PROMETHEUS), f"--config.file={file}", f"--storage.tsdb.path={folder / 'series'}"]
    with subprocess.Popen([*command, f"--web.listen-address={host}:{port}"], stderr=subprocess.DEVNULL) as process:
        try:
            yield f"http://{host}:{port}"
        finally:
            process.terminate()


def answers(place: str) -> Iterator[str]:
    """For each panel: how many series its questions have, and their newest figures."""
    for panel in json.loads(DASHBOARD.read_text())["panels"]:
        for target in panel["targets"]:
            expression = target["expr"]
            for name, value in VARIABLES.items():
                expression = expression.replace(name, value)
            found = asked(place, expression)
            figures = ", ".join(f"{float(one['value'][1]):.4g}" for one in found[:6])
            yield f"{panel['title']:<36} {len(found):3} series  {figures}"


def asked(place: str, expression: str) -> list[dict[str, Any]]:
    """The instant vector of an expression; Prometheus is waited for."""
    until = time.monotonic() + START_S
    while True:
        try:
            words = urllib.parse.urlencode({"query": expression})
            with urllib.request.urlopen(f"{place}/api/v1/query?{words}", timeout=START_S) as answer:  # noqa: S310 - loopback
                body: dict[str, Any] = json.load(answer)
        except OSError:
            if time.monotonic() > until:
                raise
            time.sleep(0.2)
        else:
            result: list[dict[str, Any]] = body["data"]["result"]
            return result
