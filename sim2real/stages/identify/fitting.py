"""The fits of an identification: with all optional terms, with the selected ones, and without parts of the logs."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np

from sim2real.artifacts.identification import Determined, HeldOutPart
from sim2real.graph.episode import Episode
from sim2real.identification.fit import Fit, OnProgress, as_numbers, fit
from sim2real.identification.held_out import MOST, Fold, Refits, folds_of, leave_out
from sim2real.identification.model import IdentifiableModel
from sim2real.identification.parameters import ParameterTable
from sim2real.identification.problem import Problem
from sim2real.identification.residuals import Linearised
from sim2real.identification.segments import Span
from sim2real.identification.terms import Selection, TermSearch
from sim2real.identification.uncertainty import ABSENT, NOT_REACHED, Uncertainty, between_parts
from sim2real.identification.uncertainty import determined as what_is_determined
from sim2real.stages.identify.config import IdentifyConfig
from sim2real.stages.identify.inputs import Inputs
from sim2real.stages.identify.progress import Best
from sim2real.stages.shared.identification import long_spans
from sim2real.stages.terminal.console import note, progress
from sim2real.stages.terminal.interruption import patiently

_PERCENT_OF_SEARCH, _PERCENT_OF_REFINEMENT = 70, 30
"""Shares of a progress bar."""
_AS_GOOD = 3e-4
"""Relative excess of the loss up to which a fit with a held parameter is as good."""
LEAST_SEGMENTS = 4
"""Fewest segments from which parts are held out."""
_LEAST_TO_CHOOSE = 3
"""Fewest parts for a selection of terms: one is held out, and the others predict each other."""
_LEAST_PARTS = 4
"""Fewest parts from which the spread of estimates is computed."""


@dataclass(frozen=True)
class Fits:
    """The fits of an identification.

    Attributes:
        widest: The fit with all optional terms.
        estimate: The fit with the selected terms.
        selection: How the terms were selected; None without a selection.
    """

    widest: Fit
    estimate: Fit
    selection: Selection | None

    @property
    def terms(self) -> tuple[str, ...] | None:
        """Names of the optional terms of the estimate; None if the model has none."""
        return self.estimate.problem.table.terms if self.widest.problem.table.terms else None


def fit_model(inputs: Inputs, best: Best) -> Fits:
    """Fit the model, and select its optional terms if the configuration is ``auto``.

    Args:
        best: Updated with the best values so far.
    """
    config, table = inputs.config, inputs.table
    data = (inputs.model, inputs.episodes, inputs.fitted, inputs.windows)

    def on_begin(problem: Problem) -> None:
        note(f"engine: {problem.engine}")
        if (few := len(problem.train)) < (every := sum(span.fitted for span in inputs.windows)):
            note(f"the fit takes {few} of {every} segments, those with most motion of each log; all are predicted")
        best.begin(problem)

    # Fit the model with all terms that the configuration allows; terms are selected on windows, which takes less time.
    auto = config.terms == "auto"
    wide = replace(config, long_s=0.0) if auto else config
    best.restart(table)
    with _progress("identify", best) as report:
        widest = patiently(lambda: fitted_to(*data, wide, table, report, on_begin, as_start=auto))
    if not auto:
        return Fits(widest, widest, None)
    # Select the terms without which held-out parts are predicted worse.
    with progress(None, "identify: sets of terms") as bar:
        on_set = bar.set_postfix_str
        selection = patiently(lambda: chosen(widest, config, inputs.names, inputs.refits, on_set))
    terms: Sequence[str] = selection.chosen.names(widest.problem.table)
    # Refine the model with the selected terms. A value fixed by a flag stays fixed, in whichever term the parameter is;
    # the parameters of all other terms have their values without the term.
    narrow = table.with_terms(terms).with_fixed(config.fix)
    values = as_numbers(widest.problem.table, selection.chosen.x)
    narrow = narrow.with_begin({p.name: values[p.name] for p in narrow if p.free})
    best.restart(narrow)
    with _progress(f"identify with {', '.join(terms) or 'no term'}", best) as report:
        estimate = patiently(lambda: fitted_to(*data, replace(config, generations=0), narrow, report, best.begin))
    return Fits(widest, estimate, selection)


def determined(inputs: Inputs, fits: Fits, check: Determined, spread: Uncertainty) -> tuple[Fits, list[str]]:
    """Hold parameters that the data does not determine at their nominal values, as long as the fit stays as good.

    Returns:
        The fits, and a sentence for each held parameter.
    """
    estimate, groups, sentences = fits.estimate, check.undetermined, list[str]()
    table, tried, data = estimate.problem.table, set[str](), (inputs.model, inputs.episodes, inputs.fitted)
    absent = [n for n, verdict in zip(table.names, spread.verdict, strict=True) if verdict in (ABSENT, NOT_REACHED)]
    config, able = inputs.config, {p.name for p in table if p.kind == "dynamics" and not p.term}
    while names := [n for group in groups for n in group if n in able - tried]:
        # Begin with parameters that a model may be without, such as an inertia of the rotor.
        name = min(names, key=lambda n: not table[n].vanishes)
        tried.add(name)
        held = estimate.problem.table.with_fixed({name: table[name].nominal})
        end = estimate.x[[c.name != name for c in estimate.problem.table.columns]]
        again = fitted_to(*data, inputs.windows, config, held, end=end)
        if not again.converged or again.loss > (1.0 + _AS_GOOD) * estimate.loss:
            continue
        estimate = again
        at = again.problem.linearise(again.x)
        groups = what_is_determined(again.problem, at, [n for n in absent if n != name]).undetermined
        value = f"{table[name].nominal:.4g} {table[name].unit}".rstrip()
        sentences.append(
            f"{name} is held at its nominal value, {value}: the data does not determine it, and the model explains the "
            "data as well; the other estimates are for this value"
        )
    return replace(fits, estimate=estimate), sentences


def fitted_to(
    model: IdentifiableModel,
    episodes: Sequence[Episode],
    fitted: int,
    windows: Sequence[Span],
    config: IdentifyConfig,
    table: ParameterTable,
    report: OnProgress | None = None,
    on_begin: Callable[[Problem], None] | None = None,
    as_start: bool = False,
    end: np.ndarray | None = None,
) -> Fit:
    """Return the fit of a model to logs.

    Args:
        windows: Segments to fit, and segments to predict.
        as_start: Whether it only has to be a start for fits with some of the optional terms.
        end: Where a fit of nearly this model ended, as in ``fit``.
    """
    longer, length_s = long_spans(episodes, fitted, config), config.settle_s + config.horizon_s
    return fit(model, list(episodes), windows, length_s, config, table, longer, report, on_begin, as_start, end)


def chosen(
    estimate: Fit,
    config: IdentifyConfig,
    names: Sequence[str],
    refits: Refits | None = None,
    on_set: Callable[[str], None] = lambda names: None,
) -> Selection:
    """Return the optional terms without which held-out parts are predicted worse.

    Args:
        estimate: The fit with all optional terms.
        names: A name for each recording; recordings of different names are different parts.
        refits: Finished refits, which are not computed again.
        on_set: Called with the names of each set of terms before it is fitted.
    """
    parts = parts_of(estimate, config, names, _LEAST_TO_CHOOSE)
    trials = TermSearch(estimate, parts, config.settle_s, config.free_run_s, refits, on_set)
    if trials.segments < (count := len(estimate.problem.train)):
        note(f"sets of terms are compared on {trials.segments} of {count} segments, those with most motion")
    return trials.select()


def without_parts(inputs: Inputs, fits: Fits) -> tuple[HeldOutPart, ...]:
    """Return the estimates without each part of the recordings, and their errors on that part.

    There are none without a converged fit, whose errors would bound no later error.
    """
    config, estimate = inputs.config, fits.widest
    if not (config.folds and fits.estimate.converged):
        return ()
    if (segments := len(estimate.problem.train)) < LEAST_SEGMENTS:
        note(f"{segments} segments are too few to hold parts out of the fit")
        return ()
    if fits.selection is not None:  # the trials have these errors
        return tuple(fits.selection.chosen.rows)
    parts = parts_of(estimate, config, inputs.names)
    return tuple(leave_out(estimate, parts, config.settle_s, config.free_run_s, inputs.refits))


def parts_of(estimate: Fit, config: IdentifyConfig, names: Sequence[str], least: int = 2) -> list[Fold]:
    """Return the parts to hold out: recordings of different names, or blocks if there are fewer than ``least``."""
    return folds_of(estimate.problem, max(2, min(config.folds, len(estimate.problem.train) // 2)), names, least)


def widened(spread: Uncertainty, table: ParameterTable, at: Linearised, rows: Sequence[HeldOutPart]) -> Uncertainty:
    """Return an uncertainty that includes the spread of the estimates without one part."""
    if len(rows) < _LEAST_PARTS:
        return spread
    values = [[row.values[c.name] for c in table.columns] for row in rows]
    moved = np.array([[c.to_scale(v) for c, v in zip(table.columns, estimates, strict=True)] for estimates in values])
    share = np.array([[row.share.get(name, 0.0) for name in table.names] for row in rows])
    if len(rows) > MOST:  # parts that were held out together have one estimate
        moved, of = np.unique(moved, axis=0, return_inverse=True)
        share = np.array([share[np.ravel(of) == g].sum(axis=0) for g in range(len(moved))])
    return between_parts(spread, table, at, moved, share)


@contextmanager
def _progress(title: str, best: Best) -> Iterator[OnProgress]:
    """Show a bar for search and refinement, and keep the best values."""
    with progress(100, title) as bar:

        def advance(stage: str, share: float, loss: float, z: np.ndarray) -> None:
            if stage in best.done:
                best.advance(stage, share, loss, z)
            bar.set_description_str(f"{title}: {stage}")
            percent = _PERCENT_OF_SEARCH * best.done["search"] + _PERCENT_OF_REFINEMENT * best.done["refine"]
            bar.update(round(percent) - bar.n)
            bar.set_postfix_str(f"loss {loss:.4f}" if np.isfinite(loss) else "")

        yield advance
        bar.update(100 - bar.n)
