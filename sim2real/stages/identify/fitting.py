"""The fit of an identification: all optional terms, then the selected ones."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np

from sim2real.identify.fit import Fit, OnProgress, as_numbers
from sim2real.identify.problem.problem import Problem
from sim2real.identify.uncertainty.identifiability import from_linearised
from sim2real.identify.uncertainty.negligible import ABSENT
from sim2real.identify.uncertainty.uncertainty import linearise
from sim2real.identify.validation.optional_terms import Selection
from sim2real.stages.estimation import held_out_parts
from sim2real.stages.estimation.estimate import Findings
from sim2real.stages.estimation.free_run import fitted_to
from sim2real.stages.identify.inputs import Inputs
from sim2real.stages.identify.interrupted import Best
from sim2real.stages.terminal.console import note, progress
from sim2real.stages.terminal.interruption import patiently

_PERCENT_OF_SEARCH, _PERCENT_OF_REFINEMENT = 70, 30
"""Shares of a progress bar."""
_AS_GOOD = 3e-4
"""Relative excess of the loss up to which a fit with a held parameter is as good."""


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
    best.restart(table.for_recordings(len(inputs.episodes)))
    with _progress("identify", best) as report:
        widest = patiently(lambda: fitted_to(*data, wide, table, report, on_begin, as_start=auto))
    if not auto:
        return Fits(widest, widest, None)
    # Select the terms without which held-out parts are predicted worse.
    with progress(None, "identify: sets of terms") as bar:
        on_set = bar.set_postfix_str
        selection = patiently(lambda: held_out_parts.chosen(widest, config, inputs.names, inputs.refits, on_set))
    terms: Sequence[str] = selection.names(widest.problem.table)
    # Refine the model with the selected terms. A value fixed by a flag stays fixed, in whichever term the parameter is;
    # the parameters of all other terms have their values without the term.
    narrow = table.with_terms(terms).with_fixed(config.fix)
    values = as_numbers(widest.problem.table, selection.near[0].z)
    narrow = narrow.with_begin(
        {p.name: float(np.squeeze(values[p.name])) for p in narrow if p.free and not p.per_recording}
    )
    best.restart(narrow.for_recordings(len(inputs.episodes)))
    with _progress(f"identify with {', '.join(terms) or 'no term'}", best) as report:
        estimate = patiently(lambda: fitted_to(*data, replace(config, generations=0), narrow, report, best.begin))
    return Fits(widest, estimate, selection)


def determined(inputs: Inputs, fits: Fits, findings: Findings) -> tuple[Fits, list[str]]:
    """Hold parameters that the data does not determine at their nominal values, as long as the fit stays as good.

    Returns:
        The fits, and a sentence for each held parameter.
    """
    estimate, groups, sentences = fits.estimate, findings.check.undetermined, list[str]()
    table, tried, data = estimate.problem.table, set[str](), (inputs.model, inputs.episodes, inputs.fitted)
    absent = [n for n, verdict in zip(table.names, findings.spread.verdict, strict=True) if verdict in ABSENT]
    config, able = inputs.config, {p.name for p in table if p.kind == "dynamics" and not (p.term or p.per_recording)}
    while names := [n for group in groups for n in group if n in able - tried]:
        # Begin with parameters that a model may be without, such as an inertia of the rotor.
        name = min(names, key=lambda n: not table[n].vanishes)
        tried.add(name)
        held = estimate.problem.table.with_fixed({name: table[name].nominal})
        end = estimate.z[[c.parameter.name != name for c in estimate.problem.table.columns]]
        again = fitted_to(*data, inputs.windows, config, held, end=end)
        if not again.converged or again.loss > (1.0 + _AS_GOOD) * estimate.loss:
            continue
        estimate = again
        at = linearise(again.problem, again.z)
        groups = from_linearised(again.problem, at, [n for n in absent if n != name]).undetermined
        value = f"{table[name].nominal:.4g} {table[name].unit}".rstrip()
        sentences.append(
            f"{name} is held at its nominal value, {value}: the data does not determine it, and the model explains the "
            "data as well; the other estimates are for this value"
        )
    return replace(fits, estimate=estimate), sentences


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
