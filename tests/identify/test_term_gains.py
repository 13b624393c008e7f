"""What terms gain, from the errors of sets that were fitted."""

from types import SimpleNamespace

import numpy as np
import pytest

from sim2real.artifacts.identification import TriedTerm, tried_table
from sim2real.identify.parameters import Parameter, ParameterTable
from sim2real.identify.validation.optional_terms import Trial
from sim2real.identify.validation.term_gains import gains
from sim2real.view.identification import alternative_blocks

TABLE = ParameterTable(
    [
        Parameter("a", "1", 0.0, -1.0, 1.0, "linear"),
        *(Parameter(n, "1", 0.0, -1.0, 1.0, "linear", term=n) for n in ("load", "drag", "play")),
        Parameter("torque", "N m", 5.0, 1.0, 10.0, term="torque_limit", off=1e6, limits=True),
    ]
)


def trial(error, loss, *names):
    present = np.array([n in names for n in TABLE.terms])
    return Trial(present, np.zeros(5), loss, None, (), np.full(4, error**2), np.zeros(4))


def test_each_term_has_the_gain_of_the_nearest_pair_of_sets():
    none, load = trial(8.0, 60.0), trial(4.0, 16.0, "load")
    sets = [none, load, trial(7.9, 59.0, "drag"), trial(3.9, 15.5, "load", "drag"),
            trial(4.0, 15.99, "load", "torque_limit")]  # fmt: skip
    rows = {r.term: r for r in gains(sets, load, TABLE)}
    assert rows["load"] == TriedTerm("load", 8.0, 4.0, "chosen")
    assert rows["drag"] == TriedTerm("drag", 4.0, 3.9, "no gain")
    assert rows["play"] == TriedTerm("play", 4.0, None, "not fitted")
    assert rows["torque_limit"].outcome == "not reached"
    assert str(rows["torque_limit"]) == "torque_limit not reached"
    assert rows["load"].gain == pytest.approx(0.5)
    assert next(iter(rows)) == "load"
    table = str(tried_table(list(rows.values())))
    assert "50%" in table
    assert "not reached" in table


def test_a_term_that_was_not_chosen_but_helps_mends():
    none = trial(8.0, 60.0)
    rows = gains([none, trial(4.0, 16.0, "torque_limit"), trial(5.0, 20.0, "load")], none, TABLE)
    assert [(r.term, r.outcome) for r in rows[:2]] == [("torque_limit", "mends"), ("load", "mends")]


def test_the_page_has_a_table_of_the_tried_terms():
    rows = (TriedTerm("load", 8.0, 4.0, "chosen"), TriedTerm("torque_limit", 4.0, 4.0, "not reached"))
    (block,) = alternative_blocks(SimpleNamespace(tried=rows, posterior=None))
    assert [row[0] for row in block.rows] == ["load", "torque_limit"]
    assert alternative_blocks(SimpleNamespace(tried=(), posterior=None)) == []
