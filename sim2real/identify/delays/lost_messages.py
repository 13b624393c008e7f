"""Lost messages: their reader repeats the value before, in every digit."""

from dataclasses import dataclass

import numpy as np

from sim2real.artifacts.identification import Ranged

_DRAWS = 4000
"""Draws from which intervals are taken."""


@dataclass(frozen=True)
class Losses:
    """Losses of a link.

    Attributes:
        share: Share of the messages that are lost.
        burst: How many in a row are lost, on average [messages].
        each: Shape ``(N,)``: the probability that each was.
    """

    share: Ranged
    burst: Ranged
    each: np.ndarray


def losses(again: np.ndarray, chance: np.ndarray, rounds: int = 10) -> Losses:
    """Return how many messages were lost.

    Losses come in bursts: whether a message is lost depends on whether the one before was (Gilbert, Bell System
    Technical Journal 39, 1960). A robot at rest repeats values without any loss; that is what ``chance`` is for: it is
    1 if a repeated value is no evidence.

    Args:
        again: Shape ``(N,)``, bool: whether a measurement has the value of the one before it.
        chance: Shape ``(N,)``: how probable that is for a message that came; looked at where ``again`` is true.
    """
    # Transitions from a message that came or was lost (row) to one that came or was lost (column).
    move = np.array([[0.95, 0.05], [0.5, 0.5]])
    chances = np.stack([np.where(again, chance, 1.0), again.astype(float)], axis=1)
    counts, each = np.zeros((2, 2)), np.zeros(len(again))
    for _ in range(rounds):
        counts, each = _expected(chances, move)
        move = counts + 0.5
        move /= move.sum(axis=1, keepdims=True)
    rng = np.random.default_rng(0)
    begins = rng.beta(counts[0, 1] + 0.5, counts[0, 0] + 0.5, _DRAWS)
    ends = rng.beta(counts[1, 0] + 0.5, counts[1, 1] + 0.5, _DRAWS)
    total = float(each.mean())
    if each.sum() < 0.5:
        most = np.quantile(rng.beta(0.5, len(each) + 0.5, _DRAWS), 0.95)
        return Losses(Ranged(total, 0.0, float(most)), Ranged(None, None, None), each)
    low, high = np.quantile(begins / (begins + ends), [0.025, 0.975])
    length = float((counts[1].sum() + 1e-12) / max(counts[1, 0], 1e-12)) if counts[1, 0] > 0.5 else float(each.sum())
    short, long = np.quantile(1.0 / ends, [0.025, 0.975])
    share = Ranged(total, float(min(low, total)), float(max(high, total)))
    return Losses(share, Ranged(length, float(min(short, length)), float(max(long, length))), each)


def _expected(chances: np.ndarray, move: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the expected number of each transition ``(2, 2)``, and the probability of each loss ``(N,)``.

    Args:
        chances: Shape ``(N, 2)``: probability of the measured value, for a message that arrived and for a lost one.
        move: Shape ``(2, 2)``: probabilities of transitions.
    """
    count = len(chances)
    ahead, back = np.empty((count, 2)), np.ones((count, 2))
    ahead[0] = chances[0] * [0.5, 0.5]
    ahead[0] /= ahead[0].sum()
    for i in range(1, count):
        now = (ahead[i - 1] @ move) * chances[i]
        ahead[i] = now / now.sum()
    for i in range(count - 2, -1, -1):
        now = move @ (chances[i + 1] * back[i + 1])
        back[i] = now / now.sum()
    both = ahead[:-1, :, None] * move * (chances[1:] * back[1:])[:, None, :]
    both /= both.sum(axis=(1, 2), keepdims=True)
    state = ahead * back
    return both.sum(axis=0), state[:, 1] / state.sum(axis=1)
