"""The search: finds what there is to find with every strategy, and says when there is nothing."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sim2real.errors import Sim2RealError, UsageError
from sim2real.identify.config import FitConfig
from sim2real.identify.problem.engine import Choice, check_devices
from sim2real.identify.search.search import search, strategies

BOTTOM = np.array([1.0, -2.0])
INCOMPLETE = {"RandomSearch": "sampling_fn", "SV_CMA_ES": "num_populations", "SV_Open_ES": "num_populations"}
"""Strategies whose constructors want what a search does not know."""
STANDARD = [
    "CMA_ES", "Sep_CMA_ES", "SNES", "xNES", "PGPE", "Open_ES", "SimpleES", "DifferentialEvolution", "PSO", "SimpleGA",
    "MA_ES", "CR_FM_NES", "SimulatedAnnealing",
]  # fmt: skip
USUAL = ["CMA_ES", "SNES", "Open_ES", "DifferentialEvolution", "PSO", "SimulatedAnnealing"]
"""One of each kind: `make test` takes these."""
CONFIG = FitConfig(population=16, generations=2000, std=1.0, seed=1)


def bowl(candidates, around=None, data=None, pick=None):
    del around, data, pick
    return 1.0 + jnp.sum((candidates - BOTTOM) ** 2 * jnp.array([1.0, 30.0]), axis=1)


@pytest.fixture(autouse=True, scope="module")
def _quick():
    """Programs are compiled in a hurry: none runs for long."""
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", False)


def test_a_bowls_bottom_is_found_and_reported():
    told = []
    found = search(bowl, np.zeros(2), CONFIG, on_generations=lambda n, best, z: told.append((n, best)))
    np.testing.assert_allclose(found.z, BOTTOM, atol=0.02)
    assert found.loss == pytest.approx(1.0, abs=1e-3)
    assert found.loss == pytest.approx(float(bowl(found.z[None])[0]))
    assert len(found.record.history) < 500  # it ends once it is stuck
    assert np.all(np.diff(found.record.history) <= 0)
    assert found.record.evaluations == 16 * len(found.record.history)
    assert sum(n for n, _ in told) == len(found.record.history)
    assert told[-1][1] == pytest.approx(found.loss)
    np.testing.assert_array_equal(found.finalists, found.z[None])


def test_one_seed_one_result():
    config = replace(CONFIG, strategy="SNES", population=8, generations=3)
    first, again, other = (search(bowl, np.zeros(2), replace(config, seed=s)) for s in (5, 5, 6))
    np.testing.assert_array_equal(first.z, again.z)
    np.testing.assert_array_equal(first.record.history, again.record.history)
    assert not np.array_equal(first.z, other.z)


def test_candidates_that_cannot_be_simulated_lose():
    hole = lambda c, around, data, pick: jnp.where(c[:, 0] > 0.5, jnp.nan, bowl(c))  # noqa: E731
    found = search(hole, np.zeros(2), CONFIG)
    assert np.isfinite(found.loss)
    assert found.loss == pytest.approx(1.25, abs=0.05)


def test_when_nothing_can_be_simulated():
    bad = lambda c, around, data, pick: jnp.where(c[:, 0] > 0.0, jnp.nan, jnp.inf)  # noqa: E731
    with pytest.raises(Sim2RealError, match="no candidate could be simulated"):
        search(bad, np.zeros(2), replace(CONFIG, strategy="SNES", generations=10))


@pytest.mark.parametrize(
    "strategy",
    [s if s in (*USUAL, *INCOMPLETE, "LM_MA_ES") else pytest.param(s, marks=pytest.mark.night) for s in strategies()],
)
def test_every_strategy_runs_or_says_why_not(strategy):
    config = FitConfig(strategy=strategy, population=8, generations=10, std=0.7)
    if strategy in INCOMPLETE:
        with pytest.raises(UsageError, match=f"'{strategy}' needs {INCOMPLETE[strategy]}"):
            search(bowl, np.zeros(2), config)
    elif strategy == "LM_MA_ES":  # sound only for fewer than two candidates a parameter
        with pytest.raises(UsageError, match="'LM_MA_ES' breaks down: with a population of 8 for 2 parameters"):
            search(bowl, np.zeros(2), config)
    else:
        found = search(bowl, np.zeros(2), config)
        assert np.isfinite(found.z).all()
        assert found.record.evaluations == 80
        start = float(bowl(np.zeros((1, 2)))[0])
        assert found.loss < (start if strategy in STANDARD else start + 1e-3)
        assert found.loss == pytest.approx(float(bowl(found.z[None])[0]), rel=1e-4)


def test_a_strategy_works_where_its_population_suits_it():
    found = search(
        lambda c, around, data, pick: jnp.sum((c - 0.5) ** 2, axis=1),
        np.zeros(8),
        FitConfig(strategy="LM_MA_ES", population=8, generations=40),
    )
    assert found.loss < 1.0


def test_unknown_strategies_and_populations_that_one_refuses():
    with pytest.raises(UsageError, match=r"unknown strategy 'CMAES'\. Available: .*CMA_ES"):
        search(bowl, np.zeros(2), replace(CONFIG, strategy="CMAES"))
    with pytest.raises(UsageError, match="'Open_ES' refuses a population of 7"):
        search(bowl, np.zeros(2), replace(CONFIG, strategy="Open_ES", population=7))


def funnels(candidates, around, data, pick):
    """Two funnels, the deeper one on the left; what is far from the middle of its generation is judged too badly."""
    del data, pick
    right = 1.0 + jnp.sum((candidates - jnp.array([2.0, 0.5])) ** 2, axis=1)
    left = jnp.sum((candidates - jnp.array([-1.5, -0.5])) ** 2, axis=1)
    far = jnp.maximum(jnp.sum((candidates - around) ** 2, axis=1) - 4.0, 0.0)
    return jnp.minimum(right, left) + far


@pytest.mark.night
def test_restarts_find_the_deeper_funnel():
    populations = []

    def losses(candidates, around, data, pick):
        populations.append(candidates.shape[0])
        return funnels(candidates, around, data, pick)

    start, config = np.array([2.5, 1.0]), FitConfig(population=8, generations=40, std=0.3, seed=2)
    several = search(losses, start, replace(config, restarts=4))
    assert several.loss < 1e-3
    np.testing.assert_allclose(several.z, [-1.5, -0.5], atol=0.03)
    assert several.finalists.shape == (5, 2)
    found = [float(funnels(z[None], z, None, None)[0]) for z in several.finalists]
    assert found == sorted(found)
    assert found[-1] == pytest.approx(1.0, abs=1e-2)
    # The large runs double; small ones keep the first population: a program each.
    assert sorted({n for n in populations if n > 1}) == [8, 16, 32]
    one = search(funnels, start, config)
    assert one.loss == pytest.approx(1.0, abs=1e-3)
    assert several.record.evaluations > one.record.evaluations


def test_a_generation_sees_one_batch_and_the_end_sees_all():
    """Batches are of segments that count: the others, and what is padded, have no weight."""
    weight, offsets = np.array([0, 1, 0, 1, 1, 0, 1, 1, 0, 1]), 1000.0 * np.arange(10.0)
    segments, picks = np.flatnonzero(weight), []

    def losses(candidates, around, data, pick):
        pick = jnp.asarray(segments) if pick is None else pick
        jax.debug.callback(lambda p: picks.append(np.asarray(p)), pick)
        return bowl(candidates) + data[pick].mean()

    config = FitConfig(population=16, generations=40, std=1.0, batch=2, seed=3)
    found = search(losses, np.zeros(2), config, jnp.asarray(offsets), weight)
    jax.effects_barrier()
    # A batch's offset is far larger than what candidates differ by: were batches mixed, luck would decide.
    np.testing.assert_allclose(found.z, BOTTOM, atol=0.05)
    assert found.loss == pytest.approx(offsets[segments].mean() + float(bowl(found.z[None])[0]), rel=1e-5)
    batches = [p for p in picks if len(p) == 2]
    assert len([p for p in picks if len(p) == 6]) == 1
    assert len(batches) >= len(found.record.history) > 20, "on other segments each time, losses show no standstill"
    assert all(len(set(p.tolist())) == 2 and set(p.tolist()) <= set(segments.tolist()) for p in batches)
    assert len({tuple(sorted(p.tolist())) for p in batches}) > 5


@pytest.mark.parametrize("seed", [0, *(pytest.param(s, marks=pytest.mark.night) for s in (1, 2))])
def test_a_search_goes_on_after_a_lucky_early_candidate(seed):
    """Its best loss is that of the first generation; the median falls, and that counts."""
    config, asked = replace(CONFIG, std=0.3, seed=seed), []
    bottom, weights = np.array([1.0, -2.0, 0.5, 1.5, -1.0, 0.0]), jnp.geomspace(1.0, 100.0, 6)

    def losses(candidates, around, data, pick):
        jax.debug.callback(lambda c: asked.append(np.asarray(c)), candidates)
        lucky = jnp.sum((candidates - data) ** 2, axis=1) < 1e-3**2
        return jnp.where(lucky, 0.5, 1.0 + (candidates - bottom) ** 2 @ weights)

    programs = {}
    plain = search(losses, np.zeros(6), config, jnp.full(6, 99.0), programs=programs)
    jax.effects_barrier()
    candidate = next(c for c in asked if len(c) == config.population)[0]
    asked.clear()
    found = search(losses, np.zeros(6), config, jnp.asarray(candidate), programs=programs)
    jax.effects_barrier()
    assert set(found.record.history.tolist()) == {0.5}
    assert len(found.record.history) > 20
    assert len(found.record.history) > 0.5 * len(plain.record.history)
    last = [c for c in asked if len(c) == config.population][-1]
    np.testing.assert_allclose(last.mean(axis=0), bottom, atol=0.05)


def test_a_search_among_equals_ends_soon():
    """Neither median nor best falls: nothing is to be found."""
    flat = lambda c, around, data, pick: 1.0 + 0.0 * c[:, 0]  # noqa: E731
    assert len(search(flat, np.zeros(2), CONFIG).record.history) == 20


def test_a_batch_of_all_segments_is_none():
    picked = []

    def losses(candidates, around, data, pick):
        picked.append(pick)
        return bowl(candidates)

    search(losses, np.zeros(2), FitConfig(strategy="SNES", population=8, generations=2, batch=3), weight=np.ones(3))
    assert set(picked) == {None}


def on_host(candidates, around, pick, fresh):
    del around, pick, fresh
    return np.asarray(bowl(jnp.asarray(candidates, jnp.float32)), np.float64)


@pytest.mark.night
@pytest.mark.parametrize("strategy", ["CMA_ES", pytest.param("SNES", marks=pytest.mark.night), "DifferentialEvolution"])
def test_losses_outside_of_programs_are_searched_alike(strategy):
    config = replace(CONFIG, strategy=strategy, generations=30)
    alone = lambda z: float(bowl(z[None])[0])  # noqa: E731
    one = search(bowl, np.zeros(2), config)
    other = search(on_host, np.zeros(2), config, alone=alone, host=True)
    np.testing.assert_allclose(other.record.history, one.record.history, rtol=2e-3)
    np.testing.assert_allclose(other.z, one.z, atol=5e-3)
    assert other.record.evaluations == one.record.evaluations


def test_outside_of_programs_a_block_begins_afresh_and_a_generation_sees_one_batch():
    asked, weight = [], np.array([0, 1, 0, 1, 1, 0, 1, 1, 0, 1])

    def losses(candidates, around, pick, fresh):
        assert candidates.shape == (16, 2)
        assert around.shape == (2,)
        asked.append((fresh, tuple(sorted(pick.tolist()))))
        return np.where(candidates[:, 0] > 3.0, np.nan, on_host(candidates, around, pick, fresh))

    config = replace(CONFIG, generations=20, batch=2)
    found = search(losses, np.zeros(2), config, None, weight, alone=lambda z: float(bowl(z[None])[0]), host=True)
    assert [i for i, (fresh, _) in enumerate(asked) if fresh] == list(range(0, len(found.record.history), 10))
    assert all(len(set(pick)) == 2 and weight[list(pick)].all() for _, pick in asked)
    assert len({pick for _, pick in asked}) > 3


DIVIDED = """
from dataclasses import replace
import numpy as np
from test_search import CONFIG, bowl
from sim2real.identify.search.search import search

config, programs, found = replace(CONFIG, generations=40), {}, []
for devices in (1, 2):
    programs = {}
    found.append(search(bowl, np.zeros(2), replace(config, devices=devices), programs=programs))
    runs = [p for kind, p in programs.items() if kind != "alone" and p.population == 16]
    texts = [compiled.as_text() for p in runs for compiled in p.advance._compiled.values()]
    assert [("num_partitions=2" in t, "f32[8,2]" in t) for t in texts] == [(devices == 2,) * 2], texts[0][:300]
np.testing.assert_allclose(found[1].record.history, found[0].record.history, rtol=1e-3)
np.testing.assert_allclose(found[1].finalists, found[0].finalists, atol=1e-3)
assert found[1].record.evaluations == found[0].record.evaluations
"""


@pytest.mark.night
def test_two_devices_find_what_one_finds_and_each_simulates_half():
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=2"
    here = Path(__file__).parent
    path = os.pathsep.join([str(here), str(here.parents[1]), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "XLA_FLAGS": flags, "PYTHONPATH": path}
    done = subprocess.run(
        [sys.executable, "-c", DIVIDED], capture_output=True, text=True, timeout=300, env=environment, check=False
    )
    assert done.returncode == 0, done.stderr


def test_devices_that_cannot_divide_the_candidates_are_refused():
    with pytest.raises(UsageError, match="divide the population of 16, got 3"):
        replace(CONFIG, devices=3)
    for engine, said in ((Choice("c", "asked for"), "C MuJoCo simulates on"), (Choice("compiled", ""), "JAX finds 1 ")):
        with pytest.raises(UsageError, match=f"devices=64, but {said}"):
            check_devices(64, engine)
    check_devices(1, Choice("c", "asked for"))
