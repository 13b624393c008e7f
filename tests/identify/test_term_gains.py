"""What terms gain, from the errors of sets that were fitted."""

from types import SimpleNamespace

import numpy as np
import pytest

from sim2real.artifacts.identification import Identification, Judgement, Noise, TriedTerm, tried_table
from sim2real.identify.parameters import Parameter, ParameterTable
from sim2real.identify.validation.optional_terms import Trial
from sim2real.identify.validation.term_gains import gains
from sim2real.identify.validation.verdict import Position
from sim2real.stages.identify import missing_terms
from sim2real.stages.identify.missing_terms import Misfit, misfit
from sim2real.view.identification.tried import tried_blocks

TABLE = ParameterTable(
    [
        Parameter("a", "1", 0.0, -1.0, 1.0, "linear"),
        *(Parameter(n, "1", 0.0, -1.0, 1.0, "linear", term=n) for n in ("load", "drag", "play")),
        Parameter("torque", "N m", 5.0, 1.0, 10.0, term="torque_limit", off=1e6, limits=True),
    ]
)
ARM = Position("q", "elbow", "rad", 1e-3)


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
    found = Misfit(ARM, 4.2, 1e-3, rows, ("drag",), 12.0)
    (reason,) = found.reasons(automatic=False)
    assert "residuals of elbow are 4.2 times its noise of 0.001 rad" in reason
    assert "in 12 s" in reason
    assert "torque_limit 8 to 4" in reason
    assert "--terms drag,torque_limit" in reason
    assert "--terms" not in found.reasons(automatic=True)[0]


@pytest.mark.parametrize(
    ("error", "automatic", "how", "flags"),
    [
        (0.4, False, "the term load mends most of it: --terms drag,load", "--terms drag,load"),
        (5.0, False, "the term load lowers that error by 38%: --terms drag,load", ""),
        (0.4, True, "load 8 to 0.4", ""),
    ],
)
def test_a_model_lacks_the_term_that_halves_its_errors_beside_small_free_runs(
    error, automatic, how, flags, monkeypatch
):
    """Of 120 logs the residuals were 75 times the noise, and no command offered the term that lowers them by 97 %."""
    tried = (TriedTerm("load", 8.0, error, "mends"),)
    found = Misfit(ARM, 75.0, 1e-3, tried, ("drag",))
    monkeypatch.setattr(missing_terms, "misfit", lambda *_: found)
    monkeypatch.setattr(missing_terms, "with_trials", lambda *_: found)
    monkeypatch.setattr(missing_terms, "noises", lambda *_: ())
    monkeypatch.setattr(missing_terms, "positions", lambda *_: [ARM])
    monkeypatch.setattr(missing_terms, "in_world", lambda *_: None)
    monkeypatch.setattr(missing_terms, "with_one_more", lambda *_: None)
    document = Identification("rig", (), Judgement("", ()), (), tried=tried)
    config = SimpleNamespace(terms="auto" if automatic else "own", folds=5, world="")
    fit = SimpleNamespace(converged=True, problem=SimpleNamespace(train=np.arange(9)))
    inputs = SimpleNamespace(
        config=config,
        model=None,
        units={},
        robot=SimpleNamespace(units={}),
        pipeline=SimpleNamespace(load=lambda: None),
    )
    _, result = missing_terms.lack(document, inputs, fit)
    assert result.flags == flags
    assert how in result.reasons[0]


def test_nothing_is_said_up_to_three_times_the_noise():
    assert Misfit(ARM, 3.0, 1e-3).reasons(automatic=False) == ()
    assert "no optional term was tried" in Misfit(ARM, 3.1, 1e-3).reasons(automatic=False)[0]


def test_residuals_are_compared_with_the_noise_of_the_worst_position():
    rng, count = np.random.default_rng(0), 400
    slow = 0.02 * np.sin(np.linspace(0.0, 12.0, count))
    noise = 1e-3 * rng.normal(size=(2, count))
    samples = {"into": np.tile(np.linspace(0.0, 1.3, 40), 10)}
    for name, error in (("q", noise[0] + slow), ("r", noise[1])):
        samples |= {f"{name}_measured": error, f"{name}_identified": np.zeros(count)}
    document = SimpleNamespace(samples=samples, settle_s=0.3)
    noises = (Noise("q", "rad", 1e-3, 0.0, 0.0), Noise("r", "rad", 1e-3, 0.0, 0.0))
    found = misfit(document, noises, [Position("r", "wrist", "rad", 1e-3), ARM])
    assert found.position is ARM
    assert found.ratio == pytest.approx(0.02 / np.sqrt(2.0) / 1e-3, rel=0.1)
    alone = misfit(document, noises, [Position("r", "wrist", "rad", 1e-3)])
    assert not alone.far
    assert alone.ratio == pytest.approx(1.0, abs=0.1)
    # A noise of zero, as in a simulation, counts as a tenth of the assumed deviation.
    silent = misfit(document, (Noise("r", "rad", 0.0, 0.0, 0.0),), [Position("r", "wrist", "rad", 1e-3)])
    assert silent.noise == pytest.approx(1e-4)


def test_the_page_has_a_table_of_the_tried_terms():
    rows = (TriedTerm("load", 8.0, 4.0, "chosen"), TriedTerm("torque_limit", 4.0, 4.0, "not reached"))
    (block,) = tried_blocks(SimpleNamespace(tried=rows))
    assert [row[0] for row in block.rows] == ["load", "torque_limit"]
    assert tried_blocks(SimpleNamespace(tried=())) == []
