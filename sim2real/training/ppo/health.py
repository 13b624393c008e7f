"""Errors for figures of a training that are missing or not finite."""

import numpy as np

from sim2real.errors import Sim2RealError, UsageError
from sim2real.training.config import PPOConfig
from sim2real.training.environment.protocol import TrainingEnvironment, metric_names

FINITE = {
    "finite_observation": ("the observation", "reset or step"),
    "finite_privileged": ("the privileged observation", "privileged"),
}
"""Figures that mark which entries were finite: name -> the array, and the environment's method that makes it."""


def check_values(values: dict[str, np.ndarray], env_steps: int, config: PPOConfig, names: list[str]) -> None:
    """Raise if a value is not finite or no episode ended.

    Args:
        values: Name -> shape ``(num_seeds,)``; those in ``FINITE`` have a second axis, of the entries.
        names: Name of each place on the seed axis, such as ``seed 0``.
    """
    # Causes come before their consequences: observations, rewards, then losses.
    for seed, name in enumerate(names):
        when = f"({name}, within {env_steps} rows)"
        for part, (array, method) in FINITE.items():
            entries = np.flatnonzero(~values[part][seed]) if part in values else np.empty(0)
            if entries.size:
                raise Sim2RealError(
                    f"entries {entries.tolist()} of {array} are not finite {when}",
                    hint=f"the environment's {method} makes them: check their divisions and integrations",
                )
        if not np.isfinite(values["reward"][seed]):
            raise Sim2RealError(
                f"the reward is not finite {when}", hint="check what the environment's reward divides by"
            )
        diverged = sorted(name for name in ("loss", "kl", "entropy") if not np.isfinite(values[name][seed]))
        if diverged:
            raise Sim2RealError(
                f"the training's {' and '.join(diverged)} is not finite {when}, observations and rewards are",
                hint=f"lower learning_rate (now {config.learning_rate}) or reward_scale (now {config.reward_scale})",
            )
        if values["finished"][seed] == 0:
            raise UsageError(
                f"no evaluation episode ended within eval_steps={config.eval_steps} rows",
                hint="raise eval_steps above the longest episode, or let the environment truncate",
            )
        # Metrics of episodes come last: they may follow from the causes above.
        metrics = sorted(name for name, value in values.items() if not np.isfinite(value[seed]).all())
        if metrics:
            raise Sim2RealError(f"metrics {', '.join(metrics)} of finished episodes are not finite {when}")


def check_target(env: TrainingEnvironment, config: PPOConfig) -> None:
    """Raise a ``UsageError`` if the configuration has a target and the environment reports no success."""
    if config.target is not None and "success" not in (names := metric_names(env)):
        raise UsageError(
            f"target={config.target} is a share of success, and the environment's metrics have none: {sorted(names)}",
            hint="add 'success' to the metrics of its steps",
        )
