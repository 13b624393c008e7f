"""From a pipeline or a run to an environment of another library."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from sim2real.artifacts.run.run_folder import STAGES, attempts
from sim2real.interop.environment import RobotEnvironment
from sim2real.robots.contract import Robot
from sim2real.stages.pipeline.find_run import find_run
from sim2real.stages.pipeline.open_parameters import open_identification
from sim2real.stages.pipeline.pipeline import Pipeline, available, load_pipeline, pipeline_of
from sim2real.stages.train.config import TrainConfig
from sim2real.stages.train.training_setup import contract_of, find_parameters, prepare

if TYPE_CHECKING:
    from sim2real.interop.robot_brax import RobotBraxEnv
    from sim2real.interop.robot_vector import RobotVectorEnv

Model = Literal["identified", "nominal"]


def robot_environment(
    source: str | Path | Pipeline | Robot,
    model: Model = "identified",
    values: Mapping[str, float] | None = None,
    config: TrainConfig | None = None,
    runs: Path | str = "runs",
) -> RobotEnvironment:
    """Return one copy of the environment that ``sim2real train`` trains in, as pure functions.

    Args:
        source: A run folder, or a pipeline, its name or its robot, of which the newest identification is taken.
        model: The parameters that identify found with their uncertainty and timing, or the data sheet's.
        values: Parameters with other values than the model's. The nominal model has delays where both are among them:
            ``sensor_delay`` and ``actuator_delay`` [s].
        config: World, number and length of timelines, randomisation and seed; default: the pipeline's.

    Raises:
        UsageError: When there is no such pipeline, run or parameter.
        Sim2RealError: When nothing was identified, or not for this robot.
    """
    if isinstance(source, Robot | Pipeline):
        pipeline, run = pipeline_of(source), None
    elif str(source) in available():
        pipeline, run = load_pipeline(str(source)), None
    else:
        run = find_run(Path(runs), source)
        pipeline = load_pipeline(_owner(run))
    config = replace(config or pipeline.train, model=model)
    path, _ = find_parameters(pipeline, config, Path(runs), run)
    identification = None if path is None else open_identification(path, pipeline)
    made = prepare(pipeline, config, identification, changed=values)
    return RobotEnvironment(made.env, contract_of(made.robot, made.env.task, made.values))


def vector_env(
    source: str | Path | Pipeline | Robot | RobotEnvironment,
    num_envs: int,
    autoreset_mode: Any = "NextStep",
    **options: Any,
) -> RobotVectorEnv:
    """Return copies of a robot as a ``gymnasium.vector.VectorEnv``.

    Args:
        source: As in ``robot_environment``, or what that returned.
        autoreset_mode: What happens to a copy that is done: ``NextStep``, ``SameStep`` or ``Disabled``.
        **options: Those of ``robot_environment``.
    """
    from sim2real.interop.robot_vector import RobotVectorEnv

    return RobotVectorEnv(_made(source, options), num_envs, autoreset_mode)


def baselines_env(
    source: str | Path | Pipeline | Robot | RobotEnvironment, num_envs: int, seed: int | None = None, **options: Any
) -> Any:
    """Return copies of a robot as a ``VecEnv`` of Stable-Baselines3.

    Args:
        source: As in ``robot_environment``, or what that returned.
        seed: Seed of the episodes; default: a random one.
        **options: Those of ``robot_environment``.
    """
    from sim2real.interop.baselines import to_baselines

    return to_baselines(vector_env(source, num_envs, "SameStep", **options), seed)


def brax_env(
    source: str | Path | Pipeline | Robot | RobotEnvironment, fresh_starts: bool = True, **options: Any
) -> RobotBraxEnv:
    """Return a robot as a ``brax.envs.Env``.

    Args:
        source: As in ``robot_environment``, or what that returned.
        fresh_starts: Whether each episode of a copy starts from a state of its own, at the price of a reset a step.
        **options: Those of ``robot_environment``.
    """
    from sim2real.interop.robot_brax import RobotBraxEnv

    return RobotBraxEnv(_made(source, options), fresh_starts)


def _made(source: Any, options: dict[str, Any]) -> RobotEnvironment:
    return source if isinstance(source, RobotEnvironment) else robot_environment(source, **options)


def _owner(run: Path) -> str:
    """Return the pipeline that a run is of."""
    found = [str(a.manifest.get("pipeline")) for stage in STAGES for a in attempts(run, stage)]
    return found[0]
