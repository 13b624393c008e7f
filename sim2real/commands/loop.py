"""The loop of a run: the four stages, then iterations, in which each verdict decides which stages run again."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from sim2real.artifacts.bundle import Bundle
from sim2real.artifacts.deployment import Deployment, Drift
from sim2real.artifacts.identification import ROUND_TRIP, Identification
from sim2real.artifacts.iterations import Iteration, iterations, iterations_table
from sim2real.artifacts.paths import shown
from sim2real.artifacts.recording import Recording
from sim2real.artifacts.run import STAGES, StageFolder, finished, stage_status
from sim2real.artifacts.summary import Shown
from sim2real.commands.stages import RunFlags, module_of
from sim2real.errors import DelayChanged, Sim2RealError, UsageError
from sim2real.robots.robot import RecordedRobot
from sim2real.stages.config import DeployConfig, IdentifyConfig, RecordConfig, TrainConfig
from sim2real.stages.deploy.verdict import logs_to_identify, terms_to_identify
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
            "a dry recording holds no motion: a run cannot identify from it",
            hint=f"`sim2real record {robot.name} --dry-run` records alone; of a run, only deploy can be dry",
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
    """Return why a run deploys the policy that its pipeline ships; "" if it trains one."""
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
        words: The plan, or why the run stops, as text.
        log: The logs to identify from; empty for the newest recording.
        terms: The optional terms to identify with; None for the flags' value.
        seed: The seed of the training; None for the flags' value.
    """

    stages: tuple[str, ...]
    words: str
    log: tuple[str, ...] = ()
    terms: str | None = None
    seed: int | None = None


@dataclass
class _Iterating:
    """The iterations of a run. Each plan follows from the run folder alone, so that an interrupted run goes on."""

    robot: RecordedRobot
    flags: RunFlags
    call: CallStage

    def run(self, run_dir: Path | None) -> Path:
        """Run the stages of a plan, make the next plan; until a plan has no stages.

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
        plan = Plan(STAGES, ", ".join(STAGES)) if run_dir is None else self._plan(run_dir, resumed=True)
        while plan.stages:
            refusal = None
            for stage in plan.stages:
                note(f"{stage} (iteration {len(rows) + 1})")
                try:
                    run_dir = self._stage(stage, self._config(plan, stage), run_dir).run_dir
                except DelayChanged as error:
                    refusal = error
                    break
            if run_dir is None:
                raise refusal or UsageError("this run has no folder, because no stage ran")
            plan, rows = self._plan(run_dir), iterations(run_dir)
            note(f"iteration {len(rows)}: {rows[-1].verdict}; {plan.words}")
        if refusal is not None:
            raise refusal
        assert run_dir is not None  # only a plan for a run that exists has no stages
        print(artifact_table(iterations_table(iterations(run_dir)).without("why")))
        return run_dir

    def _plan(self, run_dir: Path, resumed: bool = False) -> Plan:
        """Return the plan that follows from the stages of a run.

        Args:
            resumed: Whether no plan has run yet: then stages may lack. After a plan has run, the deployment alone
                decides, so that no stage runs more often than there are iterations.
        """
        rows, status = iterations(run_dir), stage_status(run_dir)
        lacking = tuple(s for s in STAGES if s not in status or status[s].stale)
        if not rows:
            return Plan(lacking, ", ".join(lacking))
        last = rows[-1]
        drift = None if last.refused else Deployment.read(last.deployment.folder).drift
        # A recording that is older than the refusal of a policy shows another robot.
        recorded = status["record"].newest.manifest.started if "record" in status else ""
        if last.refused and recorded < last.deployment.manifest.started:
            plan = self._anew(run_dir, STAGES, drift)
        elif lacking and resumed:
            # The run was interrupted, or a stage was made by hand. An identification from named logs may not suffice.
            known = status.get("identify")
            if lacking[0] == "train" and known is not None and (known.newest.manifest.config or {}).get("log"):
                lacking = STAGES if _why_insufficient(self._newest_identification(run_dir)) else lacking
            return self._anew(run_dir, lacking, drift)
        else:
            plan = self._after(run_dir, last.deployment)
        if plan.stages and len(rows) >= self.flags.iterations:
            return Plan((), f"the last iteration: it would {plan.words}")
        return plan

    def _after(self, run_dir: Path, folder: StageFolder) -> Plan:
        """Return the plan that follows from the newest deployment."""
        deployment = Deployment.read(folder.folder)
        # Stop if the policy works, or if no stage can improve the result.
        verdict = deployment.verdict
        if verdict is None or verdict.status in ("look at this joint", "not judged"):
            return Plan((), f"stop: {next(iter(deployment.reasons), 'the deployment was not judged')}")
        if verdict.status == "fine":
            return Plan((), "stop: the policy works on the robot")
        # Train again if the model holds and the timing of the training does, too.
        seed = self._next_seed(run_dir)
        if verdict.stages == ("train",):
            return Plan(("train", "deploy"), "train with another seed, deploy", seed=seed)
        # Otherwise identify from the deployment's logs, or record first if they are too short.
        identification = self._newest_identification(run_dir)
        outputs = sorted(folder.outputs.items())
        deployed = [path for name, path in outputs if name.startswith("log_") or name == "probe"]
        logs = logs_to_identify(deployed, deployment.drift, identification, folder.folder)
        if not logs:
            return self._anew(run_dir, STAGES, deployment.drift)
        terms = terms_to_identify(self.flags.identify.terms, self.robot, identification, deployment.drift)
        words = f"identify from {len(logs)} log{'s' * (len(logs) > 1)}, the deployment's among them, train, deploy"
        return Plan(("identify", "train", "deploy"), words, logs, terms, seed)

    def _anew(self, run_dir: Path, stages: tuple[str, ...], drift: Drift | None) -> Plan:
        """Return the plan to run stages from new recordings, with the terms of the newest identification."""
        words = ", ".join(stages)
        if finished(run_dir, "identify") is None:
            return Plan(stages, words)
        known = self._newest_identification(run_dir)
        terms = terms_to_identify(self.flags.identify.terms, self.robot, known, drift)
        return Plan(stages, words, terms=terms, seed=self._next_seed(run_dir))

    def _config(self, plan: Plan, stage: str) -> Any:
        """Return the configuration of a stage: that of the flags, with the changes of the plan."""
        if stage == "identify" and plan.terms is not None:
            return replace(self.flags.identify, log=plan.log, terms=plan.terms)
        if stage == "train" and plan.seed is not None:
            return replace(self.flags.train, seed=plan.seed)
        return getattr(self.flags, stage)

    def _stage(self, stage: str, config: Any, run_dir: Path | None) -> StageFolder:
        """Run a stage; record first where the logs of a deployment do not suffice to identify from.

        A policy that holds still excites no parameter; one that balances amplifies errors a hundredfold.
        """
        if stage != "identify" or not config.log:
            return self.call(stage, config, run_dir)
        try:
            folder = self.call(stage, config, run_dir)
            if not (reason := _why_insufficient(Identification.load(folder.output("parameters")))):
                return folder
        except DelayChanged:
            raise
        except Sim2RealError as error:
            reason = str(error.args[0])
        note(f"the deployment's own logs do not suffice ({reason}): record, identify from that")
        recorded = self.call("record", self.flags.record, run_dir)
        return self.call("identify", replace(config, log=()), recorded.run_dir)

    def _newest_identification(self, run_dir: Path) -> Identification:
        folder = finished(run_dir, "identify")
        if folder is None:
            raise Sim2RealError("this run has no identification", hint=f"sim2real identify {self.robot.name}")
        return Identification.load(folder.output("parameters"))

    def _next_seed(self, run_dir: Path) -> int:
        """Return the seed after that of the newest training: the same seed would train the same policy."""
        training = finished(run_dir, "train")
        return 1 + int(training.manifest.config["seed"]) if training is not None else self.flags.train.seed


def _why_insufficient(identification: Identification) -> str:
    """Return why the logs of a deployment do not suffice to identify from; "" if they do.

    The motion of a policy may not separate a delay from inertia, and a delay of 0 is accepted.
    """
    if identification.verdict.status != "accepted":
        return identification.verdict.status
    round_trip = next((p for p in identification.parameters if p.name == ROUND_TRIP), None)
    if round_trip is None or round_trip.verdict in ("ok", "fixed"):
        return ""
    return f"the round trip delay is {round_trip.verdict}"


# -- for Python


@dataclass(frozen=True, repr=False)
class Run(Shown):
    """A run folder: the newest finished result of each stage, read when it is first asked for."""

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
        resume: A run folder to go on with, from the first stage that is not finished there.
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
