"""The JSON document with all results, for programs; docs/guides/export.md describes it."""

from collections.abc import Sequence
from typing import Any

from sim2real.artifacts.identification import Identification
from sim2real.identification.export.terms import Delays, Terms

FORMAT = 1
_COLUMNS = (
    *("name", "unit", "kind", "about", "estimate", "standard_error"),
    *("low95", "high95", "lower", "upper", "verdict"),
)


def json_document(
    identification: Identification, terms: Terms | None, delays: Delays, about: Sequence[tuple[str, str]]
) -> dict[str, Any]:
    """Return the document.

    Args:
        terms: The robot in MuJoCo's terms; None where no MuJoCo model has it.
    """
    mujoco = ("timestep_s", "joints", "bodies", "unexpressed")
    return {
        "format": FORMAT,
        "about": dict(about),
        "verdict": {"status": identification.verdict.status, "reasons": identification.verdict.reasons},
        "parameters": [{n: getattr(p, n) for n in _COLUMNS} for p in identification.parameters],
        "posterior": identification.posterior,
        "delays_s": delays,
        "links": identification.links,
        "mujoco": {n: getattr(terms, n) for n in mujoco} if terms else None,
    }
