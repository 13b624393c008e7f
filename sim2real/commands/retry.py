"""What a loop that nobody attends does once more, and how: identify with wider bounds, train for longer."""

from __future__ import annotations

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
MOST = {"identify": 2, "train": 2}
"""How often a stage is done once more at most: bounds that are moved for ever would hide that the model is wrong. Of an
SO-101 with twice the friction the elbow's was at its bound, and with a wider one the shoulder's at its own."""
GOOD = 0.95
"""Success in simulation below which a policy is not worth trying on a robot. Of ten arms with twice the friction six
stayed below after the usual number of steps, at 0.69 to 0.94, and five of those at 0.6 to 0.9 on the robot. Three were
trained again: after two or four times as many steps they had 0.98 to 1 in simulation, and 1 on the robot."""
_LONGER = 2


def repeated(run: Callable[[C], R], config: C, again: Callable[[C, R], C | None], most: int) -> list[tuple[C, R]]:
    """Return each way in which something was done, with what came out; the last is the one to use.

    Args:
        config: How, the first time.
        again: Returns from how it was done and what came out how to do it once more; None where it need not be.
        most: How often it is done once more at most.
    """
    tried = [(config, run(config))]
    while len(tried) <= most and (following := again(*tried[-1])) is not None:
        tried.append((following, run(following)))
    return tried


def better(config: Any, done: StageFolder) -> tuple[Any, str]:
    """Return how to do a stage once more, and why; None where it need not be."""
    if done.stage == "identify":
        found = Identification.load(done.output("parameters"))
        return with_wider_bounds(config, found), f"an estimate lies at a bound: {found.verdict.next}"
    if done.stage == "train" and "history" in done.outputs:
        why = f"the policy succeeds in less than {GOOD:g} of the episodes in simulation; {_LONGER} times as many steps"
        return for_longer(config, History.load(done.output("history"))), why
    return None, ""


def with_wider_bounds(config: IdentifyConfig, found: Identification) -> IdentifyConfig | None:
    """Return how to identify once more: with the bounds that the verdict asks for; None where it asks for none."""
    if found.verdict.status != "hit a bound":
        return None
    words, wider = shlex.split(found.verdict.next), config
    for i, word in enumerate(words):
        if word == "--bounds":
            name, low, high = words[i + 1 : i + 4]
            wider = replace(wider, bounds={**wider.bounds, name: (float(low), float(high))})
        elif word == "--max-delay-s":
            wider = replace(wider, max_delay_s=float(words[i + 1]))
    return None if wider == config else wider


def lacking(found: Identification) -> str:
    """Return why a deployment's own logs do not suffice to identify from; "" where they do.

    What a policy does need not tell a delay from inertia: the sum of the delays of an arm, 18 ms, came out as 0, with
    twice its armature, and that was accepted, as a delay may be 0.
    """
    if found.verdict.status != "accepted":
        return found.verdict.status
    trip = next((p for p in found.parameters if p.name == ROUND_TRIP), None)
    return "" if trip is None or trip.verdict in ("accepted", "fixed") else f"the sum of the delays is {trip.verdict}"


def for_longer(config: TrainConfig, history: History) -> TrainConfig | None:
    """Return how to train once more: with more policy steps; None where the policy succeeds in simulation.

    Args:
        history: How that went.
    """
    enough = GOOD if config.ppo.target is None else min(GOOD, config.ppo.target)
    if config.distil is not None or np.nanmax(history.success, initial=0.0) >= enough:
        return None
    return replace(config, ppo=replace(config.ppo, total_steps=_LONGER * config.ppo.total_steps))
