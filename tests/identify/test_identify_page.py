"""The page in the docstring of sim2real.identify runs as it is written, here with a tiny budget."""

import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]
TINY = "FitConfig(population=8, generations=2, refine=1, refine_steps=3)"
STATUSES = ("accepted", "not converged", "no improvement on held-out data", "not identifiable", "hit a bound")


def code_of(docstring):
    """Return the indented block after ``::``."""
    _, _, rest = docstring.partition("::\n")
    lines = rest.split("\n")
    end = next(i for i, line in enumerate(lines) if line and not line.startswith("    "))
    return textwrap.dedent("\n".join(lines[:end]))


@pytest.mark.night
def test_ten_calls_lead_from_a_log_to_a_verdict(monkeypatch, capsys):
    code = code_of(sys.modules["sim2real.identify"].__doc__)
    assert [f"# {i}" in code for i in range(1, 11)] == [True] * 10
    assert code.count("FitConfig()") == 1
    monkeypatch.chdir(ROOT)
    names = {}
    exec(compile(code.replace("FitConfig()", TINY), "page", "exec"), names)
    judgement, table = names["judgement"], names["estimate"].problem.table
    assert judgement.status in STATUSES
    assert capsys.readouterr().out.splitlines() == [judgement.status, *judgement.reasons]
    assert np.all((names["spread"].low <= names["spread"].high) & np.isfinite(names["at"].x))
    assert set(names["determined"].standard_error_per_minute) == set(table.names)
    (score,) = names["scores"]
    assert score.column == "th"
    assert score.rmse["identified"] > 0.0
    assert {"nominal", "hold"} <= set(score.rmse)
