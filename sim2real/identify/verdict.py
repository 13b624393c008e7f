"""Whether an identification is worth anything: judged on data that it has not seen."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
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
    shifted: bool,
    beyond: Sequence[str] = (),
) -> Verdict:
    """Judge an identification.

    Args:
        prediction: Rows of ``prediction.errors``.
        spread: Its uncertainty.
        names: Names of the parameters, in the order of ``spread``.
        check: What the data determines at the estimate.
        shifted: Whether time can be shifted between delays: then only their sum counts, and that is as it should be.
        beyond: Where held-out data goes beyond what was fitted: sentences.
    """
    held_out = [row for row in prediction if row["held_out"] and row["rmse"] is not None]
    horizon_s = max((row["horizon_s"] for row in held_out), default=None)
    # What diverged to no number is infinitely wrong.
    last = {
        row["model"]: row["rmse"] if math.isfinite(row["rmse"]) else math.inf
        for row in held_out
        if row["horizon_s"] == horizon_s
    }
    own = last.pop("identified", None)
    alike = [] if own is None else [m for m, e in last.items() if own >= _BETTER * e]
    better = [m for m in alike if m != NO_DELAY]
    bounds = [n for n, v in zip(names, spread.verdict, strict=True) if v == "at a bound"]
    delays = {n for n in names if n.endswith("_delay")} if shifted else set()
    loose = [(g, m) for g, m in zip(check.undetermined, check.messages, strict=True) if not set(g) <= delays]
    reasons = []
    if own is None:
        reasons.append("nothing was held out: how well it predicts is not known")
    elif better:
        reasons.append(f"{horizon_s:g} s ahead on held-out data it is no better than: {', '.join(better)}")
    else:
        closest = min(last, key=lambda m: last[m]) if last else None
        if closest:
            reasons.append(
                f"{horizon_s:g} s ahead on held-out data its error is {own / last[closest]:.2g} times that of {closest}"
            )
    if NO_DELAY in alike and not better:
        reasons.append("without any delay it predicts as well: this data does not need one")
    reasons += beyond
    if bounds:
        reasons.append(f"at a bound: {', '.join(bounds)}; widen it with --bounds NAME LOW HIGH, or doubt the model")
    reasons += [message for _, message in loose]
    if spread.misfit > 3.0:
        reasons.append(
            f"residuals are {spread.misfit:.2g} times the measurement's deviation: the model explains the data only in "
            "part, and intervals follow how much estimates vary from block to block"
        )
    status: Status = (
        "no improvement on held-out data"
        if better
        else "hit a bound"
        if bounds
        else "not identifiable"
        if loose
        else "accepted"
    )
    return Verdict(status, tuple(reasons))
