"""PPO on the environment of a training, with a progress bar."""

from dataclasses import replace
from pathlib import Path

import jax

from sim2real.stages.terminal.console import progress
from sim2real.stages.terminal.interruption import patiently
from sim2real.stages.train.config import TrainConfig
from sim2real.stages.train.show import Watch, show_progress
from sim2real.stages.train.training_setup import TrainingSetup
from sim2real.training.ppo.trainer import Progress, TrainResult, train
from sim2real.training.scale.processes import leads, lost_process_errors, require_neighbours
from sim2real.training.sweep import Sweep


def learn_policy(
    setup: TrainingSetup,
    config: TrainConfig,
    checkpoint: Path | None,
    resume: Path | None,
    watch: Watch | None,
) -> TrainResult:
    """Train by PPO, with a progress bar; ``checkpoint`` is written after each evaluation, ``resume`` is continued."""
    ppo = replace(config.ppo, eval_steps=setup.env.length + 1)
    key, sweep = jax.random.key(config.seed), Sweep.parse(config.sweep)
    with progress(ppo.evaluations, "train (compiling)", leads()) as bar, lost_process_errors():

        def show(evaluation: Progress) -> None:
            show_progress(bar, evaluation, watch)

        return patiently(
            lambda: train(setup.env, ppo, key, show, checkpoint, resume, sweep=sweep),
            require_neighbours,
        )
