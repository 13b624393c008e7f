"""Estimates in readable units."""

from __future__ import annotations

from dataclasses import replace

from sim2real.artifacts.identification import Estimate

_NUMBERS = ("estimate", "nominal", "standard_error", "low95", "high95", "lower", "upper", "truth")


def in_readable_unit(e: Estimate) -> Estimate:
    """Return an estimate in ms if it is a time below a second; others unchanged."""
    largest = max(abs(v) for v in (e.estimate, e.upper, e.truth) if v is not None)
    if e.unit != "s" or largest >= 1.0:
        return e
    scaled = {n: getattr(e, n) for n in _NUMBERS}
    return replace(e, unit="ms", **{n: None if v is None else 1e3 * v for n, v in scaled.items()})
