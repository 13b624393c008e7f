"""The loop of a run: the four stages, then iterations, in which each verdict selects the stages that run again."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from sim2real.artifacts.bundle import Bundle
from sim2real.artifacts.deployment import Deployment, Verdict
from sim2real.artifacts.identification import Identification
from sim2real.artifacts.iterations import Iteration, iterations, iterations_table
from sim2real.artifacts.paths import shown
from sim2real.artifacts.recording import Recording
from sim2real.artifacts.run import STAGES, StageFolder, finished, stage_status
from sim2real.artifacts.summary import Shown
from sim2real.commands.stages import RunFlags, module_of
from sim2real.errors import DelayChanged, UsageError
from sim2real.robots.robot import RecordedRobot
from sim2real.stages.config import DeployConfig, IdentifyConfig, RecordConfig, TrainConfig
from sim2real.stages.load import AnyRobot, defaults_of, robot_of, shipped_policy
from sim2real.stages.shared.arguments import AnyPath, config_of, folder_of
from sim2real.stages.shared.find_run import find_run
from sim2real.stages.terminal.console import artifact_table, note

CallStage = Callable[[str, Any, Path | None], StageFolder]
"""Runs a stage: its name, its configuration, the run folder; returns the stage's folder."""


def run_all(robot: RecordedRobot, flags: RunFlags, call: CallStage) -> Path | None:
    """Run the four stages in one run folder, from the first stage without a current result; then the iterations.

    Returns:
        The run folder; None if there is none.
    """
    # Refuse a dry recording, and find an interrupted run.
    if flags.record.dry_run:
        raise UsageError(
            "a dry recording has no motion: a run cannot identify from it",
            hint=f"`sim2real record {robot.name} --dry-run` only records; in a run, only deploy can be dry",
        )
    run_dir = find_run(flags.runs, flags.resume, robot.name) if flags.resume else None
    shipped = why_shipped(robot)
    if flags.iterations > 1 and shipped:
        raise UsageError(f"{shipped}, and iterations train another one", hint="run without --iterations")
    if flags.iterations > 1:
        return _Iterating(robot, flags, call).run(run_dir)
    # Skip the stages with a current result. After a stage that runs, the results of all later stages are out of date.
    rerun = False
    for number, stage in enumerate(STAGES, 1):
        title = f"{stage} ({number}/{len(STAGES)})"
        if stage == "train" and shipped:
            note(f"{title}: skipped, as {shipped}")
            continue
        status = None if rerun or run_dir is None else stage_status(run_dir).get(stage)
        if status is not None and not status.stale:
            note(f"{title}: finished before, skipped")
            continue
        rerun = True
        note(title if status is None else f"{title}: {status.stale}")
        run_dir = call(stage, getattr(flags, stage), run_dir).run_dir
    return run_dir


def why_shipped(robot: RecordedRobot) -> str:
    """Return why a run deploys the shipped policy of its pipeline; "" if it trains a policy."""
    if shipped_policy(robot.folder) is None:
        return ""
    import jax

    if jax.default_backend() == "gpu":
        return ""
    return f"{robot.name} ships a policy, and JAX has no GPU here to train one: the run deploys that policy"


@dataclass(frozen=True)
class Plan:
    """The stages to run next, in order; none if the run stops.

    Attributes:
        why: Why the run stops.
        terms: The optional terms to identify with; None: as in the flags.
        seed: The seed of the training; None: as in the flags.
    """

    stages: tuple[str, ...]
    why: str = ""
    terms: str | None = None
    seed: int | None = None


@dataclass
class _Iterating:
    """The iterations of a run. Each plan follows from the run folder alone, so that an interrupted run goes on."""

    robot: RecordedRobot
    flags: RunFlags
    call: CallStage

    def run(self, run_dir: Path | None) -> Path:
        """Run the stages of a plan and make the next plan, until a plan has no stages.

        Args:
            run_dir: The run's folder; None: the first stage makes it.

        Raises:
            DelayChanged: The deployment of the last iteration was refused.
        """
        if self.flags.deploy.dry_run:
            raise UsageError(
                "a dry deployment moves nothing, so no iteration follows from it", hint="run without --deploy.dry-run"
            )
        refusal, rows = None, list[Iteration]()
        plan = Plan(STAGES) if run_dir is None else self._plan(run_dir, resumed=True)
        while plan.stages:
            refusal = None
            for stage in plan.stages:
                note(f"{stage} (iteration {len(rows) + 1})")
                try:
                    run_dir = self.call(stage, self._config(plan, stage), run_dir).run_dir
                except DelayChanged as error:
                    refusal = error
                    break
            if run_dir is None:
                raise refusal or UsageError("this run has no folder, because no stage ran")
            plan, rows = self._plan(run_dir), iterations(run_dir)
            note(f"iteration {len(rows)}: {rows[-1].verdict}; {plan.why or ', '.join(plan.stages)}")
        if refusal is not None:
            raise refusal
        assert run_dir is not None  # a plan without stages belongs to an existing run
        print(artifact_table(iterations_table(iterations(run_dir)).without("why")))
        return run_dir

    def _plan(self, run_dir: Path, resumed: bool = False) -> Plan:
        """Return the plan that follows from the stages of a run.

        Args:
            resumed: Whether no plan has run yet: then stages may be missing. After that, only the deployment decides,
                so that no stage runs more often than there are iterations.
        """
        rows, status = iterations(run_dir), stage_status(run_dir)
        lacking = tuple(s for s in STAGES if s not in status or status[s].stale)
        if not rows:
            return Plan(lacking)
        last, verdict, stages = rows[-1], None, STAGES
        # A recording from before the refusal of a policy shows the robot before it changed.
        recorded = status["record"].newest.manifest.started if "record" in status else ""
        if not (last.refused and recorded < last.deployment.manifest.started):
            deployment = None if last.refused else Deployment.read(last.deployment.folder)
            verdict = None if deployment is None else deployment.verdict
            if lacking and resumed:  # the run was interrupted, or the user ran a stage alone
                return self._again(run_dir, lacking, verdict)
            if deployment is not None and (why := _why_stopped(deployment)):
                return Plan((), f"stop: {why}")
            # Only train again if the model and the timing still hold. Otherwise record: the motion of a policy may not
            # # separate a delay from inertia.
            if verdict is not None and verdict.stages == ("train",):
                stages = ("train", "deploy")
        if len(rows) >= self.flags.iterations:
            return Plan((), f"the last iteration: next would be {', '.join(stages)}")
        return self._again(run_dir, stages, verdict)

    def _again(self, run_dir: Path, stages: tuple[str, ...], verdict: Verdict | None) -> Plan:
        """Return the plan to run stages again, with the terms of the newest identification and another seed."""
        identified, trained = finished(run_dir, "identify"), finished(run_dir, "train")
        if identified is None:
            return Plan(stages)
        known = Identification.load(identified.output("parameters"))
        # The verdict adds the term of a changed parameter to the terms of the identification.
        terms = self.flags.identify.terms
        if terms not in ("auto", "all") and verdict is not None and verdict.terms:
            terms = verdict.terms
        elif terms not in ("auto", "all") and known.used_terms is not None:
            terms = ",".join(known.used_terms) or "none"
        # The same seed would train the same policy.
        seed = self.flags.train.seed if trained is None else 1 + int(trained.manifest.config["seed"])
        return Plan(stages, terms=terms, seed=seed)

    def _config(self, plan: Plan, stage: str) -> Any:
        """Return the configuration of a stage: the flags, with the changes of the plan."""
        if stage == "identify" and plan.terms is not None:
            return replace(self.flags.identify, log=(), terms=plan.terms)
        if stage == "train" and plan.seed is not None:
            return replace(self.flags.train, seed=plan.seed)
        return getattr(self.flags, stage)


def _why_stopped(deployment: Deployment) -> str:
    """Return why no stage can improve the result of a deployment; "" if one can."""
    verdict = deployment.verdict
    if verdict is None or verdict.status in ("look at this joint", "not judged"):
        return next(iter(deployment.reasons), "the deployment was not judged")
    return "the policy works on the robot" if verdict.status == "fine" else ""


# -- for Python


@dataclass(frozen=True, repr=False)
class Run(Shown):
    """The newest finished result of each stage in a run folder; each is read at its first use."""

    folder: Path

    @cached_property
    def recording(self) -> Recording:
        """The recording."""
        return Recording.load(self._stage("record"))

    @cached_property
    def identification(self) -> Identification:
        """The identification."""
        return Identification.load(self._stage("identify"))

    @cached_property
    def bundle(self) -> Bundle:
        """The policy."""
        return Bundle.load(self._stage("train"))

    @cached_property
    def deployment(self) -> Deployment:
        """The deployment."""
        return Deployment.load(self._stage("deploy"))

    def about(self) -> Mapping[str, Any]:
        done = [stage for stage in STAGES if finished(self.folder, stage) is not None]
        return {"folder": shown(self.folder), "finished": ", ".join(done) or "nothing"}

    def _stage(self, stage: str) -> Path:
        if (result := finished(self.folder, stage)) is None:
            raise UsageError(f"{stage} is not finished in {self.folder}", hint="sim2real.run(..., resume=FOLDER)")
        return result.folder


def run(
    robot: AnyRobot,
    runs: AnyPath = "runs",
    record: RecordConfig | Mapping[str, Any] | None = None,
    identify: IdentifyConfig | Mapping[str, Any] | None = None,
    train: TrainConfig | Mapping[str, Any] | None = None,
    deploy: DeployConfig | Mapping[str, Any] | None = None,
    resume: AnyPath | None = None,
    iterations: int = 1,
) -> Run:
    """Record, identify, train and deploy, one after the other, in one run folder.

    Args:
        robot: The robot, or the name of its pipeline.
        record: Settings of record; default: the robot's. A dict has the settings that differ from these.
        resume: A run folder to continue, from the first stage that is not finished.
        iterations: Most iterations; see ``sim2real run --help``.

    Returns:
        The run, with the results of its stages.
    """
    # Turn names and dicts into objects; each stage then runs as from the command line.
    robot, root = robot_of(robot), folder_of(runs, "runs")
    settings = {"record": record, "identify": identify, "train": train, "deploy": deploy}
    configs: dict[str, Any] = {n: config_of(settings[n], c, n) for n, c in defaults_of(robot).in_a_run.items()}
    home = None if resume is None else find_run(root, folder_of(resume, "resume"), robot.name)

    def call(stage: str, config: Any, run_dir: Path | None) -> StageFolder:
        nonlocal home
        done = importlib.import_module(module_of(stage)).run(robot, config, root, run_dir)
        home = done.run_dir
        return done

    run_all(robot, RunFlags(runs=root, resume=home, iterations=iterations, **configs), call)
    if home is None:
        raise UsageError("no stage ran")
    return Run(home)
