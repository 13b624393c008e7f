"""Programs of identification: compiled once for each form of their arguments, the same for every log."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_folds import CONFIG, DURATION_S, Model, lag_log

from sim2real.identify.problem.problem import Problem
from sim2real.identify.problem.programs import Program
from sim2real.identify.problem.segments import Span

LENGTH_S = 0.93


def spans(offset_s=0.0, count=9):
    return [Span(0, 0.4 + offset_s + 0.9 * i, fitted=i != 4) for i in range(count)]


def problem_of(seed, own=None):
    return Problem(Model(), [lag_log(seed)], own or spans(), LENGTH_S, CONFIG)


def lowered(problem, name):
    """Return the text of a program with the data of a problem."""
    z = jnp.zeros(len(problem.table))
    arguments = {"linearised": (z,), "losses": (z[None], z)}[name]
    return jax.jit(getattr(problem.residuals, name)).lower(*arguments, problem.data).as_text()


@pytest.mark.parametrize("name", ["linearised", "losses"])
def test_two_logs_of_a_length_have_one_program(name):
    assert lowered(problem_of(0), name) == lowered(problem_of(1), name)


@pytest.mark.night
def test_two_logs_with_timing_of_their_own_have_one_program(fitted, late_problem):
    """Stamps of measurements and commands differ from log to log, and how many of them a segment holds."""
    assert (
        fitted.problem.timeline.vertices["sensor"].start.tolist()
        != late_problem.timeline.vertices["sensor"].start.tolist()
    )
    assert lowered(fitted.problem, "losses") == lowered(late_problem, "losses")


@pytest.mark.night
def test_counts_that_round_up_alike_have_one_program():
    nine, ten = (problem_of(0, [Span(0, 0.4 + 0.7 * i) for i in range(n)]) for n in (9, 10))
    assert (nine.segments, ten.segments) == (9, 10)
    assert lowered(nine, "linearised") == lowered(ten, "linearised")


@pytest.mark.night
def test_other_segments_of_the_same_recordings_share_all_programs():
    problem = problem_of(0)
    other = problem.recut(spans(0.3), LENGTH_S)
    programs, z = problem.residuals.programs, problem.table.start()
    first = problem.at(z).loss, problem.losses(z[None], z)[0]
    rows = {n: np.full(9, v) for n, v in problem.table.decode(z).items()}
    ahead = problem.predict(rows, np.arange(9), np.full(9, 0.3))
    second = other.at(z).loss, other.losses(z[None], z)[0]
    assert other.residuals is problem.residuals
    assert abs(first[0] - second[0]) > 1e-3 * first[0]
    assert second == pytest.approx((second[0], second[0]), rel=1e-5)
    assert np.abs(other.predict(rows, np.arange(9), np.full(9, 0.3)) - ahead).max() > 1e-3
    assert {n: len(p._compiled) for n, p in programs.items()} == {"linearised": 1, "losses": 1, "predict": 1}
    fresh = problem_of(0, spans(0.3))
    assert fresh.at(z).loss == pytest.approx(second[0], rel=1e-6)


def test_leaving_parts_out_and_fewer_parameters_compile_nothing():
    problem = problem_of(0)
    z, kept = problem.table.start(), np.arange(len(problem.table)) < 2
    losses = [
        problem.at(z, d).loss for d in (None, problem.part([0, 3]), problem.part(present=kept), problem.part([1], kept))
    ]
    assert len(problem.residuals.programs["linearised"]._compiled) == 1
    assert len(set(losses)) >= 3


@pytest.mark.night
def test_longer_segments_are_another_program():
    problem = problem_of(0)
    z = problem.table.start()
    problem.at(z)
    problem.recut([Span(0, 0.4)], DURATION_S - 1.0).at(z)
    assert len(problem.residuals.programs["linearised"]._compiled) == 2


def test_a_program_is_compiled_for_each_form_and_says_so():
    traced, told = [], []
    program = Program(lambda x: traced.append(x.shape) or 2.0 * x)
    for size in (3, 3, 4):
        np.testing.assert_array_equal(program(jnp.ones(size), on_compile=told.append), 2.0 * np.ones(size))
    assert traced == [(3,), (4,)]
    assert told == [True, False] * 2
    program(jnp.ones(3, jnp.int32), on_compile=told.append)
    assert len(told) == 6
