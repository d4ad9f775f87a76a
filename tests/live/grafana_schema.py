"""Holds the dashboard that is shipped against Grafana's own types, which npm has as @grafana/schema.

    .venv/bin/python tests/live/grafana_schema.py

TypeScript's compiler says whether the whole dashboard, and the options of each panel by its kind, are what the newest
Grafana writes itself. Needs node, npm and a registry; where they are missing it says `skipped` with why, and ends
with 0; with 1 when the dashboard does not fit. It says nothing of how Grafana draws a panel. CI does not run it.
"""

from __future__ import annotations

import copy
import json
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

DASHBOARD = Path(__file__).parents[2] / "configs/grafana/dashboards/zsched.json"
KINDS = {"stat": "stat", "timeseries": "timeseries", "state-timeline": "statetimeline"}
"""{a panel's type: the folder of its options' types}."""
PLUGINS_OWN = {"annotations": ("expr", "titleFormat", "step"), "templating": ("definition",)}
"""What the plug-in for Prometheus reads, which Grafana's schema has no place for."""
OPTIONS = ["--noEmit", "--strict", "--skipLibCheck", "--moduleResolution", "bundler", "--module", "esnext"]
HEAD = """import type { Dashboard } from "@grafana/schema";
type J<T> = T extends string ? `${T}` : T extends number | boolean | null | undefined ? T
  : T extends (infer U)[] ? J<U>[] : T extends object ? { [K in keyof T]: J<T[K]> } : T;
"""
"""JSON has texts where TypeScript has members of an enum."""
TIMEOUT_S = 300.0


def as_typescript(dashboard: dict[str, Any]) -> str:
    """A program that compiles if the dashboard fits."""
    whole = copy.deepcopy(dashboard)
    for block, names in PLUGINS_OWN.items():
        for one in whole[block]["list"]:
            for name in names:
                one.pop(name, None)
    lines = [
        f'import type * as {kind} from "./node_modules/@grafana/schema/dist/types/raw/composable/{kind}/panelcfg/x/'
        'types.gen";'
        for kind in KINDS.values()
    ]
    for number, panel in enumerate(dashboard["panels"]):
        kind = KINDS[panel["type"]]
        lines.append(f"// {panel['title']}")
        lines.append(f"const options{number}: J<Partial<{kind}.Options>> = {json.dumps(panel['options'])};")
        drawn = panel["fieldConfig"]["defaults"].get("custom")
        if drawn is not None and kind != "stat":
            lines.append(f"const drawn{number}: J<Partial<{kind}.FieldConfig>> = {json.dumps(drawn)};")
    return "\n".join([HEAD, *lines, f"export const dashboard: J<Dashboard> = {json.dumps(whole, indent=1)};"])


def misfits(folder: Path, dashboard: dict[str, Any]) -> list[str]:
    """What the compiler says, a line each."""
    (folder / "dashboard.ts").write_text(as_typescript(dashboard), encoding="utf-8")
    done = run(folder, "node_modules/.bin/tsc", *OPTIONS, "--target", "es2020", "dashboard.ts")
    return [line for line in done.stdout.splitlines() if line.strip()]


def run(folder: Path, *command: str) -> subprocess.CompletedProcess[str]:
    """A program in the folder."""
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=TIMEOUT_S, check=False)


def main() -> int:
    """Fetch the types, and compile."""
    if shutil.which("npm") is None or shutil.which("node") is None:
        print("skipped: node and npm are not installed")
        return 0
    dashboard = json.loads(DASHBOARD.read_text(encoding="utf-8"))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "package.json").write_text("{}")
        packages = ("@grafana/schema@latest", "typescript@5")
        fetched = run(folder, "npm", "install", "--no-audit", "--no-fund", "--ignore-scripts", *packages)
        if fetched.returncode != 0:
            print(f"skipped: npm does not give {' and '.join(packages)}: {fetched.stderr.strip()[-300:]}")
            return 0
        told = json.loads((folder / "node_modules/@grafana/schema/package.json").read_text())["version"]
        found = misfits(folder, dashboard)
        planted = copy.deepcopy(dashboard)
        planted["panels"][0]["options"]["zsched"] = planted["panels"][0]["gridPos"]["w"] = "wide"
        if len(misfits(folder, planted)) < len(found) + 2:
            found.append("the compiler takes a dashboard with two planted faults")
    print("\n".join([*found, f"@grafana/schema {told}: {len(dashboard['panels'])} panels, {len(found)} misfits"]))
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
