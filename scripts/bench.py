"""Benchmarks: each against a named yardstick in the same run.

    python scripts/bench.py demo --seeds 0 1 2 3 4 --json reports/demo.json

prints a table and writes machine, versions and rows: ``{"name", "value", "unit", "yardstick", "goal"}``.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import platform
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))

BENCHES = {
    "arm": "arm_demo",
    "async": "asynchronous",
    "compose": "compose",
    "demo": "demo",
    "graph": "graph",
    "identify": "identify",
    "train": "train",
}


def machine() -> dict[str, Any]:
    """Return what the figures depend on."""
    model = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.is_file():
        names = [line.split(":", 1)[1].strip() for line in cpuinfo.read_text().splitlines() if "model name" in line]
        model = names[0] if names else model
    return {"cpu": model, "cores": os.cpu_count(), "system": platform.platform()}


def main() -> int:
    """Run one bench."""
    from sim2real.stages.console import table
    from sim2real.stages.manifest import versions

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bench", choices=BENCHES)
    parser.add_argument("--json", type=Path, help="write the rows, machine and versions to this file")
    known, rest = parser.parse_known_args()
    result = importlib.import_module(f"benches.{BENCHES[known.bench]}").main(rest)
    headers = ["name", "value", "unit", "yardstick", "goal"]
    print(table([[row.get(h) for h in headers] for row in result["rows"]], headers))
    if known.json:
        known.json.parent.mkdir(parents=True, exist_ok=True)
        document = {"machine": machine(), "versions": versions(), **result}
        known.json.write_text(json.dumps(document, indent=1) + "\n")
        print(f"wrote {known.json}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
