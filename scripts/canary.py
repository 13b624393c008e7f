"""The canary: short benches with fixed seeds, beside the committed rows: ``python scripts/canary.py [--data DIR]``.

Takes 10 to 15 minutes on two cores. A row is red if it leaves its tolerance around the committed value, or if it has no
tolerance and misses its goal. Exits with 1 if a row is red; it blocks nothing.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Mapping
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))

import bench
from benches.rows import ROOT, missed

Tolerances = Mapping[str, tuple[str, float]]
"""Pattern of rows -> ``within`` or ``less by`` a difference from the committed value, or ``times`` as large at most."""
RUN: Tolerances = {"*/total_s": ("times", 2.0), "*/round_trip_error_ms": ("within", 1.5), "*_error": ("within", 3.0)}
CASES: tuple[tuple[str, str, Tolerances], ...] = (
    (
        "demo --seeds 0 --no-nominal",
        "demo",
        {**RUN, "*/prediction_over_true_model": ("within", 0.15), "*/upright/identified": ("less by", 0.1)},
    ),
    (
        "arm --seeds 0 --no-nominal",
        "arm_cpu",
        {**RUN, "*/held_out_mae_mrad": ("times", 1.5), "*/reached/identified": ("less by", 2.0)},
    ),
    ("league --entrants ours --folds 1 --sets disk xl330 so101", "league", {"*/worst": ("times", 1.15)}),
)
"""Command, report, tolerances: the first pattern that a row's name matches."""


def numbers(value: Any) -> list[float]:
    """Return a row's value as a list of numbers."""
    values = value if isinstance(value, list) else [value]
    return [float(v) for v in values if isinstance(v, int | float)]


def why_red(row: Mapping[str, Any], committed: Mapping[str, Any] | None, tolerances: Tolerances) -> str:
    """Return the reason why a row is red; "" if it is not."""
    chosen = next((t for pattern, t in tolerances.items() if fnmatch(row["name"], pattern)), None)
    if chosen is None or committed is None:
        return f"misses its goal {row['goal']}" if missed(row) else ""
    how, size = chosen
    # Of a list of seeds, the first ones run here.
    for new, old in zip(numbers(row["value"]), numbers(committed["value"]), strict=False):
        off = {"within": abs(new - old) - size, "less by": old - new - size, "times": new - size * old}[how]
        if not off <= 0:
            return f"committed: {old:g}; tolerance: {how} {size:g}"
    return ""


def main() -> int:
    """Run the benches; print red rows."""
    parser = argparse.ArgumentParser("canary.py", description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder of the public recordings; without it, no league")
    options, red = parser.parse_args(), []
    with tempfile.TemporaryDirectory() as folder:
        for command, name, tolerances in CASES:
            words, new = command.split(), Path(folder) / "report.json"
            if words[0] == "league":
                if options.data is None:
                    continue
                words += ["--data", str(options.data)]
            try:
                why = f"ended with exit code {code}" if (code := bench.main([*words, "--json", str(new)])) else ""
            except Exception as error:  # the other benches still run
                why = f"{type(error).__name__}: {error}"
            if why:
                red.append((command, "", why))
                continue
            old = json.loads((ROOT / "reports" / f"{name}.json").read_text())["rows"]
            committed = {row["name"]: row for row in old}
            reasons = [
                (r, why_red(r, committed.get(r["name"]), tolerances)) for r in json.loads(new.read_text())["rows"]
            ]
            red += [(row["name"], row["value"], why) for row, why in reasons if why]
    for row in red:
        print("red:", *row)
    print(f"{len(red)} red rows", file=sys.stderr)
    return 1 if red else 0


if __name__ == "__main__":
    sys.exit(main())
