"""The timing question: rate, jitter and losses of the policy's steps, and the age of what they answer."""

from __future__ import annotations

import numpy as np

from sim2real.doctor.contract import Contract
from sim2real.doctor.log import Log
from sim2real.doctor.solve import Finding

_RATE_BAND, _JITTER, _LOST = 0.04, 0.25, 0.02


def solve_timing(log: Log, contract: Contract, sim: Log | None = None) -> tuple[list[Finding], dict[str, float]]:
    """Return what is wrong with the times of the policy's steps, and their figures [Hz, s].

    Args:
        sim: The log of a simulation, whose rate and ages count as those of the training.
    """
    steps = np.diff(log.t)
    period = float(np.median(steps))
    wanted = 1.0 / contract.rate_hz if sim is None else float(np.median(np.diff(sim.t)))
    age = log.age_s
    if age is None and not log.rows_are_steps:
        rows = np.searchsorted(log.state_t, log.t + 1e-6, side="right") - 1
        age = log.t - log.state_t[np.clip(rows, 0, len(log.state_t) - 1)]
    figures = {
        "rate_hz": 1.0 / period,
        "trained_rate_hz": 1.0 / wanted,
        "jitter_s": float(np.quantile(np.abs(steps - period), 0.9)),
        "lost": float(np.mean(steps > 1.6 * period)),
    }
    if age is not None and len(age):
        figures |= {"age_s": float(np.median(age)), "age_99_s": float(np.quantile(age, 0.99))}
    findings = []
    if abs(period / wanted - 1.0) > _RATE_BAND:
        text = f"the policy makes {1 / period:.4g} steps in a second, and was trained with {1 / wanted:.4g}"
        findings.append(
            Finding("rate", "timing", text, min(1.0, abs(wanted / period - 1.0)), {"rate_hz": 1.0 / period})
        )
    if figures["jitter_s"] > _JITTER * period:
        text = f"a tenth of the steps come {1e3 * figures['jitter_s']:.1f} ms or more beside their time"
        findings.append(Finding("jitter", "timing", text, 0.0, {"jitter_s": figures["jitter_s"]}))
    if figures["lost"] > _LOST:
        text = f"{figures['lost']:.1%} of the policy's steps are missing"
        findings.append(Finding("losses", "timing", text, figures["lost"], {"lost": figures["lost"]}))
    sim_age = None if sim is None or sim.age_s is None else float(np.median(sim.age_s))
    if "age_s" in figures and figures["age_s"] > (sim_age or 0.0) + 0.015:
        text = f"each action answers a measurement that is {1e3 * figures['age_s']:.0f} ms old"
        findings.append(Finding("delay", "timing", text, 0.0, {"age_s": figures["age_s"]}))
    return findings, figures
