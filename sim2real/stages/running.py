"""All four stages in one run folder, and around again: the verdict on a deployment says what is done anew."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sim2real.artifacts.run_folder import STAGES, StageFolder, finished
from sim2real.errors import DelayChanged, Sim2RealError, UsageError
from sim2real.stages import console, targets

if TYPE_CHECKING:
    from sim2real.artifacts.deployment import Deployment
    from sim2real.artifacts.drift import Drift
    from sim2real.artifacts.identification import Identification
    from sim2real.artifacts.iterations import Iteration
    from sim2real.stages.flags import RunFlags
    from sim2real.stages.pipeline import Pipeline

Call = Callable[[str, Any, Path | None], StageFolder]
"""Runs a stage: its name, its configuration, the run folder; returns what it left."""
ALL = ", ".join(STAGES)
"""What is done again where nothing that was recorded is true any more."""


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
        try:
            ran += _done(flags, call, stage, getattr(flags, stage), run_dir)
        except DelayChanged as error:
            if flags.iterations == 1 or run_dir is None:
                raise
            _go_around(pipeline, flags, call, run_dir, ran, error)
            return
        run_dir = ran[-1].run_dir
    if flags.iterations > 1 and run_dir is not None:
        _go_around(pipeline, flags, call, run_dir, ran)


def _go_around(
    pipeline: Pipeline,
    flags: RunFlags,
    call: Call,
    run_dir: Path,
    ran: list[StageFolder],
    refused: DelayChanged | None = None,
) -> None:
    """Do again what each verdict asks for, until nothing is left to do; say after each what it did.

    Args:
        pipeline: The robot.
        flags: Of the run.
        call: Runs a stage.
        run_dir: Its folder.
        ran: What the first iteration ran.
        refused: Why its deployment was refused before the policy moved anything; None: it was not.

    Raises:
        DelayChanged: In the last iteration, too.
    """
    from sim2real.artifacts.iterations import Iteration, Iterations

    rows = Iterations.load(run_dir).rows
    for left in reversed(range(flags.iterations)):
        row = Iteration(len(rows) + 1, tuple(stage.folder.name for stage in ran))
        if refused is None:
            row, plan = _judged(row, pipeline, flags, run_dir)
        else:  # nothing else of this robot is recorded yet
            row = replace(row, verdict="re-identify", why=str(refused.args[0]))
            plan = _anew(pipeline, flags, run_dir)
        if plan.configs and not left:
            plan = Plan({}, f"the last iteration: it would {plan.words}")
        row = replace(row, then=plan.words)
        rows = (*rows, row)
        console.wrote(Iterations(rows).save(run_dir))
        console.note(f"iteration {row.number}: {row.verdict}; {plan.words}")
        if refused is not None and not left:
            raise refused
        ran, refused = [], None
        for stage, config in plan.configs.items():
            console.note(f"{stage} (iteration {row.number + 1})")
            try:
                ran += _ran(flags, call, run_dir, stage, config)
            except DelayChanged as error:
                refused = error
        if not ran:
            break
    from sim2real.view.page import report  # matplotlib and jinja2 take 0.5 s to import

    cells = [[r.number, ", ".join(r.stages), r.real, r.simulation, r.verdict, r.then] for r in rows]
    print(console.table(cells, ["iteration", "ran", "success", "in simulation", "verdict", "then"]))
    console.wrote(report(run_dir))


def _ran(flags: RunFlags, call: Call, run_dir: Path, stage: str, config: Any) -> list[StageFolder]:
    """Run a stage; identification from a new recording, too, where the deployment's logs do not suffice.

    A policy may hold still, or balance what falls: there the smallest error grows a hundred times within a segment.

    Args:
        flags: Of the run.
        call: Runs a stage.
        run_dir: Its folder.
        stage: The stage's name.
        config: Its configuration: that of an identification names the deployment's logs, or there is a recording.

    Returns:
        What each stage that ran left.
    """
    from sim2real.artifacts.identification import Identification
    from sim2real.stages.once_more import lacking

    if stage != "identify" or not config.log:
        return _done(flags, call, stage, config, run_dir)
    ran: list[StageFolder] = []
    try:
        ran = _done(flags, call, stage, config, run_dir)
        why = lacking(Identification.load(ran[-1].output("parameters")))
    except Sim2RealError as error:
        why = str(error.args[0])
    if not why:
        return ran
    console.note(f"the deployment's own logs do not suffice ({why}): record, identify from that")
    ran.append(call("record", flags.record, run_dir))
    return [*ran, *_done(flags, call, "identify", replace(config, log=()), run_dir)]


def _done(flags: RunFlags, call: Call, stage: str, config: Any, run_dir: Path | None) -> list[StageFolder]:
    """Run a stage; in a run that goes around by itself once more where its result says how: wider bounds, or longer.

    A worn robot leaves the bounds of a data sheet; one with more friction takes more steps to learn for.

    Args:
        flags: Of the run.
        call: Runs a stage.
        stage: The stage's name.
        config: Its configuration.
        run_dir: The run's folder.
    """
    from sim2real.stages.once_more import MOST, better, repeated

    def again(config: Any, done: StageFolder) -> Any:
        following, why = better(config, done)
        if following is not None:
            console.note(f"{stage}, once more: {why}")
        return following

    most = MOST.get(stage, 0) if flags.iterations > 1 else 0
    return [done for _, done in repeated(lambda config: call(stage, config, run_dir), config, again, most)]


def _judged(row: Iteration, pipeline: Pipeline, flags: RunFlags, run_dir: Path) -> tuple[Iteration, Plan]:
    """Return an iteration's row with what its deployment found, and what that asks for.

    Args:
        row: Of the iteration.
        pipeline: The robot.
        flags: Of the run.
        run_dir: Its folder.
    """
    deployed = finished(run_dir, "deploy")
    if deployed is None:
        raise UsageError("there is no deployment to judge", hint="deploy --dry-run moves nothing: leave it out")
    result = _result(deployed)
    if success := next((g for g in result.gap if g.quantity == "success"), None):
        row = replace(row, real=success.real, simulation=success.simulation)
    if advice := result.advice:
        row = replace(row, verdict=advice.status, why=next(iter(advice.reasons), ""))
    return row, next_plan(pipeline, flags, run_dir, deployed, result)


def _anew(pipeline: Pipeline, flags: RunFlags, run_dir: Path, drift: Drift | None = None) -> Plan:
    """Return all stages, for a robot of which nothing recorded is true any more."""
    from sim2real.stages.next_step import terms_to_identify

    terms = terms_to_identify(flags.identify.terms, pipeline, _found(pipeline, run_dir), drift)
    identify = replace(flags.identify, log=(), terms=terms)
    return Plan({"record": flags.record, "identify": identify, **_trained_again(flags, run_dir)}, ALL)


def _found(pipeline: Pipeline, run_dir: Path) -> Identification:
    """Return what the run identified last."""
    from sim2real.artifacts.identification import Identification

    identified = finished(run_dir, "identify")
    if identified is None:
        raise Sim2RealError("this run has no identification", hint=f"sim2real identify {pipeline.name}")
    return Identification.load(identified.output("parameters"))


def _trained_again(flags: RunFlags, run_dir: Path) -> dict[str, Any]:
    """Return the configurations of training, with the next seed, and of deploying."""
    before = finished(run_dir, "train")
    seed = int(before.manifest["config"]["seed"]) if before is not None else flags.train.seed
    return {"train": replace(flags.train, seed=seed + 1), "deploy": flags.deploy}


def next_plan(pipeline: Pipeline, flags: RunFlags, run_dir: Path, deployed: StageFolder, result: Deployment) -> Plan:
    """Return what a deployment asks for.

    Args:
        pipeline: The robot.
        flags: Of the run.
        run_dir: Its folder.
        deployed: The deployment's folder.
        result: What it found.
    """
    from sim2real.stages.next_step import logs_to_identify, needs_timing, terms_to_identify

    if flags.goal and _reached(result, *flags.goal):
        return Plan({}, "stop: {} is at least {:g}".format(*flags.goal))
    advice = result.advice
    if advice is None or advice.status in ("look at this joint", "not judged"):
        return Plan({}, "stop: " + (advice.reasons[0] if advice and advice.reasons else "nothing was judged"))
    if advice.status == "fine" and not flags.goal:
        return Plan({}, "stop: nothing is left to do")
    train = _trained_again(flags, run_dir)
    if advice.status != "re-identify" and not needs_timing(advice):
        return Plan(train, "train with another seed, deploy")
    found = _found(pipeline, run_dir)
    own = [path for name, path in sorted(deployed.outputs.items()) if name.startswith("log_") or name == "probe"]
    logs = logs_to_identify(own, result.drift, found, deployed.folder)
    if not logs:
        return _anew(pipeline, flags, run_dir, result.drift)
    terms = terms_to_identify(flags.identify.terms, pipeline, found, result.drift)
    words = f"identify from {len(logs)} log{'s' * (len(logs) > 1)}, the deployment's among them, train, deploy"
    return Plan({"identify": replace(flags.identify, log=logs, terms=terms), **train}, words)


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
