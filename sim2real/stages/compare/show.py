"""What a comparison prints."""

from __future__ import annotations

import json

from sim2real.artifacts.comparison import LEVEL, Comparison
from sim2real.stages.terminal.console import note, table


def show(comparison: Comparison, as_json: bool) -> None:
    """Print the tables of figures and parameters, or both as JSON."""
    (figure_headers, figures), (headers, parameters) = comparison.figures(), comparison.rows()
    if as_json:
        rows = [dict(zip(figure_headers, row, strict=True)) for row in figures]
        print(json.dumps({"figures": rows, "parameters": [dict(zip(headers, r, strict=True)) for r in parameters]}))
        return
    print(table(figures, figure_headers))
    if parameters:
        print(table(parameters, headers))
        different = ", ".join(comparison.different) or "no parameter"
        note(
            f"different beyond chance: {different} (Cochran's Q and Holm's procedure, {LEVEL:.0%} over all parameters)"
        )
