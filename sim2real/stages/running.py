"""All four stages in one run folder, and around again: the verdict on a deployment says what is done anew."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sim2real.artifacts.run_folder import STAGES, StageFolder, finished
from sim2real.errors import Sim2RealError, UsageError
from sim2real.stages import console, targets

if TYPE_CHECKING:
    from sim2real.artifacts.deployment import Deployment
    from sim2real.stages.flags import RunFlags
    from sim2real.stages.pipeline import Pipeline

Call = Callable[[str, Any, Path | None], StageFolder]
"""Runs a stage: its name, its configuration, the run folder; returns what it left."""


@dataclass(frozen=True)
class Plan:
    """What an iteration does: the configuration of each stage that is run, and that in words."""

    configs: dict[str, Any]
    words: str


def run_all(pipeline: Pipeline, flags: RunFlags, call: Call) -> None:
    """Run the four stages in one run folder, from the first one on that is not finished there, and around again.

    Args:
        pipeline: The robot.
        flags: Of all stages, and how often to go around.
        call: Runs a stage.

    Raises:
        UsageError: When the recording is to be dry, or a goal that is not of this task.
    """
    if flags.record.dry_run:
        raise UsageError(
            "a run cannot go on from a dry recording: there is nothing in it to identify",
            hint=f"`sim2real record {pipeline.name} --dry-run` by itself; of a run, deploy alone may be dry",
        )
    run_dir = targets.find_run(flags.runs, flags.resume, pipeline.name) if flags.resume else None
    redo, ran = run_dir is None, list[StageFolder]()
    for number, stage in enumerate(STAGES, 1):
        done = None if redo or run_dir is None else finished(run_dir, stage)
        if done is not None:
            console.note(f"{stage} ({number}/{len(STAGES)}): finished before, skipped")
            continue
        redo = True  # what comes after a stage that ran again is out of date
        console.note(f"{stage} ({number}/{len(STAGES)})")
        ran.append(call(stage, getattr(flags, stage), run_dir))
        run_dir = ran[-1].run_dir
    if flags.iterations > 1 and run_dir is not None:
        _go_around(pipeline, flags, call, run_dir, ran)


def _go_around(pipeline: Pipeline, flags: RunFlags, call: Call, run_dir: Path, ran: list[StageFolder]) -> None:
    """Do again what each verdict asks for, until nothing is left to do; say after each what it did."""
    from sim2real.artifacts.iterations import Iteration, Iterations

    rows = Iterations.load(run_dir).rows
    for left in reversed(range(flags.iterations)):
        deployed = finished(run_dir, "deploy")
        if deployed is None:
            raise UsageError("there is no deployment to judge", hint="deploy --dry-run moves nothing: leave it out")
        result = _result(deployed)
        plan = next_plan(pipeline, flags, run_dir, deployed, result)
        if plan.configs and not left:
            plan = Plan({}, f"the last iteration: it would {plan.words}")
        success = next((g for g in result.gap if g.quantity == "success"), None)
        advice = result.advice
        row = Iteration(
            number=len(rows) + 1,
            stages=tuple(stage.folder.name for stage in ran),
            real=success.real if success else None,
            simulation=success.simulation if success else None,
            verdict=advice.status if advice else "not judged",
            why=advice.reasons[0] if advice and advice.reasons else "",
            then=plan.words,
        )
        rows = (*rows, row)
        console.wrote(Iterations(rows).save(run_dir))
        console.note(f"iteration {row.number}: {row.verdict}; {plan.words}")
        ran = []
        for stage, config in plan.configs.items():
            console.note(f"{stage} (iteration {row.number + 1})")
            ran.append(call(stage, config, run_dir))
        if not ran:
            break
    from sim2real.view.page import report  # matplotlib and jinja2 take 0.5 s to import

    cells = [[r.number, ", ".join(r.stages), r.real, r.simulation, r.verdict, r.then] for r in rows]
    print(console.table(cells, ["iteration", "ran", "success", "in simulation", "verdict", "then"]))
    console.wrote(report(run_dir))


def next_plan(pipeline: Pipeline, flags: RunFlags, run_dir: Path, deployed: StageFolder, result: Deployment) -> Plan:
    """Return what a deployment asks for.

    Args:
        pipeline: The robot.
        flags: Of the run.
        run_dir: Its folder.
        deployed: The deployment's folder.
        result: What it found.
    """
    from sim2real.artifacts.identification import Identification
    from sim2real.stages.next_step import logs_to_identify, needs_timing

    if flags.goal and _reached(result, *flags.goal):
        return Plan({}, "stop: {} is at least {:g}".format(*flags.goal))
    advice = result.advice
    if advice is None or advice.status in ("look at this joint", "not judged"):
        return Plan({}, "stop: " + (advice.reasons[0] if advice and advice.reasons else "nothing was judged"))
    if advice.status == "fine" and not flags.goal:
        return Plan({}, "stop: nothing is left to do")
    before = finished(run_dir, "train")
    seed = int(before.manifest["config"]["seed"]) if before is not None else flags.train.seed
    train = {"train": replace(flags.train, seed=seed + 1), "deploy": flags.deploy}
    if advice.status != "re-identify" and not needs_timing(advice):
        return Plan(train, "train with another seed, deploy")
    identified = finished(run_dir, "identify")
    if identified is None:
        raise Sim2RealError("this run has no identification", hint=f"sim2real identify {pipeline.name}")
    own = [path for name, path in sorted(deployed.outputs.items()) if name.startswith("log_")]
    found = Identification.load(identified.output("parameters"))
    logs = logs_to_identify(own, result.drift, found, deployed.folder)
    if not logs:
        new = {"record": flags.record, "identify": replace(flags.identify, log=())}
        return Plan({**new, **train}, "record, identify, train, deploy")
    words = f"identify from {len(logs)} logs, the deployment's among them, train, deploy"
    return Plan({"identify": replace(flags.identify, log=logs), **train}, words)


def _reached(result: Deployment, quantity: str, least: float) -> bool:
    """Return whether a quantity of the gap report is as large on the robot as was asked for.

    Raises:
        UsageError: When the task has no such quantity.
    """
    known = {g.quantity: g.real for g in result.gap}
    if quantity not in known:
        raise UsageError(f"there is no {quantity!r} in the gap report. Available: {', '.join(known) or 'none'}")
    real = known[quantity]
    return real is not None and real >= least


def _result(deployed: StageFolder) -> Deployment:
    from sim2real.artifacts.deployment import Deployment

    return Deployment.read(deployed.folder)
