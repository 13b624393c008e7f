"""Benchmarks: each against a named yardstick in the same run.

    python scripts/bench.py demo --seeds 0 1 2 3 4 --json reports/demo.json
    python scripts/bench.py graph --help
    python scripts/bench.py train --quick
    python scripts/bench.py all --list

prints a table and, with --json, writes a report: rows (``{"name", "value", "unit", "yardstick", "goal"}``), flags,
machine, versions, and the state of the code that was measured. ``all`` measures every report of ``reports/`` that this
machine can.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import platform
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))

from benches.catalogue import BENCHES, measures
from benches.provenance import ROOT, state


def machine() -> dict[str, object]:
    """Return processor, cores, system and devices, on which the figures depend."""
    model = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.is_file():
        names = [line.split(":", 1)[1].strip() for line in cpuinfo.read_text().splitlines() if "model name" in line]
        model = names[0] if names else model
    description = {"cpu": model, "cores": os.cpu_count(), "system": platform.platform()}
    if "jax" in sys.modules:
        import jax

        description["devices"] = sorted({d.device_kind for d in jax.devices()})
    return description


def parse(arguments: Sequence[str] | None) -> tuple[Any, argparse.Namespace]:
    """Return the bench's module, and its flags."""
    wide = max(map(len, BENCHES)) + 1
    listed = "\n".join(f"  {name:{wide}}{about.summary}" for name, about in BENCHES.items())
    raw = argparse.RawDescriptionHelpFormatter
    every = argparse.ArgumentParser(
        prog="bench.py", description=__doc__, epilog=f"benches:\n{listed}", formatter_class=raw
    )
    every.add_argument("bench", choices=BENCHES, metavar="BENCH", help="a bench listed below")
    every.add_argument(
        "flags", nargs=argparse.REMAINDER, metavar="...", help="flags of the bench: BENCH --help lists them"
    )
    chosen = every.parse_args(arguments)
    module = importlib.import_module(f"benches.{BENCHES[chosen.bench].module}")
    parser = argparse.ArgumentParser(
        prog=f"bench.py {chosen.bench}", description=module.__doc__, formatter_class=raw, allow_abbrev=False
    )
    parser.set_defaults(bench=chosen.bench)
    module.add_flags(parser)
    parser.add_argument(
        "--quick", action="store_true", help="tiny sizes, in seconds: shows that it runs, measures nothing"
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write a report")
    parser.add_argument("--commit", help="the commit of this copy of the code, where the copy has no git history")
    if "--quick" in chosen.flags:
        parser.set_defaults(**module.QUICK)
    return module, parser.parse_args(chosen.flags)


def measure_all(arguments: Sequence[str]) -> int:
    """Measure every report of a folder that this machine can, or list them."""
    parser = argparse.ArgumentParser(prog="bench.py all", description=measure_all.__doc__, allow_abbrev=False)
    parser.add_argument("--list", action="store_true", help="list the reports with machine, commit and state")
    parser.add_argument("--only", nargs="+", metavar="REPORT", help="these reports; default: all")
    parser.add_argument("--data", type=Path, metavar="DIR", help="folder of the public recordings")
    parser.add_argument("--reports", type=Path, default=ROOT / "reports", metavar="DIR", help="folder of the reports")
    parser.add_argument("--quick", action="store_true", help="tiny sizes: shows that the benches run")
    options = parser.parse_args(arguments)
    import jax
    from benches.all_reports import listed, plans
    from benches.all_reports import measure_all as measured

    from sim2real.stages.terminal.console import table

    kinds = sorted({d.device_kind for d in jax.devices()})
    module_of = lambda bench: importlib.import_module(f"benches.{BENCHES[bench].module}")  # noqa: E731
    rows = [p for p in plans(options.reports, module_of, options.data, kinds)
            if not options.only or p.report.stem in options.only]  # fmt: skip
    if options.only and (unknown := sorted(set(options.only) - {p.report.stem for p in rows})):
        parser.error(f"{options.reports} has no report {unknown[0]}")
    if options.list:
        print(table(listed(rows), ["report", "measured on", "commit", "state", "here"]))
        return 0
    return measured(rows, main, options.quick)


def reported_flags(flags: Mapping[str, Any]) -> dict[str, Any]:
    """Return flags as in a report: paths without their folders."""
    return {name: value.name if isinstance(value, Path) else value for name, value in flags.items()}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one bench, or all; return the exit code."""
    words = sys.argv[1:] if arguments is None else list(arguments)
    if words[:1] == ["all"]:
        return measure_all(words[1:])
    module, options = parse(arguments)
    from sim2real.artifacts.run.manifest import plain, versions
    from sim2real.errors import Sim2RealError
    from sim2real.stages.terminal.console import table

    flags = {n: v for n, v in vars(options).items() if n not in ("bench", "quick", "json", "commit")}
    about = {"bench": options.bench, "quick": options.quick, "flags": flags}
    # Take the state of the code before the run, as files may be edited during a long one.
    about |= state(measures(options.bench, flags), ROOT, options.commit)
    try:
        result = module.run(options)
    except Sim2RealError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    headers = ["name", "value", "unit", "yardstick", "goal"]
    print(table([[row.get(h) for h in headers] for row in result["rows"]], headers))
    if options.quick:
        print("quick: tiny sizes, these figures measure nothing", file=sys.stderr)
    if options.json:
        options.json.parent.mkdir(parents=True, exist_ok=True)
        document = plain(
            {**about, "flags": reported_flags(flags), "machine": machine(), "versions": versions(), **result}
        )
        options.json.write_text(json.dumps(document, indent=1) + "\n")
        print(f"wrote {options.json}", file=sys.stderr)
    return 0


if __name__ == "__main__":
    sys.exit(main())
