"""Whether an identification is worth anything: judged on data that it has not seen."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from sim2real.identify.identifiability import Check
from sim2real.identify.uncertainty import Uncertainty

Status = Literal["accepted", "no improvement on held-out data", "not identifiable", "hit a bound"]
_BETTER = 0.95
"""The error on held-out data must be below this share of every baseline's."""
NO_DELAY = "no delay"
"""The same model fitted without delays. Where it is as good, the delays are not needed; that is no failure."""


@dataclass(frozen=True)
class Verdict:
    """The judgement.

    Attributes:
        status: One of four; the first that applies of: no improvement, hit a bound, not identifiable, accepted.
        reasons: Sentences.
    """

    status: Status
    reasons: tuple[str, ...]


def judge(
    prediction: Sequence[Mapping[str, Any]],
    spread: Uncertainty,
    names: Sequence[str],
    check: Check,
    shifted: Collection[str] = (),
    beyond: Sequence[str] = (),
) -> Verdict:
    """Judge an identification.

    Args:
        prediction: Rows of ``prediction.errors``.
        spread: Its uncertainty.
        names: Names of the parameters, in the order of ``spread``.
        check: What the data determines at the estimate.
        shifted: Delays between which time can be shifted: only their sum counts, and that is as it should be.
        beyond: Where held-out data goes beyond what was fitted: sentences.
    """
    improves, reasons = _on_held_out(prediction)
    bounds = [n for n, v in zip(names, spread.verdict, strict=True) if v == "at a bound"]
    groups = zip(check.undetermined, check.messages, strict=True)
    loose = [message for group, message in groups if not set(group) <= set(shifted)]
    reasons += beyond
    if bounds:
        reasons.append(f"at a bound: {', '.join(bounds)}; widen it with --bounds NAME LOW HIGH, or doubt the model")
    reasons += loose
    if spread.misfit > 3.0:
        reasons.append(
            f"residuals are {spread.misfit:.2g} times the measurement's deviation: the model explains the data only in "
            "part, and intervals follow how much estimates vary from block to block"
        )
    status: Status = "accepted"
    if not improves:
        status = "no improvement on held-out data"
    elif bounds:
        status = "hit a bound"
    elif loose:
        status = "not identifiable"
    return Verdict(status, tuple(reasons))


def _on_held_out(prediction: Sequence[Mapping[str, Any]]) -> tuple[bool, list[str]]:
    """Return whether it beats every baseline on held-out data at the longest horizon, and what to say of it."""
    held_out = [row for row in prediction if row["held_out"] and row["rmse"] is not None]
    horizon_s = max((row["horizon_s"] for row in held_out), default=None)
    # What diverged to no number is infinitely wrong.
    last = {
        row["model"]: row["rmse"] if math.isfinite(row["rmse"]) else math.inf
        for row in held_out
        if row["horizon_s"] == horizon_s
    }
    own = last.pop("identified", None)
    if own is None:
        return True, ["nothing was held out: how well it predicts is not known"]
    alike = [m for m, e in last.items() if own >= _BETTER * e]
    better = [m for m in alike if m != NO_DELAY]
    ahead = f"{horizon_s:g} s ahead on held-out data"
    if better:
        return False, [f"{ahead} it is no better than: {', '.join(better)}"]
    reasons = []
    if last:
        closest = min(last, key=lambda m: last[m])
        reasons.append(f"{ahead} its error is {own / last[closest]:.2g} times that of {closest}")
    if alike:
        reasons.append("without any delay it predicts as well: this data does not need one")
    return True, reasons
