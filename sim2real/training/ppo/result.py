"""Progress and result of a training."""

import dataclasses

import numpy as np

from sim2real.training.networks.policy import Policy


@dataclasses.dataclass(frozen=True)
class Progress:
    """Progress of the training at an evaluation.

    Attributes:
        evaluation: Number of this evaluation, from 1.
        env_steps: Number of rows so far, per seed.
        elapsed_s: Time that training took so far, compilation included [s].
        values: Name -> shape ``(num_seeds,)``: ``return``, the environment's metrics, losses.
        best: The best policy so far, see ``TrainResult``; None in checkpoints, which hold it once.
    """

    evaluation: int
    evaluations: int
    env_steps: int
    elapsed_s: float
    values: dict[str, np.ndarray]
    best: Policy | None = None


@dataclasses.dataclass(frozen=True)
class TrainResult:
    """The result of a training.

    Attributes:
        policies: The policies at the end; leaves have a leading seed axis.
        best: The policy with the highest success rate over all seeds and evaluations; of equals, the highest return.
        best_seed: Its seed; of a sweep, its place on the seed axis.
        members: Swept settings of each place on the seed axis, empty without a sweep; all seeds of the first settings
            come first.
        history: Name -> shape ``(evaluations, num_seeds)``: the values of ``Progress``; shorter than
            ``config.evaluations`` if training ended earlier: at the target, or after ``config.minutes``.
        env_steps: Shape ``(evaluations,)``: number of rows per seed at each evaluation.
        elapsed_s: Shape ``(evaluations,)``: time that training took so far [s].
        observations: Shape ``(N, O)``: the copies' last observations, of the best policy's place on the seed axis.
        env_steps_per_s: Rows of all seeds per second of ``train_s``, without those of evaluations.
        compile_s: Time to trace and compile [s].
        train_s: Time to train and evaluate [s]; of a resumed training, since it was resumed.
    """

    policies: Policy
    best: Policy
    best_seed: int
    members: list[dict[str, float]]
    history: dict[str, np.ndarray]
    env_steps: np.ndarray
    elapsed_s: np.ndarray
    observations: np.ndarray
    env_steps_per_s: float
    compile_s: float
    train_s: float


def history_of(log: list[Progress]) -> dict[str, np.ndarray]:
    """Return name -> values, shape ``(evaluations, num_seeds)``."""
    return {name: np.stack([progress.values[name] for progress in log]) for name in log[0].values}


def find_best(history: dict[str, np.ndarray]) -> tuple[int, int]:
    """Return the index of the best evaluation and seed: by success, then by return, then the latest."""
    returns = history["return"]
    success = history.get("success", np.zeros_like(returns))
    evaluations, seeds = returns.shape
    cells = [(evaluation, seed) for evaluation in range(evaluations) for seed in range(seeds)]
    return max(cells, key=lambda cell: (success[cell], returns[cell], cell[0]))
