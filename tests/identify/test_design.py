"""The choice of motions: what is uncertain decides, and the choice is as good as any."""

from dataclasses import replace
from itertools import combinations
from types import SimpleNamespace

import numpy as np
import pytest

from sim2real.artifacts.identification import Identification, Judgement
from sim2real.artifacts.posterior import Posterior
from sim2real.identify.design import Knowledge, Scatter, choose, informations
from sim2real.identify.parameters import Parameter, ParameterTable
from sim2real.identify.uncertainty import Linearised

TABLE = ParameterTable(
    [
        Parameter("gain", "1", 1.0, 0.1, 10.0),
        Parameter("sensor_delay", "s", 0.0, 0.0, 0.06, "linear", "delay", side="measurement"),
        Parameter("actuator_delay", "s", 0.0, 0.0, 0.06, "linear", "delay", side="command"),
    ]
)


def some_informations(count, seed=0):
    rows = np.random.default_rng(seed).normal(size=(count, 2, 3))
    return np.einsum("mnp,mnq->mpq", rows, rows)


def volume(known, each, chosen):
    return np.linalg.slogdet(known + each[list(chosen)].sum(axis=0))[1]


@pytest.mark.parametrize("seed", range(4))
def test_what_is_chosen_is_as_good_as_the_best_of_all_choices(seed):
    known, each = 0.1 * np.eye(3), some_informations(9, seed)
    chosen = choose(known, each, np.ones(9), 3)
    assert len(set(chosen)) == 3
    best = max(volume(known, each, c) for c in combinations(range(9), 3))
    assert volume(known, each, chosen) == pytest.approx(best, abs=0.02)


def test_the_most_telling_comes_first():
    known, each = np.eye(3), some_informations(12)
    chosen = choose(known, each, np.ones(12), 5)
    gains = [volume(known, each, chosen[: k + 1]) - volume(known, each, chosen[:k]) for k in range(5)]
    assert gains == sorted(gains, reverse=True)


@pytest.mark.parametrize("unknown", range(3))
def test_what_alone_is_unknown_decides(unknown):
    known, each = np.full(3, 1e6), some_informations(12)
    known[unknown] = 1e-3
    (chosen,) = choose(np.diag(known), each, np.ones(12), 1)
    assert chosen == np.argmax(each[:, unknown, unknown])


def test_without_an_identification_the_bounds_are_what_is_known_and_one_delay_is_held():
    known = Knowledge.of(TABLE, None)
    assert [TABLE.names[i] for i in known.rest] == ["gain", "actuator_delay"]
    np.testing.assert_allclose(known.deviations(), TABLE.span[known.rest] / np.sqrt(12.0))


def test_the_shift_between_delays_that_no_log_tells_is_not_designed_for():
    """A posterior holds it as unknown; what is known of the delays is their sum."""
    shift = np.array([0.0, 1.0, -1.0])
    covariance = np.diag([1e-4, 1e-12, 1e-8]) + np.outer(shift, shift) * 0.01**2
    posterior = Posterior(
        TABLE.names, ("log", "linear", "linear"), np.array([0.0, 0.02, 0.02]), covariance, TABLE.low, TABLE.high
    )
    np.testing.assert_allclose(Knowledge.of(TABLE, posterior).deviations(), [1e-2, 1e-4], rtol=1e-2)


def test_information_is_that_of_each_segment():
    J = np.random.default_rng(0).normal(size=(2, 5, 1, 3))
    at = Linearised(np.zeros((2, 5, 1)), J, np.eye(3), np.zeros(3), np.zeros((2, 5, 1)))
    known = Knowledge.of(TABLE, None)
    found = informations(SimpleNamespace(train=np.arange(2)), at, known)  # pyright: ignore[reportArgumentType]
    for s in range(2):
        own = J[s, :, 0][:, [0, 2]]
        np.testing.assert_allclose(found[s], own.T @ own)


def test_a_quick_motion_that_is_seen_badly_is_left_out():
    each = np.stack([np.eye(3), 2.0 * np.eye(3), np.eye(3)])
    assert set(choose(np.eye(3), each, np.ones(3), 2)) != {0, 2}
    assert set(choose(np.eye(3), each, np.array([1.0, 20.0, 1.0]), 2)) == {0, 2}


def identified(jitter_s, white, rng):
    """What an identification keeps of two segments of a pendulum that swings, read at times that are off."""
    t = np.tile(np.arange(0.0, 4.0, 0.02), 2)
    at = t + jitter_s * rng.standard_normal(t.size)
    samples = {"t": t, "segment": np.repeat([0, 1], t.size // 2), "th_identified": np.sin(6 * t)}
    samples["th_measured"] = np.sin(6 * at) + 0.002 * white * rng.standard_normal(t.size)
    found = Identification("pendulum", (), Judgement("accepted", ()), (), sigma={"th": 0.002}, samples=samples)
    return replace(found, residual_inflation=1.5)


@pytest.mark.parametrize(("jitter_s", "white"), [(0.003, 2.0), (0.0, 3.0), (0.004, 0.0)])
def test_what_is_unexplained_is_told_apart_into_noise_and_jitter(jitter_s, white):
    found = Scatter.of(identified(jitter_s, white, np.random.default_rng(0)))
    assert found.white / 1.5 == pytest.approx(max(white, 1.0) ** 2, rel=0.5)
    assert np.sqrt(found.jitter_s2 / 1.5) == pytest.approx(jitter_s, rel=0.15, abs=3e-4)


def test_without_predictions_all_that_is_unexplained_is_noise():
    bare = Identification("pendulum", (), Judgement("accepted", ()), (), misfit=2.0, residual_inflation=1.5)
    assert Scatter.of(bare) == Scatter(6.0)
