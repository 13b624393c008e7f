"""Falls and errors over the true delay, with pushes: of policies trained without, with wide and with identified delays.

All trainings have the same steps and settings, noise, pushes and starts. ``nominal`` has one robot and no delay.
``wide`` draws the pipeline's parameters, and delays of 0 to 46 ms. ``identified_30`` draws the same parameters, and
delays around the estimate of `identify` from the log of an emulated Go2 with a delay of 30 ms. ``shipped`` is the
pipeline's policy.
"""

from __future__ import annotations

import argparse
import json
import shlex
import shutil
import tempfile
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from benches.jobs import each
from benches.rows import Report, share
from benches.walk import Trial, judged
from benches.walking.train import PIPELINE, add_training_flags, require_gpu, train

QUICK = {"policies": ["shipped"], "delays_ms": [10.0], "twins": 1, "seconds": 0.2, "push": 0.1}
SHIPPED, IDENTIFIED = "shipped", "identified_"
WIDE_MS = {"sensor_delay": (0.0, 4.0), "actuator_delay": (0.0, 42.0)}
SEED, STAND_S = 37, 12.0
"""The emulated Go2 of the logs, and the length of their excitation [s]."""


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of this bench."""
    add_training_flags(parser)
    delays = (0.0, 10.0, 20.0, 30.0, 40.0)
    parser.add_argument("--policies", nargs="+", help="nominal, wide, shipped, identified_MS; default: all but shipped")
    parser.add_argument("--delays-ms", type=float, nargs="*", default=delays, help="true delays of all twins [ms]")
    parser.add_argument("--work", type=Path, help="folder of estimates and policies; those in it are used again")
    parser.add_argument("--jobs", type=int, default=1, help="identifications at once")
    parser.add_argument("--trainings", type=int, default=1, help="trainings at once, which share the GPU")
    parser.add_argument("--steps", type=int, default=60_000_000, help="steps of each training")


def run(options: argparse.Namespace) -> Report:
    """Identify delays, train policies, and judge them at all delays; finished parts in the folder are used again."""
    of_delays = [f"{IDENTIFIED}{ms:g}" for ms in options.delays_ms]
    names = options.policies or ["nominal", "wide", *of_delays]
    with tempfile.TemporaryDirectory() as scratch:
        work = options.work or Path(scratch)
        work.mkdir(parents=True, exist_ok=True)
        # Identify what the policies need, then train those that are missing.
        needed = sorted(float(name.removeprefix(IDENTIFIED)) for name in names if name.startswith(IDENTIFIED))
        estimates = {ms: work / f"estimate_{ms:g}.json" for ms in needed}
        missing = [(ms, str(file)) for ms, file in estimates.items() if not file.is_file()]
        for _ in each(estimate, missing, options):
            pass
        identified = {ms: json.loads(file.read_text()) for ms, file in estimates.items()}
        new = [name for name in names if name != SHIPPED and not (work / name / "training.json").is_file()]
        device = require_gpu("walk-delays") if new else ""
        with ThreadPoolExecutor(options.trainings) as pool:
            list(pool.map(lambda name: trained(name, device, identified, work, options), new))
        # Judge all of them at all delays.
        rows, trainings = [], {}
        for name in names:
            bundle = None if name == SHIPPED else work / name / "bundle"
            trials = {
                f"{ms:g}_ms": Trial(PIPELINE, bundle, options.seconds, options.push, delay_s=ms / 1e3)
                for ms in options.delays_ms
            }
            rows += judged(trials, options.twins, f"walk_delays/{name}", goals=False)
            if bundle is not None:
                trainings[name] = json.loads((work / name / "training.json").read_text())
    return {"rows": rows, "estimates": list(identified.values()), "trainings": trainings}


def estimate(ms: float, file: str, options: argparse.Namespace) -> dict[str, Any]:
    """Write the delay that `identify` estimates from the log of an emulated Go2 with a true delay [ms]."""
    from benches.hidden import legs
    from sim2real.artifacts.identification import ROUND_TRIP
    from sim2real.stages.identify.stage import identify

    del options
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "session.mcap"
        legs.record(log, SEED, STAND_S, (ms / 3e3, ms / 1.5e3, 0.0))
        identification = identify(PIPELINE, log)
    delay = next(p for p in identification.parameters if p.name == ROUND_TRIP)
    delay_row = {"true_ms": ms, "estimate_ms": 1e3 * delay.estimate, "verdict": identification.verdict.status}
    delay_row["deviation_ms"] = 1e3 * (delay.standard_error or 0.0)
    Path(file).write_text(json.dumps(delay_row, indent=1))
    return delay_row


def differences(name: str, estimates: Mapping[float, Mapping[str, float]]) -> list[str]:
    """Return the flags of the parameters and delays that differ between the episodes of a policy's training."""
    from sim2real.stages.load import load_robot

    if name.startswith(IDENTIFIED):
        # A uniform draw within sqrt(3) deviations has the estimate's deviation.
        delay_row = estimates[float(name.removeprefix(IDENTIFIED))]
        reach_ms = max(3**0.5 * delay_row["deviation_ms"], 1e-3)
        low, high = max(0.0, delay_row["estimate_ms"] - reach_ms), max(0.0, delay_row["estimate_ms"]) + reach_ms
        ranges = {"sensor_delay": (0.0, 1e-6), "actuator_delay": (low / 1e3, high / 1e3)}
    elif name == "wide":
        ranges = {n: (low / 1e3, high / 1e3) for n, (low, high) in WIDE_MS.items()}
    else:
        pipeline = load_robot(PIPELINE)
        robot: Any = pipeline
        usual = robot.nominal() | dict.fromkeys(WIDE_MS, 0.0)
        ranges = {n: (usual[n], usual[n] + 1e-6) for n in pipeline.defaults.train.vary.range}
    return [word for n, (low, high) in ranges.items() for word in ("--vary.range", n, f"{low:.7f}", f"{high:.7f}")]


def trained(
    name: str,
    device: str,
    estimates: Mapping[float, Mapping[str, float]],
    work: Path,
    options: argparse.Namespace,
) -> None:
    """Train a policy, and write its bundle and the facts of its training into the folder."""
    flags = [*shlex.split(options.flags), *differences(name, estimates)]
    share = {"XLA_PYTHON_CLIENT_MEM_FRACTION": f"{0.8 / options.trainings:.2f}"}
    with tempfile.TemporaryDirectory() as runs:
        done = train(options.steps, flags, Path(runs), share)
        shutil.copytree(done.folder / "bundle", work / name / "bundle", dirs_exist_ok=True)
    about = {**asdict(done), "folder": name, "flags": flags, "device": device, "at_once": options.trainings}
    (work / name / "training.json").write_text(json.dumps(about, indent=1))


_FALLS, _ERROR = "falls", "error_m_s"
LABELS = {
    "nominal": "nominal: no delay, one robot",
    "wide": "wide: delays of 0 to 46 ms",
    "identified": "identified: the true delay",
}


MOST_FALLS = 1
"""Falls up to which a policy is not named."""


def table(report: Mapping[str, Any]) -> str:
    """Return the falls of policies that were trained for another delay than the true one."""
    delays, v = _of(report)
    twins = report["flags"]["twins"]
    falls = [
        f"{v[f'{IDENTIFIED}{trained:g}', ms, _FALLS]} of {twins} (trained at {trained:g} ms, true {ms:g} ms)"
        for trained in delays
        for ms in delays
        if v[f"{IDENTIFIED}{trained:g}", ms, _FALLS] > MOST_FALLS
    ]
    over = [v["wide", ms, _ERROR] / v["identified", ms, _ERROR] - 1 for ms in delays]
    fallen = sum(v["wide", ms, _FALLS] for ms in delays)
    return (
        f"`wide` falls on {fallen} twins; its velocity error is {100 * min(over):+.0f} to {100 * max(over):+.0f} % "
        "beside that of the policy with the true delay. At other delays than their own, identified policies fall: "
        f"{', '.join(falls)}.\n"
    )


def figure(report: Mapping[str, Any]) -> Figure:
    """Return the figure: falls with exact 95 % intervals, and the error of the velocity, over the true delay."""
    delays, v = _of(report)
    twins = report["flags"]["twins"]
    drawn = Figure((8.2, 3.3), layout="constrained")
    falls, errors = drawn.subplots(1, 2, sharex=True)
    for i, (name, label) in enumerate(LABELS.items()):
        # The curves stand beside one another, so that their intervals can stay apart.
        beside = [ms + 0.5 * (i - 1) for ms in delays]
        counts = [v[name, ms, _FALLS] for ms in delays]
        ends = [[twins * end for end in share(int(count), twins)[1:]] for count in counts]
        below, above = zip(*((n - low, high - n) for n, (low, high) in zip(counts, ends, strict=True)), strict=True)
        falls.errorbar(beside, counts, (below, above), fmt="o-", label=label)
        errors.plot(beside, [v[name, ms, _ERROR] for ms in delays], "o-")
    falls.set(title=f"falls of {twins} twins, 95 % interval", xlabel="true delay [ms]", ylim=(0, twins))
    errors.set(title="error of the velocity [m/s]", xlabel="true delay [ms]", ylim=(0, None))
    drawn.legend(loc="outside upper center", ncols=len(LABELS))
    return drawn


def _of(report: Mapping[str, Any]) -> tuple[list[float], dict[tuple[str, float, str], float]]:
    """Return the delays [ms], and the figures by policy, delay and kind; ``identified`` is that of each true delay."""
    figures = {}
    for line in report["rows"]:
        _, name, delay, what = line["name"].split("/")
        figures[name, float(delay.removesuffix("_ms")), what] = line["value"]
    matched = {("identified", ms, what): x for (name, ms, what), x in figures.items() if name == f"identified_{ms:g}"}
    return sorted({ms for _, ms, _ in figures}), figures | matched
