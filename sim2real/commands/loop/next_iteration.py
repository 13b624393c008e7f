"""The plan of the next iteration, from the verdict on the newest deployment."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from sim2real.artifacts.deployment import Deployment
from sim2real.artifacts.identification import Identification
from sim2real.artifacts.run.iterations import Iteration, Plan
from sim2real.artifacts.run.run_folder import STAGES, StageFolder, finished, portable
from sim2real.errors import Sim2RealError, UsageError
from sim2real.stages.deploy.next_command import logs_to_identify, needs_timing, terms_to_identify

if TYPE_CHECKING:
    from sim2real.artifacts.deployment import Drift
    from sim2real.commands.flags import RunFlags
    from sim2real.stages.pipeline.pipeline import Pipeline

ALL_STAGES = ", ".join(STAGES)


def newest_deployment(run_dir: Path) -> StageFolder:
    """Return the newest finished deployment of a run."""
    if (deployment := finished(run_dir, "deploy")) is None:
        raise UsageError(
            "this run has no deployment to judge", hint="run without --deploy.dry-run: a dry deployment moves nothing"
        )
    return deployment


def judge(
    row: Iteration, pipeline: Pipeline, flags: RunFlags, run_dir: Path, folder: StageFolder
) -> tuple[Iteration, Plan]:
    """Return an iteration's row, completed with the results of its deployment, and the plan of the next iteration."""
    deployment = Deployment.read(folder.folder)
    if success := next((g for g in deployment.gap if g.quantity == "success"), None):
        row = replace(row, real=success.real, simulation=success.simulation)
    if advice := deployment.advice:
        row = replace(row, verdict=advice.status, why=next(iter(advice.reasons), ""))
    return row, next_plan(pipeline, flags, run_dir, folder, deployment)


def next_plan(pipeline: Pipeline, flags: RunFlags, run_dir: Path, folder: StageFolder, deployment: Deployment) -> Plan:
    """Return the plan that follows from a deployment; a plan without stages ends the run.

    Raises:
        UsageError: The gap report has no quantity of the goal's name.
    """
    # Stop at the goal, or if no stage can improve the result.
    if flags.goal and _reached(deployment, *flags.goal):
        return Plan((), "stop: {} is at least {:g}".format(*flags.goal))
    advice = deployment.advice
    if advice is None or advice.status in ("look at this joint", "not judged"):
        reason = advice.reasons[0] if advice and advice.reasons else "the deployment was not judged"
        return Plan((), f"stop: {reason}")
    if advice.status == "fine" and not flags.goal:
        return Plan((), "stop: the policy works on the robot")

    # Train again if the model holds and the timing of the training does, too.
    seed = _next_seed(flags, run_dir)
    if advice.status != "re-identify" and not needs_timing(advice):
        return Plan(("train", "deploy"), "train with another seed, deploy", seed=seed)

    # Otherwise identify from the deployment's logs, or record first if they are too short.
    identification = _newest_identification(pipeline, run_dir)
    outputs = sorted(folder.outputs.items())
    deployed_logs = [path for name, path in outputs if name.startswith("log_") or name == "probe"]
    logs = logs_to_identify(deployed_logs, deployment.drift, identification, folder.folder)
    if not logs:
        return plan_all_stages(pipeline, flags, run_dir, deployment.drift)
    terms = terms_to_identify(flags.identify.terms, pipeline, identification, deployment.drift)
    words = f"identify from {len(logs)} log{'s' * (len(logs) > 1)}, the deployment's among them, train, deploy"
    log = tuple(portable(Path(path), run_dir) for path in logs)
    return Plan(("identify", "train", "deploy"), words, log, terms, seed)


def plan_all_stages(pipeline: Pipeline, flags: RunFlags, run_dir: Path, drift: Drift | None = None) -> Plan:
    """Return the plan for a robot that no log shows as it is now: all four stages."""
    terms = terms_to_identify(flags.identify.terms, pipeline, _newest_identification(pipeline, run_dir), drift)
    return Plan(STAGES, ALL_STAGES, terms=terms, seed=_next_seed(flags, run_dir))


def _newest_identification(pipeline: Pipeline, run_dir: Path) -> Identification:
    """Return the newest finished identification of a run."""
    folder = finished(run_dir, "identify")
    if folder is None:
        raise Sim2RealError("this run has no identification", hint=f"sim2real identify {pipeline.name}")
    return Identification.load(folder.output("parameters"))


def _next_seed(flags: RunFlags, run_dir: Path) -> int:
    """Return the seed after that of the newest training: the same seed would train the same policy."""
    training = finished(run_dir, "train")
    return 1 + (int(training.manifest["config"]["seed"]) if training is not None else flags.train.seed)


def _reached(deployment: Deployment, quantity: str, minimum: float) -> bool:
    """Return whether a quantity of the gap report is at least ``minimum`` on the robot."""
    on_robot = {g.quantity: g.real for g in deployment.gap}
    if quantity not in on_robot:
        raise UsageError(f"there is no {quantity!r} in the gap report. Available: {', '.join(on_robot) or 'none'}")
    real = on_robot[quantity]
    return real is not None and real >= minimum
