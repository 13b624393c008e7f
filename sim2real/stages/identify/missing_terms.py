"""The optional term that a model may lack, if its residuals are far above the noise of the sensor."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sim2real.artifacts.identification import FreeRun, Identification, Noise, TriedTerm
from sim2real.identify.fit import Fit
from sim2real.identify.model import measured_channels
from sim2real.identify.parameters import ParameterTable
from sim2real.identify.problem.problem import Problem
from sim2real.identify.uncertainty.noise import noises
from sim2real.identify.validation.optional_terms import Selection
from sim2real.identify.validation.term_gains import gains
from sim2real.identify.validation.term_trials import Trials
from sim2real.identify.validation.verdict import Position, positions
from sim2real.robots.worlds import in_world
from sim2real.stages.estimation import held_out_parts
from sim2real.stages.estimation.free_run import MENDS, TERM, Lack, fitted_to, free_runs, lacking, with_one_more
from sim2real.stages.identify.inputs import Inputs, table_of

_FAR = 3.0
"""Ratio of residuals to noise above which a term is missing."""
_FLOOR = 0.1
"""Smallest noise, in assumed deviations of a measurement: simulated logs have none, and residuals of integrators."""


@dataclass(frozen=True)
class Misfit:
    """The position whose residuals are largest beside its noise, and the terms that were tried for it.

    Attributes:
        ratio: Root mean square of the residuals, in deviations of the noise.
        noise: Deviation of the noise [unit of the position].
        tried: What the optional terms gain; empty if none was tried.
        chosen: The terms of the model.
        seconds: Duration of the trials; 0 if an identification of the same inputs made them [s].
    """

    position: Position
    ratio: float
    noise: float
    tried: tuple[TriedTerm, ...] = ()
    chosen: tuple[str, ...] = ()
    seconds: float = 0.0

    @property
    def far(self) -> bool:
        """Whether the residuals show that a term is missing."""
        return self.ratio > _FAR

    @property
    def best(self) -> TriedTerm | None:
        """The term that lowers the error most, beyond those of the model; None if no term lowers it by 5 %."""
        return next((t for t in self.tried if t.outcome == "mends"), None)

    @property
    def flags(self) -> str:
        """Flags of an identification with the best term; "" without one."""
        return f"--terms {','.join([*self.chosen, self.best.term])}" if self.best else ""

    @property
    def lacks(self) -> bool:
        """Whether the model lacks the best term: with it the error on held-out parts is less than half."""
        return self.far and self.best is not None and (self.best.gain or 0.0) > MENDS

    def reasons(self, automatic: bool) -> tuple[str, ...]:
        """Return sentences: the ratio, and the trials; none if the residuals are near the noise.

        Args:
            automatic: Whether the terms of the model were chosen on held-out parts.
        """
        if not self.far:
            return ()
        p, unit = self.position, f" {self.position.unit}".rstrip()
        sentence = f"residuals of {p.name} are {self.ratio:.2g} times its noise of {self.noise:.2g}{unit}"
        if not self.tried:
            return (f"{sentence}: the model lacks something; no optional term was tried",)
        fitted = ", ".join(str(t) for t in self.tried if t.outcome != "not fitted")
        took = f" in {self.seconds:.0f} s" if self.seconds >= 0.5 else ""
        tried = f"tried{took}, with errors on held-out parts in deviations of a measurement: {fitted or 'no term'}"
        if automatic:
            return (f"{sentence}; {tried}",)
        if self.best is None:
            return (f"{sentence}; {tried}; none of them mends that",)
        how = "mends most of it" if self.lacks else f"lowers that error by {self.best.gain:.0%}"
        return (f"{sentence}; {tried}; the term {self.best.term} {how}: {self.flags}",)


def misfit(document: Identification, noises: Sequence[Noise], positions: Sequence[Position]) -> Misfit | None:
    """Return the position whose residuals are largest beside its noise; None without samples."""
    rows = []
    for p in positions:
        of = next((n for n in noises if n.column == p.column), None)
        if of is None:
            continue
        off = document.samples[f"{p.column}_measured"] - document.samples[f"{p.column}_identified"]
        off = off[np.isfinite(off) & (document.samples["into"] > document.settle_s)]
        noise = max(float(np.hypot(of.deviation, of.quantum / np.sqrt(12.0))), _FLOOR * p.sigma)
        if off.size:
            rows.append(Misfit(p, float(np.sqrt(np.mean(off**2))) / noise, noise))
    return max(rows, key=lambda row: row.ratio, default=None)


def with_trials(of: Misfit, inputs: Inputs, fit: Fit) -> Misfit:
    """Return the misfit with what optional terms gain, one at a time, beside the model of a fit."""
    chosen, began_s = fit.problem.table.terms, time.monotonic()
    rows = inputs.refits.tried(chosen, lambda: _tried(inputs, fit))
    return replace(of, tried=rows, chosen=chosen, seconds=time.monotonic() - began_s)


def _tried(inputs: Inputs, fit: Fit) -> tuple[TriedTerm, ...]:
    """Return what optional terms gain, one at a time, beside the model of a fit.

    The three most promising ones by linear algebra and the limits are fitted, without refits: about as long as the fit.
    """
    config, chosen = inputs.config, fit.problem.table.terms
    robot = held_out_parts.offering(in_world(inputs.pipeline.load(), config.world), ",".join(["auto", *chosen]))
    model, episodes = measured_channels(robot.identifiable(config.max_delay_s), inputs.episodes), inputs.episodes
    bounded = model.parameters.with_bounds(config.bounds).with_reached(model.reached(episodes[: inputs.fitted]))
    table = held_out_parts.widest(bounded, "all").with_fixed(config.fix)
    further = set(table.terms) - set(chosen)
    if not further or not set(fit.values) <= {p.name for p in table}:
        return ()
    # Put the estimate into the model with all terms, and compare single terms.
    length_s = config.settle_s + config.horizon_s
    problem = Problem(model, episodes, inputs.windows, length_s, config, table)
    values = {p.name: p.without for p in problem.table} | fit.values
    z = problem.table.encode(values)
    whole = replace(fit, problem=problem, windows=problem, z=z, refined=(), search=None)
    parts = held_out_parts.parts_of(whole, config, inputs.names)
    present = np.array([name in chosen for name in problem.table.terms])
    trials = Trials(whole, parts, config.settle_s, 0.0).singles(z, present)
    return tuple(r for r in gains(trials, trials[0], problem.table) if r.term in further)


def of_selection(selection: Selection, table: ParameterTable) -> tuple[TriedTerm, ...]:
    """Return what the terms gain among which a selection chose."""
    return gains(selection.trials, selection.near[0], table)


def lack(document: Identification, inputs: Inputs, fit: Fit) -> tuple[Identification, Lack]:
    """Return the document with the tried terms, and what the model lacks, after fits with further terms."""
    config, measured = inputs.config, positions(inputs.model, inputs.robot.units)
    automatic = config.terms == "auto"
    # Where residuals are far above the noise, try the robot's optional terms; those of ``auto`` were tried.
    worst, term = misfit(document, noises(document.samples, inputs.units), measured), TERM
    if worst and automatic:
        worst = replace(worst, tried=document.tried)
    elif worst and worst.far and fit.converged and config.folds and len(fit.problem.train) >= held_out_parts.LEAST:
        worst = with_trials(worst, inputs, fit)
        document, term = replace(document, tried=worst.tried), worst.best.term if worst.best else TERM
    more = worst.reasons(automatic) if worst else ()
    flags = worst.flags if worst and worst.lacks and not automatic else ""
    wider = with_one_more(in_world(inputs.pipeline.load(), config.world), document.terms, config, term)
    if not fit.converged or wider is None:
        lacks = lacking(document, measured, None)
        return document, Lack((*more, *lacks.reasons), flags)
    robot, more_terms = wider

    def attempt() -> list[FreeRun]:
        model, episodes = measured_channels(robot.identifiable(config.max_delay_s), inputs.episodes), inputs.episodes
        # Search from the start, as the printed command does: a fit without the term has distorted other parameters.
        table = table_of(model, more_terms, episodes[: inputs.fitted])
        refitted = fitted_to(model, episodes, inputs.fitted, inputs.windows, more_terms, table)
        return free_runs(refitted, episodes, inputs.fitted, more_terms, {"identified": refitted.values})[0]

    lacks = lacking(document, measured, attempt, term)
    return document, Lack((*more, *lacks.reasons), lacks.flags or flags)
