"""The league's entrants and its sets: each finds again what made a recording of its own form."""

import argparse
import importlib
import os
import sys
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from sim2real.errors import UsageError

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "scripts"))
from benches import jobs
from benches.identify import recordings
from benches.identify.sysid import Recording
from benches.league import bam as league_bam
from benches.league import cmaes
from benches.league import ours as league_ours
from benches.league import sets as league_sets
from benches.league.sets import Fold

TASK = """
import os

def where(name, options):
    flags, threads = os.environ["XLA_FLAGS"], os.environ["OPENBLAS_NUM_THREADS"]
    return {"name": name, "process": os.getpid(), "processors": os.sched_getaffinity(0), "threads": (threads, flags)}
"""
"""A module of its own: a process imports the one of its task, and this one takes seconds."""


def test_cma_es_finds_a_bent_valley_in_a_box():
    """Rosenbrock's function in six dimensions: thousands of steps along a valley, none of them straight."""

    def losses(u):
        x = 4 * u - 2
        return np.sum(100 * (x[:, 1:] - x[:, :-1] ** 2) ** 2 + (1 - x[:, :-1]) ** 2, axis=1)

    run = cmaes.CmaEs(np.full(6, 0.3), 0.2, 12, np.random.default_rng(1))
    for _ in range(600):
        candidates = run.sample()
        assert candidates.min() >= 0.0
        assert candidates.max() <= 1.0
        run.update(candidates, losses(candidates))
    np.testing.assert_allclose(run.mean, 0.75, atol=1e-3)


def test_bams_friction_is_that_of_its_source():
    """Against the figures of Rhoban/bam's Model.compute_frictions (17d9addc), plus damping times speed."""
    p = {
        "friction_base": 0.05, "friction_viscous": 0.1, "friction_stribeck": 0.04, "load_friction_motor": 0.06,
        "load_friction_external": 0.07, "load_friction_motor_stribeck": 0.2, "load_friction_external_stribeck": 0.3,
        "load_friction_motor_quad": 0.01, "load_friction_external_quad": 0.008, "dtheta_stribeck": 0.2, "alpha": 1.35,
    }  # fmt: skip
    motor, load, speed = 1.2, -0.5, 0.15
    rest = np.exp(-((0.15 / 0.2) ** 1.35))
    gears, stuck = abs(-0.5 * 0.07 - 1.2 * 0.06), abs(-0.5 * 0.3 - 1.2 * 0.2)
    expected = 0.05 + gears + rest * (0.04 + stuck + 0.008 * 0.25) + 0.1 * 0.15  # the motor drives: the load's square
    assert float(league_bam.friction(p, motor, load, speed)) == pytest.approx(expected, rel=1e-6)
    aligned = 0.05 + abs(0.5 * 0.07 - 0.072) + rest * (0.04 + abs(0.15 - 0.24)) + 0.015
    assert float(league_bam.friction(p, motor, 0.5, speed)) == pytest.approx(aligned, rel=1e-6)
    m1 = {n: p[n] for n in ("friction_base", "friction_viscous")}
    assert float(league_bam.friction(m1, motor, load, speed)) == pytest.approx(0.065)


def test_a_bench_sticks_swings_and_falls():
    """A pendulum under no voltage: held by its friction, or falling as long as its inertia says."""
    load = {"mass": 1.0, "length": 0.1, "vin": 12.0}
    p = dict.fromkeys(("q_offset", "command_delay", "friction_viscous"), 0.0) | {"kt": 1.0, "R": 2.0, "armature": 0.0}
    off, none = jnp.zeros(200, bool), jnp.zeros(200)
    held = league_bam.simulate(p | {"friction_base": 0.5}, load, 1.0, jnp.array([0.3, 0.0]), none, off)
    np.testing.assert_allclose(held, 0.3)
    free = np.asarray(league_bam.simulate(p | {"friction_base": 0.0}, load, 1.0, jnp.array([0.05, 0.0]), none, off))
    period = 2 * np.pi * np.sqrt(0.1 / league_bam.GRAVITY)
    first = league_bam.STEP_S * int(np.argmin(free[: round(0.75 * period / league_bam.STEP_S)]))
    assert first == pytest.approx(period / 2, abs=2 * league_bam.STEP_S)
    pulled = league_bam.simulate(
        p | {"friction_base": 0.0}, load, 1.0, jnp.zeros(2), jnp.full(2000, 0.2), jnp.ones(2000, bool)
    )
    q = float(pulled[-1])  # the duty's torque holds the weight
    assert 0.5 * 12.0 * (0.2 - q) == pytest.approx(0.1 * league_bam.GRAVITY * np.sin(q), rel=0.02)


def test_blocks_are_held_out_with_states_from_the_past_alone():
    t = 0.01 * np.arange(300)
    command, position = np.zeros((300, 1)), (t**2)[:, None].copy()
    position[150:] += 5.0  # a jump that a state from the past cannot know of
    folds = league_sets.blocks(t, command, position, [0, 100, 151, 300], lambda i: None)
    assert [len(f.fitted) for f in folds] == [2, 2, 2]
    (test,) = folds[1].test
    np.testing.assert_allclose(test.start[0], [1.0, 2.0], rtol=1e-6)
    assert (test.t[0], len(test.t)) == (0.0, 51)
    (first,) = folds[0].test
    assert len(first.t) == 100 - recordings.PAST, "a state has to be known before it starts"
    shifted = position.copy()
    shifted[101:] = -9.0
    (same,) = league_sets.blocks(t, command, shifted, [0, 100, 151, 300], lambda i: None)[1].test
    np.testing.assert_allclose(same.start, test.start)


def test_what_pace_predicts_does_not_depend_on_what_it_tried_before():
    """The toolbox sets parameters in one and the same model."""
    pytest.importorskip("mujoco.sysid")
    from benches.league import mujoco_joints as league_mujoco

    t = 0.01 * np.arange(60)
    known = {"duty_per_rad": 1.0, "mass": 0.49, "length": 0.1, "torque_enable": np.ones(60, bool)}
    own = Recording(t, 0.5 * np.sin(5 * t)[:, None], 0.4 * np.sin(5 * t)[:, None], np.zeros((1, 2)), known)
    predict, _ = league_mujoco.fit_pace(league_mujoco.one_joint("xl330"), [own], 0.1, 0)
    first, second = predict([own])[0], predict([own])[0]
    np.testing.assert_array_equal(first, second)


def test_scores():
    own = Recording(np.arange(3.0), np.array([[0, 0], [1, 0], [0, 0.0]]), np.zeros((3, 2)), np.zeros((2, 2)))
    predicted = np.array([[0.003, 9.0], [0.0, 9.0], [0.003, 9.0]])
    assert league_sets.rmse_mrad(predicted, own) == pytest.approx(np.sqrt(6)), (
        "a joint that is not moved does not count"
    )
    assert league_sets.mae_mrad(predicted[:, :1], own.joint(0)) == pytest.approx(2.0)


@pytest.fixture
def quick_to_compile():
    """What runs for milliseconds need not be compiled for speed."""
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", False)


@pytest.fixture
def recorded():
    """Records the guide's arm in C MuJoCo: a gain [N m/rad] for a duty per radian, a goal's frequency [rad/s]."""
    model = mujoco.MjModel.from_xml_string(league_ours.ARM.format(mass=0.5, length=0.1))
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST

    def record(duty_per_rad, speed, start=(0.0, 0.0)):
        data = mujoco.MjData(model)
        data.qpos[0], data.qvel[0] = start
        t = 0.02 * np.arange(100)
        goal, q = 0.5 * np.sin(speed * t), []
        for told in goal:
            q.append(data.qpos[0])
            for _ in range(10):
                data.qfrc_applied[0] = 3.0 * duty_per_rad * (told - data.qpos[0])
                mujoco.mj_step(model, data)
        known = {"duty_per_rad": duty_per_rad, "mass": 0.5, "length": 0.1, "torque_enable": np.ones(100, bool)}
        return Recording(t, goal[:, None], np.array(q)[:, None], np.array([start]), known)

    return record


def test_ours_identifies_an_arm_from_logs_and_sees_of_the_test_its_start_alone(recorded, quick_to_compile, monkeypatch):
    monkeypatch.setattr(league_ours, "CHOOSES", ())  # two logs of 2 s are too few to choose terms
    fold = Fold("a gain", (recorded(5.0, 4.0), recorded(10.0, 7.0)), (recorded(7.0, 5.0, (0.2, -1.0)),))
    predict, told = league_ours.fit("sts3250", fold, Path(), 0)
    assert told == "6 parameters of --mjcf, refined from the model's; terms none; engine c"
    (test,) = fold.test
    found, blind = predict([test, replace(test, position=np.full_like(test.position, 9.0))])
    assert np.ptp(test.position) > 0.5
    assert league_sets.mae_mrad(found, test) < 3.0, "gains that differ are a factor of one stiffness"
    assert found[0, 0] == 0.2
    np.testing.assert_allclose(blind, found, atol=1e-5)


def test_ours_takes_the_model_that_comes_with_recordings_and_refuses_two_loads(recorded, tmp_path):
    own = recorded(5.0, 4.0)
    assert league_ours._model([replace(own, constants={"mjcf": "/a/robot.xml"})], tmp_path) == Path("/a/robot.xml")
    model = mujoco.MjModel.from_xml_path(str(league_ours._model([own], tmp_path)))
    assert model.body("arm").mass[0] == 0.5
    with pytest.raises(UsageError, match="one load"):
        league_ours._model([own, replace(own, constants={**own.constants, "mass": 1.0})], tmp_path)


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="only Linux holds a process on a processor")
def test_jobs_are_processes_of_one_thread_and_one_processor(tmp_path, monkeypatch):
    """What a task returns is told by its number, in whatever order they end."""
    (tmp_path / "a_task.py").write_text(TASK)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("XLA_FLAGS", "--kept")
    where, before = importlib.import_module("a_task").where, dict(os.environ)
    found = dict(jobs.each(where, [("a",), ("b",), ("c",)], argparse.Namespace(jobs=2)))
    assert os.environ == before
    assert [found[i]["name"] for i in range(3)] == ["a", "b", "c"]
    assert len({found[i]["process"] for i in range(3)} | {os.getpid()}) == 4, "a process a task"
    flags = "--kept --xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
    assert all(f["threads"] == ("1", flags) and len(f["processors"]) == 1 for f in found.values())


def test_one_job_is_done_here():
    ((number, found),) = jobs.each(lambda a, o: {"sum": a + o.jobs}, [(2,)], argparse.Namespace(jobs=1))
    assert (number, found) == (0, {"sum": 3})


def test_a_job_that_fails_ends_the_others_and_leaves_the_environment(monkeypatch, tmp_path):
    (tmp_path / "bad_task.py").write_text("def bad(name, options):\n    raise ValueError(name)\n")
    monkeypatch.syspath_prepend(tmp_path)
    before = dict(os.environ)
    with pytest.raises(ValueError, match="a"):
        list(jobs.each(importlib.import_module("bad_task").bad, [("a",)], argparse.Namespace(jobs=2)))
    assert os.environ == before
