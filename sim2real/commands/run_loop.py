"""All four stages in one run folder, and around again: the verdict on a deployment says what is done anew."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sim2real.artifacts.run.iterations import Iteration, Iterations, Plan
from sim2real.artifacts.run.run_folder import STAGES, StageFolder, attempts, finished, portable
from sim2real.artifacts.run.stage_status import standing, why_stale
from sim2real.errors import DelayChanged, Sim2RealError, UsageError
from sim2real.stages.pipeline import find_run
from sim2real.stages.terminal import console

if TYPE_CHECKING:
    from sim2real.artifacts.deployment import Deployment
    from sim2real.artifacts.estimation.drift import Drift
    from sim2real.artifacts.identification import Identification
    from sim2real.commands.flags import RunFlags
    from sim2real.stages.pipeline.pipeline import Pipeline

Call = Callable[[str, Any, Path | None], StageFolder]
"""Runs a stage: its name, its configuration, the run folder; returns what it left."""
ALL = ", ".join(STAGES)
"""What is done again where nothing that was recorded is true any more."""


def run_all(pipeline: Pipeline, flags: RunFlags, call: Call) -> Path | None:
    """Run the four stages in one run folder, from the first one on that is not current there, and around again.

    Args:
        flags: Of all stages, and how often to go around.

    Returns:
        The run folder; None if there is none.

    Raises:
        UsageError: When the recording is to be dry, or a goal that is not of this task.
    """
    if flags.record.dry_run:
        raise UsageError(
            "a run cannot go on from a dry recording: there is nothing in it to identify",
            hint=f"`sim2real record {pipeline.name} --dry-run` by itself; of a run, deploy alone may be dry",
        )
    run_dir = find_run.find_run(flags.runs, flags.resume, pipeline.name) if flags.resume else None
    plan = None if run_dir is None else Iterations.load(run_dir).plan
    if flags.iterations > 1:
        return _go_around(pipeline, flags, call, run_dir, plan)
    if plan is not None:
        console.note(f"an iteration of this run was interrupted ({plan.words}): --iterations N goes on with it")
    redo = False
    for number, stage in enumerate(STAGES, 1):
        done = None if redo or run_dir is None else standing(run_dir).get(stage)
        if done is not None and not done.stale:
            console.note(f"{stage} ({number}/{len(STAGES)}): finished before, skipped")
            continue
        redo = True  # what comes after a stage that ran again is out of date
        why = f": {done.stale}" if done is not None else ""
        console.note(f"{stage} ({number}/{len(STAGES)}){why}")
        run_dir = call(stage, getattr(flags, stage), run_dir).run_dir
    return run_dir


def _go_around(pipeline: Pipeline, flags: RunFlags, call: Call, run_dir: Path | None, plan: Plan | None) -> Path:
    """Run what is not current, or what an interrupted iteration left; then again and again what each verdict asks for.

    Args:
        run_dir: Its folder; None: the first stage makes it.
        plan: What an interrupted iteration had to do; None: no iteration was interrupted.

    Raises:
        DelayChanged: In the last iteration, too.
    """
    now = {} if run_dir is None else standing(run_dir)
    current = set(now) == set(STAGES) and not any(s.stale for s in now.values())
    # Of a finished run the newest deployment is judged, where no iteration of it was interrupted.
    plan = plan or Plan(() if current else STAGES, ALL)
    rows = () if run_dir is None else Iterations.load(run_dir).rows
    while True:
        number = len(rows) + 1
        done, refused = _iterate(flags, Resumed.of(call, run_dir, plan.before), run_dir, plan, number)
        run_dir = done[-1].run_dir if done else run_dir
        if run_dir is None:  # a deployment comes last: before it there is a training
            raise refused or UsageError("there is no run to go around in")
        # A stage that an earlier row lists was judged there.
        names = tuple(s.folder.name for s in (done or [s.newest for s in now.values()]))
        row = Iteration(number, tuple(n for n in names if not any(n in r.stages for r in rows)))
        if refused is None:
            deployed = _deployed(run_dir)
            if rows and rows[-1].deployment == deployed.folder.name:
                row, rows = rows[-1], rows[:-1]  # it was judged before: what follows from it may be another now
            row, plan = _judged(row, pipeline, flags, run_dir, deployed)
        else:  # nothing else of this robot is recorded yet
            row = replace(row, verdict="re-identify", why=str(refused.args[0]))
            plan = _anew(pipeline, flags, run_dir)
        if plan.stages and row.number >= flags.iterations:
            plan = Plan((), f"the last iteration: it would {plan.words}")
        rows = (*rows, replace(row, then=plan.words))
        plan = replace(plan, before=_finished_folders(run_dir))
        # The plan is on disk before its first stage starts: who is interrupted goes on with it.
        console.wrote(Iterations(rows, plan if plan.stages else None).save(run_dir))
        console.note(f"iteration {row.number}: {row.verdict}; {plan.words}")
        if not plan.stages:
            break
    if refused is not None:
        raise refused
    cells = [[r.number, ", ".join(r.stages), r.real, r.simulation, r.verdict, r.then] for r in rows]
    print(console.table(cells, ["iteration", "ran", "success", "in simulation", "verdict", "then"]))
    return run_dir


def _iterate(
    flags: RunFlags, call: Call, run_dir: Path | None, plan: Plan, number: int
) -> tuple[list[StageFolder], DelayChanged | None]:
    """Run the stages of an iteration.

    Args:
        call: Runs a stage, or returns what an interrupted iteration left of it.

    Returns:
        What each stage that ran left, and why the deployment was refused before the policy moved anything.
    """
    ran: list[StageFolder] = []
    for stage in plan.stages:
        console.note(f"{stage} (iteration {number})")
        try:
            ran += _ran(flags, call, run_dir, stage, _config(flags, plan, stage, run_dir))
        except DelayChanged as error:
            return ran, error
        run_dir = ran[-1].run_dir
    return ran, None


def _config(flags: RunFlags, plan: Plan, stage: str, run_dir: Path | None) -> Any:
    """Return the configuration of a stage in an iteration: that of the flags, with what the plan changes."""
    if stage == "identify" and plan.terms is not None:
        log = tuple(console.shown(Path(run_dir or "") / path) for path in plan.log)
        return replace(flags.identify, log=log, terms=plan.terms)
    if stage == "train" and plan.seed is not None:
        return replace(flags.train, seed=plan.seed)
    return getattr(flags, stage)


def _finished_folders(run_dir: Path) -> tuple[str, ...]:
    """Return the names of all stage folders of a run that are finished."""
    return tuple(a.folder.name for stage in STAGES for a in attempts(run_dir, stage) if a.finished)


@dataclass
class Resumed:
    """Calls stages; first it returns, in their order, the attempts that an interrupted iteration finished.

    An iteration decides by what its stages found, so with the same results it comes to the same place.

    Attributes:
        call: Runs a stage.
        left: Stage -> the attempts that have not been returned yet, the oldest first.
    """

    call: Call
    left: dict[str, list[StageFolder]]

    @staticmethod
    def of(call: Call, run_dir: Path | None, before: tuple[str, ...]) -> Resumed:
        """Find the attempts that finished since an iteration started.

        Args:
            run_dir: The run's folder; None: there is nothing yet.
            before: Stage folders that were finished when it started.
        """
        if run_dir is None:
            return Resumed(call, {})
        new = {s: [a for a in attempts(run_dir, s) if a.finished and a.folder.name not in before] for s in STAGES}
        return Resumed(call, {stage: found[::-1] for stage, found in new.items()})

    def __call__(self, stage: str, config: Any, run_dir: Path | None) -> StageFolder:
        """Return what an interrupted iteration left of a stage, where that is current; else run the stage."""
        while self.left.get(stage) and run_dir is not None:
            done = self.left[stage].pop(0)
            if not (why := why_stale(done, standing(run_dir))):
                console.note(f"{stage}: {done.folder.name} is finished, skipped")
                return done
            console.note(f"{stage}: {why}")
        return self.call(stage, config, run_dir)


def _ran(flags: RunFlags, call: Call, run_dir: Path | None, stage: str, config: Any) -> list[StageFolder]:
    """Run a stage; identification from a new recording, too, where the deployment's logs do not suffice.

    A policy may hold still, or balance what falls: there the smallest error grows a hundred times within a segment.

    Args:
        config: Its configuration: that of an identification names the deployment's logs, or there is a recording.

    Returns:
        What each stage that ran left.
    """
    from sim2real.artifacts.identification import Identification
    from sim2real.commands.retry import lacking

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
    """
    from sim2real.commands.retry import MOST, better, repeated

    def again(config: Any, done: StageFolder) -> Any:
        following, why = better(config, done)
        if following is not None:
            console.note(f"{stage}, once more: {why}")
        return following

    most = MOST.get(stage, 0) if flags.iterations > 1 else 0
    return [done for _, done in repeated(lambda config: call(stage, config, run_dir), config, again, most)]


def _deployed(run_dir: Path) -> StageFolder:
    """Return the newest finished deployment of a run."""
    if (deployed := finished(run_dir, "deploy")) is None:
        raise UsageError("there is no deployment to judge", hint="deploy --dry-run moves nothing: leave it out")
    return deployed


def _judged(
    row: Iteration, pipeline: Pipeline, flags: RunFlags, run_dir: Path, deployed: StageFolder
) -> tuple[Iteration, Plan]:
    """Return an iteration's row with what its deployment found, and what that asks for."""
    result = _result(deployed)
    if success := next((g for g in result.gap if g.quantity == "success"), None):
        row = replace(row, real=success.real, simulation=success.simulation)
    if advice := result.advice:
        row = replace(row, verdict=advice.status, why=next(iter(advice.reasons), ""))
    return row, next_plan(pipeline, flags, run_dir, deployed, result)


def _anew(pipeline: Pipeline, flags: RunFlags, run_dir: Path, drift: Drift | None = None) -> Plan:
    """Return all stages, for a robot of which nothing recorded is true any more."""
    from sim2real.stages.deploy.next_command import terms_to_identify

    terms = terms_to_identify(flags.identify.terms, pipeline, _found(pipeline, run_dir), drift)
    return Plan(STAGES, ALL, terms=terms, seed=_next_seed(flags, run_dir))


def _found(pipeline: Pipeline, run_dir: Path) -> Identification:
    """Return what the run identified last."""
    from sim2real.artifacts.identification import Identification

    identified = finished(run_dir, "identify")
    if identified is None:
        raise Sim2RealError("this run has no identification", hint=f"sim2real identify {pipeline.name}")
    return Identification.load(identified.output("parameters"))


def _next_seed(flags: RunFlags, run_dir: Path) -> int:
    """Return the seed after that of the run's newest training: the same seed would train the same policy."""
    before = finished(run_dir, "train")
    return 1 + (int(before.manifest["config"]["seed"]) if before is not None else flags.train.seed)


def next_plan(pipeline: Pipeline, flags: RunFlags, run_dir: Path, deployed: StageFolder, result: Deployment) -> Plan:
    """Return what a deployment asks for."""
    from sim2real.stages.deploy.next_command import logs_to_identify, needs_timing, terms_to_identify

    if flags.goal and _reached(result, *flags.goal):
        return Plan((), "stop: {} is at least {:g}".format(*flags.goal))
    advice = result.advice
    if advice is None or advice.status in ("look at this joint", "not judged"):
        return Plan((), "stop: " + (advice.reasons[0] if advice and advice.reasons else "nothing was judged"))
    if advice.status == "fine" and not flags.goal:
        return Plan((), "stop: nothing is left to do")
    seed = _next_seed(flags, run_dir)
    if advice.status != "re-identify" and not needs_timing(advice):
        return Plan(("train", "deploy"), "train with another seed, deploy", seed=seed)
    found = _found(pipeline, run_dir)
    own = [path for name, path in sorted(deployed.outputs.items()) if name.startswith("log_") or name == "probe"]
    logs = logs_to_identify(own, result.drift, found, deployed.folder)
    if not logs:
        return _anew(pipeline, flags, run_dir, result.drift)
    terms = terms_to_identify(flags.identify.terms, pipeline, found, result.drift)
    words = f"identify from {len(logs)} log{'s' * (len(logs) > 1)}, the deployment's among them, train, deploy"
    log = tuple(portable(Path(path), run_dir) for path in logs)
    return Plan(("identify", "train", "deploy"), words, log, terms, seed)


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
