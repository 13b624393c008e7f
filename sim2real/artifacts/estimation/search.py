"""The search for an estimate."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True)
class Refinement:
    """A local refinement: the loss before and after, and the number of steps."""

    before: float | None
    after: float | None
    steps: int


@dataclass(frozen=True)
class Search:
    """The search for the estimate.

    Attributes:
        history: Best loss of each generation ``(G,)``.
        evaluations: Number of simulated candidates.
        loss: Best loss of an interrupted search.
        done: Completed shares of an interrupted search and refinement.
        engine: The simulator, and the reason for its choice.
    """

    strategy: str | None = None
    history: np.ndarray = field(default_factory=lambda: np.zeros(0))
    evaluations: int = 0
    refined: tuple[Refinement, ...] = ()
    seconds: float | None = None
    loss: float | None = None
    done: Mapping[str, float] = field(default_factory=dict)
    engine: str = ""
