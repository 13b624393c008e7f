"""The fits of an identification: with selected optional terms, and without parts of the logs."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np

from sim2real.artifacts.identification import Term
from sim2real.identification.fit import Fit, OnProgress, as_numbers, fit
from sim2real.identification.held_out import MOST, Fold, HeldOutPart, folds_of, leave_out
from sim2real.identification.parameters import ParameterTable
from sim2real.identification.residuals import Linearised, Problem
from sim2real.identification.segments import Span
from sim2real.identification.terms import Selection, TermSearch, gains
from sim2real.identification.uncertainty import ABSENT, NOT_REACHED, Determined, Uncertainty, above_noise, between_parts
from sim2real.identification.uncertainty import determined as what_is_determined
from sim2real.stages.identify.config import IdentifyConfig
from sim2real.stages.identify.inputs import Inputs, with_terms
from sim2real.stages.identify.progress import Best
from sim2real.stages.shared.identification import long_spans
from sim2real.stages.terminal.console import note, progress
from sim2real.stages.terminal.interruption import patiently

_PERCENT_OF_SEARCH, _PERCENT_OF_REFINEMENT = 70, 30
"""Shares of a progress bar."""
_AS_GOOD = 1e-3
"""A fit with a fixed parameter is as good if its loss is larger by at most this share."""
_LEAST_SEGMENTS = 4
"""Fewest segments with which parts are held out."""
_LEAST_TO_CHOOSE = 3
"""Fewest parts with which terms are selected."""
_FAR = 2.0
"""A term may be missing if the residuals are above this many times the noise."""


@dataclass(frozen=True)
class Fits:
    """The fit of an identification.

    Attributes:
        inputs: The data, and the model with the terms of the estimate.
        parts: Errors on each held-out part, if the selection of terms computed them.
        tried: The optional terms that were tried in addition to the model's, with their gains.
        added: The optional term that was added because it halves the errors; "": none.
    """

    inputs: Inputs
    estimate: Fit
    parts: tuple[HeldOutPart, ...] | None = None
    tried: tuple[Term, ...] = ()
    added: str = ""

    @property
    def terms(self) -> tuple[Term, ...] | None:
        """The optional terms of the estimate, and those that were tried; None if there are none."""
        tried, used = {t.name: t for t in self.tried}, self.estimate.problem.table.terms
        rows = [replace(tried[n], used=True) if n in tried else Term(n, True) for n in used]
        rows += [replace(t, used=False) for n, t in tried.items() if n not in used]
        return tuple(rows) if rows or self.inputs.config.terms == "auto" else None


def fit_model(inputs: Inputs, best: Best) -> Fits:
    """Fit the model, and select its optional terms.

    With ``auto``, terms are selected among all, beginning with none. Otherwise, if residuals are far above the noise,
    further terms are tried, and with ``own`` a term that halves the errors is added.

    Args:
        best: Updated with the best values so far.
    """
    config, auto = inputs.config, inputs.config.terms == "auto"
    base = with_terms(inputs, "none") if auto else inputs
    # Compare terms on windows, which takes less time; long segments follow.
    longer = bool(_long_spans(inputs))
    windows = replace(base, config=replace(config, long_s=0.0)) if longer else base
    whole = _fitted(windows, best, "identify")
    own, values, tried, added = whole.problem.table.terms, whole.values, (), ""
    parts: tuple[HeldOutPart, ...] | None = None
    with progress(None, "identify: sets of terms") as bar:
        found = patiently(lambda: _compared(inputs, whole, bar.set_postfix_str))
    if found is not None:
        table, selection = found
        terms = selection.chosen.names(table) if config.terms in ("auto", "own") else own
        added = ", ".join(n for n in terms if n not in own) if not auto else ""
        beside = selection if auto or added else replace(selection, chosen=selection.trials[0])
        tried = tuple(row for row in gains(beside, table) if row.name not in own)
        if auto or added:
            base, values = with_terms(inputs, ",".join(terms) or "none"), as_numbers(table, selection.chosen.x)
        parts = tuple(selection.chosen.rows) if auto else None
    if base is inputs and not longer:
        return Fits(inputs, whole, tried=tried)
    # Refine the model with the selected terms; parameters of all other terms have their values without effect.
    title = f"identify with {', '.join(base.table.terms) or 'no term'}" if tried else "identify"
    estimate = _fitted(base, best, title, end=base.table.encode(values))
    return Fits(base, estimate, parts, tried, added)


def _fitted(inputs: Inputs, best: Best, title: str, end: np.ndarray | None = None) -> Fit:
    """Return a fit that shows its progress."""
    best.restart(inputs.table)
    windows = windows_of(inputs)
    note(f"engine: {windows.engine}")
    with _progress(title, best) as report:
        found = patiently(lambda: fit(windows, _long_spans(inputs), report, end))
    few, every = len(found.problem.train), len(windows.train)
    if few < every and found.problem.segment_s == windows.segment_s:
        note(f"the fit takes {few} of {every} segments, those with most motion of each log; all are predicted")
    return found


def windows_of(inputs: Inputs) -> Problem:
    """Return the segments of an identification."""
    length_s = inputs.config.settle_s + inputs.config.horizon_s
    return Problem(inputs.model, inputs.episodes, inputs.windows, length_s, inputs.config, inputs.table)


def _long_spans(inputs: Inputs) -> list[Span]:
    return long_spans(inputs.episodes, inputs.fitted, inputs.config)


def _compared(inputs: Inputs, own: Fit, on_set: Callable[[str], None]) -> tuple[ParameterTable, Selection] | None:
    """Return the table of all terms, and the compared sets of terms; None if there is no need, or no term."""
    terms, auto = own.problem.table.terms, inputs.config.terms == "auto"
    if not auto and (not has_parts(inputs, own) or above_noise(own.problem.linearise(own.x)) < _FAR):
        return None
    more = with_terms(inputs, ",".join(["auto", *terms]), "all")
    if not set(more.table.terms) - set(terms) or not set(own.values) <= {p.name for p in more.table}:
        return None
    problem = windows_of(more)
    return problem.table, compare_terms(own, problem, inputs.config, inputs.names, on_set)


def compare_terms(
    own: Fit,
    problem: Problem,
    config: IdentifyConfig,
    names: Sequence[str],
    on_set: Callable[[str], None] = lambda names: None,
) -> Selection:
    """Return the terms that improve the prediction of held-out parts, or one term to add to a fit.

    Args:
        problem: The same segments for the model with all optional terms.
        names: A name for each recording; recordings of different names are different parts.
        on_set: Called with the names of each set of terms before it is fitted.
    """
    table, auto = problem.table, config.terms == "auto"
    x = table.encode({p.name: p.without for p in table} | own.values)
    whole = replace(own, problem=problem, windows=problem, x=x)
    parts = parts_of(whole, config, names, _LEAST_TO_CHOOSE if auto else 2)
    search = TermSearch(whole, parts, config.settle_s, config.free_run_s, on_set)
    if search.segments < (count := len(problem.train)):
        note(f"sets of terms are compared on {search.segments} of {count} segments, those with most motion")
    present = np.array([name in own.problem.table.terms for name in table.terms], bool)
    return search.select() if auto else search.further(x, present)


def has_parts(inputs: Inputs, fitted: Fit) -> bool:
    """Return whether parts of the recordings are held out, so that terms can be compared."""
    return bool(fitted.converged and inputs.config.folds and len(fitted.problem.train) >= _LEAST_SEGMENTS)


def determined(fits: Fits, check: Determined, spread: Uncertainty) -> tuple[Fits, list[str]]:
    """Fix parameters that the data does not determine at their nominal values, as long as the fit stays as good.

    Returns:
        The fits, and a sentence for each fixed parameter.
    """
    inputs, estimate, groups, sentences = fits.inputs, fits.estimate, check.undetermined, list[str]()
    table, tried = estimate.problem.table, set[str]()
    absent = [n for n, state in zip(table.names, spread.state, strict=True) if state in (ABSENT, NOT_REACHED)]
    able = {p.name for p in table if p.kind == "dynamics" and not p.term}
    while names := [n for group in groups for n in group if n in able - tried]:
        # Begin with parameters that a model may lack, such as an inertia of the rotor.
        name = min(names, key=lambda n: not table[n].vanishes)
        tried.add(name)
        held = estimate.problem.table.with_fixed({name: table[name].nominal})
        end = estimate.x[[c.name != name for c in estimate.problem.table.columns]]
        own = replace(inputs, table=held)
        again = fit(windows_of(own), _long_spans(own), end=end)
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


def without_parts(fits: Fits) -> tuple[HeldOutPart, ...]:
    """Return the estimates without each part of the recordings, and their errors on that part.

    Without a converged fit there are none: its errors would tell nothing about later ones.
    """
    inputs, estimate = fits.inputs, fits.estimate
    config = inputs.config
    if not (config.folds and estimate.converged):
        return ()
    if not has_parts(inputs, estimate):
        note(f"{len(estimate.problem.train)} segments are too few to hold parts out of the fit")
        return ()
    if fits.parts is not None:
        return fits.parts
    parts = parts_of(estimate, config, inputs.names)
    return tuple(leave_out(estimate, parts, config.settle_s, config.free_run_s))


def parts_of(estimate: Fit, config: IdentifyConfig, names: Sequence[str], least: int = 2) -> list[Fold]:
    """Return the parts to hold out: recordings of different names, or blocks if there are fewer than ``least``."""
    return folds_of(estimate.problem, max(2, min(config.folds, len(estimate.problem.train) // 2)), names, least)


def widened(spread: Uncertainty, table: ParameterTable, at: Linearised, rows: Sequence[HeldOutPart]) -> Uncertainty:
    """Return an uncertainty that includes the spread of the estimates without one part."""
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
