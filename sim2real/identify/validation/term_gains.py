"""What each optional term gains on held-out parts, from the sets that were fitted."""

from collections.abc import Sequence

import numpy as np

from sim2real.artifacts.identification import Outcome, TriedTerm
from sim2real.identify.parameters import ParameterTable
from sim2real.identify.validation.optional_terms import Trial, better
from sim2real.identify.validation.term_trials import LITTLE


def gains(trials: Sequence[Trial], around: Trial, table: ParameterTable) -> tuple[TriedTerm, ...]:
    """Return the terms that were tried; those of a set come first, then the others by their gain.

    Two sets that differ by a term show its gain, with it or without it. Of several pairs the nearest to ``around``
    counts.
    """
    rows, limits = [], table.of_limits()
    for i, term in enumerate(table.terms):
        one = np.arange(len(table.terms)) == i
        pairs = [
            (with_it, without)
            for with_it in trials
            for without in trials
            if not without.present[i] and np.array_equal(with_it.present, without.present | one)
        ]
        if not pairs:
            rows.append(TriedTerm(term, float(_error(around)), None, "not fitted"))
            continue
        off = [int(np.sum((with_it.present ^ around.present) & ~one)) for with_it, _ in pairs]
        with_it, without = pairs[int(np.argmin(off))]
        outcome: Outcome = "mends" if better(with_it.ahead, without.ahead) else "no gain"
        if limits[i] and with_it.loss >= (1.0 - LITTLE) * without.loss:
            outcome = "not reached"
        rows.append(TriedTerm(term, _error(without), _error(with_it), "chosen" if around.present[i] else outcome))
    return tuple(sorted(rows, key=lambda r: (r.outcome != "chosen", -(r.gain or 0.0))))


def _error(trial: Trial) -> float:
    """Return the root mean square error on held-out parts [deviations of a measurement]."""
    return float(np.sqrt(np.nan_to_num(trial.ahead, nan=np.inf).mean()))
