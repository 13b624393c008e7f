"""What free runs show, and when a term is tried and asked for."""

from types import SimpleNamespace

import numpy as np
import pytest

from sim2real.artifacts.identification import FreeRun
from sim2real.identify.validation.verdict import Position
from sim2real.stages.estimation.free_run import lacking

AXIS, ARM = Position("x[0]", "axis", "m", 1e-5), Position("x[1]", "arm", "rad", 1e-3)


def run(field, rmse, recording=0, model="identified", held_out=True):
    return FreeRun(model, recording, 18.0, 6.0, held_out, field, rmse, rmse)


def document(*runs, terms=None):
    """Positions that move by 0.2 m and 2 rad."""
    read = np.linspace(0.0, 1.0, 50)
    return SimpleNamespace(
        free_run=runs, samples={"x[0]_measured": 0.2 * read, "x[1]_measured": 2.0 * read}, terms=terms
    )


def fails():
    raise AssertionError("nothing is fitted again where free runs are near")


@pytest.mark.parametrize(
    ("runs", "again", "said", "flags"),
    [
        ([], fails, (), ""),
        ([run("x[0]", 0.002), run("x[1]", 0.01)], fails, ("axis is off by 0.002 m, 1.0% of its range",), ""),
        ([run("x[0]", 0.002), run("x[1]", 0.19)], fails, ("arm is off by 0.19 rad, 9.5% of its range",), ""),
        ([run("x[0]", 0.05)], None, ("axis is off by 0.05 m, 25.0% of its range",), ""),  # offers no term
        ([run("x[0]", 0.05)], 0.004, ("25.0% of its range", "it would be off by 0.004 m"), "--terms direction"),
        ([run("x[0]", 0.04), run("x[0]", 0.06, 1)], 0.004, ("off by 0.05 m", "0.004 m"), "--terms direction"),
        ([run("x[0]", 0.05)], 0.04, ("25.0% of its range", "direction does not mend that"), ""),
        ([run("x[0]", None)], 0.004, ("axis diverges", "0.004 m"), "--terms direction"),
        ([run("x[0]", 0.05)], float("nan"), ("25.0% of its range", "direction does not mend that"), ""),
        ([run("x[0]", 0.002), run("x[0]", 0.09, model="nominal"), run("x[0]", 0.09, held_out=False)], fails,
         ("off by 0.002 m",), ""),
    ],
)  # fmt: skip
def test_the_worst_free_run_is_named_and_mended_where_a_term_does(runs, again, said, flags):
    attempt = (lambda: [run("x[0]", again), run("x[0]", 0.2, model="hold")]) if isinstance(again, float) else again
    found = lacking(document(*runs), [AXIS, ARM], attempt)
    assert found.flags == flags
    assert len(found.reasons) == len(said)
    assert all(part in reason for part, reason in zip(said, found.reasons, strict=True))


def test_terms_that_were_identified_stay():
    found = lacking(
        document(run("x[0]", 0.05), terms=("load",)),
        [AXIS],
        lambda: [run("x[0]", 0.001), run("x[0]", 0.2, model="hold")],
    )
    assert found.flags == "--terms load,direction"
