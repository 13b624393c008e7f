"""Benchmarks: each against a named yardstick in the same run.

    python scripts/bench.py demo --seeds 0 1 2 3 4 --json reports/demo.json
    python scripts/bench.py graph --help
    python scripts/bench.py train --quick

prints a table and, with --json, writes a report: rows (``{"name", "value", "unit", "yardstick", "goal"}``) with
command, commit, date, machine, versions and seeds. A report ages: it stays a statement about its commit.
"""

from __future__ import annotations

import argparse
import datetime
import importlib
import os
import platform
import shlex
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))

from benches.rows import ROOT, missed, text_of

BENCHES = {
    "arm": ("runs.arm", "the arm's whole run"),
    "compose": ("compose", "a composed task on MuJoCo Warp against bare steps"),
    "demo": ("runs.demo", "the pendulum's whole run for several seeds"),
    "doctor": ("doctor", "faults of deployments that the doctor names, on robots drawn at random"),
    "drift": ("drift", "how often the drift test detects and names a change of a hidden SO-101"),
    "graph": ("graph", "the compiled graph against a robot written by hand"),
    "latency-league": ("latency", "six emulated links, whose delays four methods estimate"),
    "league": ("recorded.league", "every recording, held out in parts, against mujoco.sysid, PACE and BAM"),
    "legs-identify": ("legs_identify", "hidden Go2s: the errors of identified parameters and delays"),
    "pays": ("pays", "what identification is worth: four ways to train, judged on the same hidden robots"),
    "randomise": ("hidden.randomise", "success on hidden robots by what the training was given"),
    "scaling": ("train", "training on all devices of a host against one"),
    "so101": ("runs.arm", "the SO-101's whole run"),
    "train": ("train", "PPO on the pendulum with its delays"),
    "walk": ("walk", "a walking policy on hidden twins in C MuJoCo: falls and errors"),
    "walk-delays": ("walking.delays", "falls over the true delay, by the delays that the policy was trained with"),
    "walk-train": ("walking.train", "a walking policy on one GPU: time to a policy that stays up"),
}  # fmt: skip
"""Name -> module in ``benches/`` with ``add_flags``, ``run``, ``table`` and ``QUICK`` (flags of --quick); summary."""


def module_of(bench: str) -> Any:
    """Return the module of a bench."""
    return importlib.import_module(f"benches.{BENCHES[bench][0]}")


def machine() -> dict[str, object]:
    """Return processor, cores, system and devices, on which the figures depend."""
    cpuinfo = Path("/proc/cpuinfo")
    names = [line.partition(":")[2].strip() for line in cpuinfo.read_text().splitlines() if "model name" in line] \
        if cpuinfo.is_file() else []  # fmt: skip
    model = names[0] if names else platform.processor() or platform.machine()
    description: dict[str, object] = {"cpu": model, "cores": os.cpu_count(), "system": platform.platform()}
    if "jax" in sys.modules:
        import jax

        description["devices"] = sorted({d.device_kind for d in jax.devices()})
    return description


def parse(arguments: Sequence[str]) -> tuple[Any, argparse.Namespace]:
    """Return the bench's module, and its flags."""
    wide, raw = max(map(len, BENCHES)) + 1, argparse.RawDescriptionHelpFormatter
    listed = "\n".join(f"  {name:{wide}}{summary}" for name, (_, summary) in BENCHES.items())
    every = argparse.ArgumentParser("bench.py", description=__doc__, epilog=f"benches:\n{listed}", formatter_class=raw)
    every.add_argument("bench", choices=BENCHES, metavar="BENCH", help="a bench listed below")
    every.add_argument("flags", nargs=argparse.REMAINDER, metavar="...", help="its flags: BENCH --help lists them")
    chosen = every.parse_args(arguments)
    module = module_of(chosen.bench)
    parser = argparse.ArgumentParser(
        f"bench.py {chosen.bench}", description=module.__doc__, formatter_class=raw, allow_abbrev=False
    )
    parser.set_defaults(bench=chosen.bench)
    module.add_flags(parser)
    parser.add_argument("--quick", action="store_true", help="tiny sizes: shows that it runs, measures nothing")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write a report")
    parser.add_argument("--commit", help="the commit of the code that was measured, where git does not tell it")
    if "--quick" in chosen.flags:
        parser.set_defaults(**module.QUICK)
    return module, parser.parse_args(chosen.flags)


def origin(arguments: Sequence[str], options: argparse.Namespace) -> dict[str, Any]:
    """Return what a report says about itself: command, commit, date, machine, versions, seeds and all flags."""
    from sim2real.artifacts.run import versions

    git = lambda *words: subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True).stdout  # noqa: E731
    # Reports name no folders of this machine.
    short = lambda word: Path(word).name if Path(word).is_absolute() else word  # noqa: E731
    hidden = ("bench", "quick", "json", "commit")
    flags = {n: v.name if isinstance(v, Path) else v for n, v in vars(options).items() if n not in hidden}
    seeds = {n: v for n, v in flags.items() if n in ("seed", "seeds", "first", "first_seed")}
    changed = [line[3:] for line in git("status", "--porcelain").splitlines() if not line[3:].startswith("reports/")]
    changed = [] if options.commit else changed
    return {
        "bench": options.bench,
        "command": shlex.join(["python", "scripts/bench.py", *map(short, arguments)]),
        "commit": options.commit or git("rev-parse", "HEAD").strip(),
        "date": datetime.date.today().isoformat(),
        "machine": machine(),
        "versions": versions(),
        "seeds": seeds or "fixed in the bench",
        "flags": flags,
        **({"changed since the commit": changed} if changed else {}),
        **({"quick": True} if options.quick else {}),
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one bench; return the exit code."""
    words = sys.argv[1:] if arguments is None else list(arguments)
    module, options = parse(words)
    from sim2real.artifacts.files import plain
    from sim2real.errors import Sim2RealError
    from sim2real.stages.terminal.console import table

    try:
        result = module.run(options)
    except Sim2RealError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    headers = ["name", "value", "unit", "yardstick", "goal"]
    cells = [[r.get(h) for h in headers[:-1]] + [f"{r['goal']}{', missed' * missed(r)}"] for r in result["rows"]]
    print(table(cells, headers))
    if options.quick:
        print("quick: tiny sizes, these figures measure nothing", file=sys.stderr)
    if options.json:
        options.json.parent.mkdir(parents=True, exist_ok=True)
        options.json.write_text(text_of(plain({**origin(words, options), **result})))
        print(f"wrote {options.json}", file=sys.stderr)
    return 0


if __name__ == "__main__":
    sys.exit(main())
