"""The four stages in one run folder, and the iterations after them: each verdict decides which stages run next."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sim2real.artifacts.run.iterations import Iteration, Iterations, Plan
from sim2real.artifacts.run.run_folder import STAGES, StageFolder, attempts
from sim2real.artifacts.run.stage_status import stage_status, why_stale
from sim2real.commands.loop.shipped import why_shipped
from sim2real.errors import DelayChanged, Sim2RealError, UsageError
from sim2real.stages.pipeline import find_run
from sim2real.stages.terminal import console

if TYPE_CHECKING:
    from sim2real.commands.flags import RunFlags
    from sim2real.stages.pipeline.pipeline import Pipeline

CallStage = Callable[[str, Any, Path | None], StageFolder]
"""Runs a stage: its name, its configuration, the run folder; returns the stage's folder."""


def run_all(pipeline: Pipeline, flags: RunFlags, call: CallStage) -> Path | None:
    """Run the four stages in one run folder, from the first stage without a current result; then the iterations.

    Returns:
        The run folder; None if there is none.
    """
    # Refuse a dry recording, and find an interrupted run.
    if flags.record.dry_run:
        raise UsageError(
            "a dry recording holds no motion: a run cannot identify from it",
            hint=f"`sim2real record {pipeline.name} --dry-run` records alone; of a run, only deploy can be dry",
        )
    run_dir = find_run.find_run(flags.runs, flags.resume, pipeline.name) if flags.resume else None
    plan = None if run_dir is None else Iterations.load(run_dir).plan
    shipped = why_shipped(pipeline)
    if flags.iterations > 1 and shipped:
        raise UsageError(f"{shipped}, and iterations train another one", hint="run without --iterations")
    if flags.iterations > 1:
        return _run_iterations(pipeline, flags, call, run_dir, plan)
    if plan is not None:
        console.note(f"an iteration of this run was interrupted ({plan.words}): --iterations N continues it")
    # Skip the stages with a current result. After a stage that runs, the results of all later stages are out of date.
    rerun = False
    for number, stage in enumerate(STAGES, 1):
        if stage == "train" and shipped:
            console.note(f"train ({number}/{len(STAGES)}): skipped, as {shipped}")
            continue
        status = None if rerun or run_dir is None else stage_status(run_dir).get(stage)
        if status is not None and not status.stale:
            console.note(f"{stage} ({number}/{len(STAGES)}): finished before, skipped")
            continue
        rerun = True
        reason = f": {status.stale}" if status is not None else ""
        console.note(f"{stage} ({number}/{len(STAGES)}){reason}")
        run_dir = call(stage, getattr(flags, stage), run_dir).run_dir
    return run_dir


def _run_iterations(
    pipeline: Pipeline, flags: RunFlags, call: CallStage, run_dir: Path | None, plan: Plan | None
) -> Path:
    """Run a plan, judge its deployment, write the next plan; until a plan has no stages.

    Args:
        run_dir: The run's folder; None: the first stage makes it.
        plan: The plan of an interrupted iteration; None: no iteration was interrupted.

    Raises:
        DelayChanged: The deployment of the last iteration was refused.
    """
    from sim2real.commands.loop import next_iteration

    # Of a finished run only the newest deployment is judged; in all other runs the four stages run first.
    statuses = {} if run_dir is None else stage_status(run_dir)
    current = set(statuses) == set(STAGES) and not any(s.stale for s in statuses.values())
    plan = plan or Plan(() if current else STAGES, next_iteration.ALL_STAGES)
    rows = () if run_dir is None else Iterations.load(run_dir).rows
    while True:
        number = len(rows) + 1
        # Run the plan's stages. Attempts that an interrupted iteration has finished are not run again.
        folders, refusal = _run_plan(flags, ResumedCalls.of(call, run_dir, plan.before), run_dir, plan, number)
        run_dir = folders[-1].run_dir if folders else run_dir
        if run_dir is None:
            raise refusal or UsageError("this run has no folder, because no stage ran")
        # Start the iteration's row with the stages that no earlier row lists.
        names = tuple(s.folder.name for s in (folders or [s.newest for s in statuses.values()]))
        row = Iteration(number, tuple(n for n in names if not any(n in r.stages for r in rows)))
        # Judge the deployment and plan the next iteration.
        if refusal is None:
            deployment = next_iteration.newest_deployment(run_dir)
            if rows and rows[-1].deployment == deployment.folder.name:
                # This deployment was judged before. The flags may differ now, so the last row is written again.
                row, rows = rows[-1], rows[:-1]
            row, plan = next_iteration.judge(row, pipeline, flags, run_dir, deployment)
        else:
            # The policy was refused before it moved the robot: no log shows the robot as it is now.
            row = replace(row, verdict="re-identify", why=str(refusal.args[0]))
            plan = next_iteration.plan_all_stages(pipeline, flags, run_dir)
        if plan.stages and row.number >= flags.iterations:
            plan = Plan((), f"the last iteration: it would {plan.words}")
        # Write the plan before its first stage starts, so that an interrupted run continues with it.
        rows = (*rows, replace(row, then=plan.words))
        finished = tuple(a.folder.name for stage in STAGES for a in attempts(run_dir, stage) if a.finished)
        plan = replace(plan, before=finished)
        console.wrote(Iterations(rows, plan if plan.stages else None).save(run_dir))
        console.note(f"iteration {row.number}: {row.verdict}; {plan.words}")
        if not plan.stages:
            break
    if refusal is not None:
        raise refusal
    from sim2real.view.page.page import report  # matplotlib and jinja2 take 0.5 s to import

    print(console.artifact_table(Iterations(rows).table().without("why")))
    report(run_dir)
    return run_dir


def _run_plan(
    flags: RunFlags, call: CallStage, run_dir: Path | None, plan: Plan, number: int
) -> tuple[list[StageFolder], DelayChanged | None]:
    """Run the stages of a plan.

    Returns:
        The folders of the stages that ran, and the error of a deployment that was refused before the policy moved the
        robot.
    """
    folders: list[StageFolder] = []
    for stage in plan.stages:
        console.note(f"{stage} (iteration {number})")
        try:
            folders += _run_stage(flags, call, run_dir, stage, _config(flags, plan, stage, run_dir))
        except DelayChanged as error:
            return folders, error
        run_dir = folders[-1].run_dir
    return folders, None


def _config(flags: RunFlags, plan: Plan, stage: str, run_dir: Path | None) -> Any:
    """Return the configuration of a stage: that of the flags, with the changes of the plan."""
    if stage == "identify" and plan.terms is not None:
        log = tuple(console.shown(Path(run_dir or "") / path) for path in plan.log)
        return replace(flags.identify, log=log, terms=plan.terms)
    if stage == "train" and plan.seed is not None:
        return replace(flags.train, seed=plan.seed)
    return getattr(flags, stage)


def _run_stage(flags: RunFlags, call: CallStage, run_dir: Path | None, stage: str, config: Any) -> list[StageFolder]:
    """Run a stage. If the logs of a deployment do not suffice to identify from, record and identify from that.

    A policy that holds still excites no parameter; one that balances amplifies errors a hundredfold within a segment.

    Returns:
        The folder of each attempt.
    """
    from sim2real.artifacts.identification import Identification
    from sim2real.commands.loop.retry import why_insufficient

    if stage != "identify" or not config.log:
        return _run_with_retries(flags, call, stage, config, run_dir)
    # Identify from the deployment's logs. An identification that fails is a reason to record, as a poor one is.
    folders: list[StageFolder] = []
    try:
        folders = _run_with_retries(flags, call, stage, config, run_dir)
        reason = why_insufficient(Identification.load(folders[-1].output("parameters")))
    except Sim2RealError as error:
        reason = str(error.args[0])
    if not reason:
        return folders
    console.note(f"the deployment's own logs do not suffice ({reason}): record, identify from that")
    folders.append(call("record", flags.record, run_dir))
    return [*folders, *_run_with_retries(flags, call, "identify", replace(config, log=()), run_dir)]


def _run_with_retries(
    flags: RunFlags, call: CallStage, stage: str, config: Any, run_dir: Path | None
) -> list[StageFolder]:
    """Run a stage; in a run of several iterations again while its result asks for wider bounds or more steps.

    A worn robot leaves the bounds of a data sheet; a policy for more friction takes more steps to train.
    """
    from sim2real.commands.loop.retry import MAX_RETRIES, retry_config, run_with_retries

    def following(config: Any, folder: StageFolder) -> Any:
        changed, reason = retry_config(config, folder)
        if changed is not None:
            console.note(f"{stage} again: {reason}")
        return changed

    retries = MAX_RETRIES.get(stage, 0) if flags.iterations > 1 else 0
    attempts_made = run_with_retries(lambda config: call(stage, config, run_dir), config, following, retries)
    return [folder for _, folder in attempts_made]


@dataclass
class ResumedCalls:
    """Calls stages, but first returns the attempts that an interrupted iteration has finished, the oldest first.

    An iteration depends on the results of its stages alone, so the same results lead it to the point of interruption.
    """

    call: CallStage
    attempts: dict[str, list[StageFolder]]
    """Stage -> its attempts that have not been returned yet."""

    @staticmethod
    def of(call: CallStage, run_dir: Path | None, before: tuple[str, ...]) -> ResumedCalls:
        """Find the attempts that finished after an iteration started.

        Args:
            run_dir: The run's folder; None: it does not exist yet.
            before: Stage folders that were finished when the iteration started.
        """
        if run_dir is None:
            return ResumedCalls(call, {})
        new = {s: [a for a in attempts(run_dir, s) if a.finished and a.folder.name not in before] for s in STAGES}
        return ResumedCalls(call, {stage: newest_first[::-1] for stage, newest_first in new.items()})

    def __call__(self, stage: str, config: Any, run_dir: Path | None) -> StageFolder:
        """Return the next finished attempt of the stage if it is current; otherwise run the stage."""
        while self.attempts.get(stage) and run_dir is not None:
            attempt = self.attempts[stage].pop(0)
            if not (reason := why_stale(attempt, stage_status(run_dir))):
                console.note(f"{stage}: {attempt.folder.name} is finished, skipped")
                return attempt
            console.note(f"{stage}: {reason}")
        return self.call(stage, config, run_dir)
