"""The printed form of a comparison."""

import json

from sim2real.artifacts.comparison import LEVEL, Comparison
from sim2real.stages.terminal.console import artifact_table, note


def show(comparison: Comparison, as_json: bool) -> None:
    """Print the tables of figures and parameters, or both as JSON."""
    figures, parameters = comparison.figures(), comparison.rows()
    if as_json:
        print(json.dumps({"figures": figures.records(), "parameters": parameters.records()}))
        return
    print(artifact_table(figures))
    if parameters.rows:
        print(artifact_table(parameters))
        different = ", ".join(comparison.different) or "no parameter"
        note(
            f"different beyond chance: {different} (Cochran's Q and Holm's procedure, {LEVEL:.0%} over all parameters)"
        )
