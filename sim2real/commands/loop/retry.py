"""Retries of an unattended run: identify with wider bounds, train with more steps."""

import shlex
from collections.abc import Callable
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

from sim2real.artifacts.bundle import History
from sim2real.artifacts.identification import ROUND_TRIP, Identification
from sim2real.artifacts.run.run_folder import StageFolder
from sim2real.stages.identify.config import IdentifyConfig
from sim2real.stages.train.config import TrainConfig

C = TypeVar("C")
R = TypeVar("R")
MAX_RETRIES = {"identify": 2, "train": 2}
"""Limit on retries of a stage: bounds that widen without limit would hide a wrong model."""
MIN_SUCCESS = 0.95
"""Success in simulation below which a policy is trained for longer instead of deployed."""
_STEPS_FACTOR = 2


def run_with_retries(
    run: Callable[[C], R], config: C, following: Callable[[C, R], C | None], max_retries: int
) -> list[tuple[C, R]]:
    """Return the configuration and result of each attempt; the last attempt is the one to use.

    Args:
        following: Returns the configuration of a retry from those of an attempt and its result; None ends the retries.
    """
    attempts = [(config, run(config))]
    while len(attempts) <= max_retries and (changed := following(*attempts[-1])) is not None:
        attempts.append((changed, run(changed)))
    return attempts


def retry_config(config: Any, folder: StageFolder) -> tuple[Any, str]:
    """Return the configuration of a stage's retry and the reason for it; None and "" if it needs no retry."""
    if folder.stage == "identify":
        identification = Identification.load(folder.output("parameters"))
        return with_wider_bounds(config, identification), f"an estimate lies at a bound: {identification.verdict.next}"
    if folder.stage == "train" and "history" in folder.outputs:
        reason = (
            f"the policy succeeds in less than {MIN_SUCCESS:g} of the episodes in simulation; "
            f"{_STEPS_FACTOR} times the steps"
        )
        return with_more_steps(config, History.load(folder.output("history"))), reason
    return None, ""


def with_wider_bounds(config: IdentifyConfig, identification: Identification) -> IdentifyConfig | None:
    """Return a configuration with the bounds that the verdict proposes; None if it proposes none."""
    if identification.verdict.status != "change the model":
        return None
    words, wider = shlex.split(identification.verdict.next), config
    for i, word in enumerate(words):
        if word == "--bounds":
            name, low, high = words[i + 1 : i + 4]
            wider = replace(wider, bounds={**wider.bounds, name: (float(low), float(high))})
        elif word == "--max-delay-s":
            wider = replace(wider, max_delay_s=float(words[i + 1]))
    return None if wider == config else wider


def why_insufficient(identification: Identification) -> str:
    """Return why the logs of a deployment do not suffice to identify from; "" if they do.

    The motion of a policy may not separate a delay from inertia, and a delay of 0 is accepted.
    """
    if identification.verdict.status != "accepted":
        return identification.verdict.status
    round_trip = next((p for p in identification.parameters if p.name == ROUND_TRIP), None)
    if round_trip is None or round_trip.verdict in ("ok", "fixed"):
        return ""
    return f"the sum of the delays is {round_trip.verdict}"


def with_more_steps(config: TrainConfig, history: History) -> TrainConfig | None:
    """Return a configuration with more policy steps; None if the policy succeeds in simulation."""
    target = MIN_SUCCESS if config.ppo.target is None else min(MIN_SUCCESS, config.ppo.target)
    if np.nanmax(history.success, initial=0.0) >= target:
        return None
    return replace(config, ppo=replace(config.ppo, total_steps=_STEPS_FACTOR * config.ppo.total_steps))
