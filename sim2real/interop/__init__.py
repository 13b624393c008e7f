"""Robots with their delays, and composed tasks, as environments of gymnasium, Stable-Baselines3 and brax.

``sim2real.interop.vector_env("pendulum", 16)`` takes the parameters of the newest identification; guide:
``docs/guides/interop.md``. Composed tasks need none of the pipelines, which the functions import when they are called.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    from gymnasium.vector import AutoresetMode

    from sim2real.interop.brax import BraxEnv
    from sim2real.interop.robot import RobotEnvironment
    from sim2real.interop.vector import CopiesVectorEnv
    from sim2real.robots.robot import Robot
    from sim2real.stages.train.config import TrainConfig

    Source = str | Path | Robot
    """A run folder, or a robot or the name of its pipeline, whose newest identification is taken."""


def robot_environment(
    source: Source,
    model: Literal["identified", "nominal"] = "identified",
    values: Mapping[str, float] | None = None,
    config: TrainConfig | None = None,
    runs: Path | str = "runs",
) -> RobotEnvironment:
    """Return one copy of the environment that ``sim2real train`` trains in, as pure functions.

    Args:
        model: The estimates of identify with their uncertainty and timing, or the data sheet's values.
        values: Values of parameters that replace the model's. The nominal model has delays only if both are given:
            ``sensor_delay`` and ``actuator_delay`` [s].
        config: World, number and length of timelines, randomisation and seed; default: the robot's.

    Raises:
        UsageError: There is no such pipeline, run or parameter.
        Sim2RealError: There is no identification, or it is of another robot.
    """
    from sim2real.artifacts.identification import Identification
    from sim2real.artifacts.run import STAGES, attempts
    from sim2real.interop.robot import RobotEnvironment
    from sim2real.robots.robot import Robot
    from sim2real.stages.load import available, defaults_of, load_robot, moving
    from sim2real.stages.shared.find_run import find_parameters, find_run
    from sim2real.stages.train.bundle import contract_of
    from sim2real.stages.train.setup import prepare

    run = None
    if isinstance(source, Robot):
        robot = source
    elif str(source) in available():
        robot = moving(load_robot(str(source)))
    else:
        run = find_run(Path(runs), source)
        name = next(a.manifest.pipeline for s in STAGES for a in attempts(run, s))
        robot = moving(load_robot(name))
    config = replace(config or defaults_of(robot).train, model=model)
    identification = None
    if model != "nominal":
        identification = Identification.load(find_parameters(config.parameters or robot.name, Path(runs), run))
    setup = prepare(robot, config, identification, changed=values)
    return RobotEnvironment(setup.env, contract_of(setup.robot, setup.env.task, setup.values))


def vector_env(
    source: Source | RobotEnvironment, num_envs: int, autoreset_mode: AutoresetMode | str = "NextStep", **options: Any
) -> CopiesVectorEnv:
    """Return copies of a robot as a ``gymnasium.vector.VectorEnv``.

    Args:
        source: See ``robot_environment``, which also gets ``options``; or its result.
        autoreset_mode: When a finished copy is reset: ``NextStep`` or ``SameStep``.
    """
    from sim2real.interop.vector import CopiesVectorEnv

    return CopiesVectorEnv(_environment(source, options), num_envs, autoreset_mode)


def baselines_env(source: Source | RobotEnvironment, num_envs: int, seed: int | None = None, **options: Any) -> Any:
    """Return copies of a robot as a ``VecEnv`` of Stable-Baselines3.

    Args:
        source: See ``robot_environment``, which ``options`` go to as well; or its result.
        seed: Seed of the episodes; default: a random one.
    """
    from sim2real.interop.baselines import to_baselines

    return to_baselines(vector_env(source, num_envs, "SameStep", **options), seed)


def brax_env(source: Source | RobotEnvironment, **options: Any) -> BraxEnv:
    """Return a robot as a ``brax.envs.Env``.

    Args:
        source: See ``robot_environment``, which ``options`` go to as well; or its result.
    """
    from sim2real.interop.brax import BraxEnv

    return BraxEnv(_environment(source, options))


def _environment(source: Source | RobotEnvironment, options: dict[str, Any]) -> RobotEnvironment:
    from sim2real.interop.robot import RobotEnvironment

    return source if isinstance(source, RobotEnvironment) else robot_environment(source, **options)
