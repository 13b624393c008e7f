"""The league's entrants and its sets: each finds again what made a recording of its own form."""

import argparse
import hashlib
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
from benches.league import bench, cmaes, published, textbook
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
    (only,) = league_sets.rmse(predicted, own)
    assert only == pytest.approx(np.sqrt(6)), "a joint that is not moved does not count"
    assert league_sets.mae(predicted[:, :1], own.joint(0)) == pytest.approx([2.0])
    both = {"set": "s", "entrant": "e", "unit": "mm", "seconds": 1.0, "summary": ""}
    folds = [
        {**both, "fold": str(i), "value": v, "worst_joint": w} for i, (v, w) in enumerate([(1.0, 5.0), (3.0, 4.0)])
    ]
    rows = bench.rows(folds)
    assert [(r["name"], r["value"]) for r in rows] == [
        ("league/s/e/mean", 2.0), ("league/s/e/worst", 3.0), ("league/s/e/worst_joint", 5.0)
    ]  # fmt: skip


def steps(length_s=3.0, seed=0):
    """A recording of a goal that jumps, without positions yet."""
    t = 0.01 * np.arange(round(100 * length_s))
    goal = np.random.default_rng(seed).uniform(-0.5, 0.5, 10)[(t / 0.6).astype(int) % 10]
    return Recording(t, goal[:, None], np.zeros((len(t), 1)), np.zeros((1, 2)))


def test_the_textbook_servo_moves_as_its_equation_says_and_its_fit_predicts_another_motion():
    own = replace(steps(), command=np.full((300, 1), 0.3))
    servo = textbook.Servo([own], force=False, loaded=False)
    free = {"stiffness": 400.0, "damping": 10.0, "dry": 1e-4, "delay": 0.1, "rate": 100.0}
    (q,) = servo.predict(np.log([[free[n] for n in servo.names]]))
    s, w = own.t, np.sqrt(400.0 - 25.0)
    exact = 0.3 * (1 - np.exp(-5 * s) * (np.cos(w * s) + 5 / w * np.sin(w * s)))
    np.testing.assert_allclose(q[0], exact, atol=0.01)
    twice = replace(own, constants={"duty_per_rad": 2.0})
    both = servo.__class__([own, twice], force=False, loaded=False)
    stiff, half = (np.log([[(free | {"stiffness": k})[n] for n in servo.names]]) for k in (400.0, 200.0))
    np.testing.assert_allclose(both.predict(half)[1], servo.predict(stiff)[0], err_msg="a gain is a factor, in any set")
    true = np.log([[300.0, 20.0, 2.0, 0.023, 3.0]])
    moved = lambda r: replace(r, position=textbook.Servo([r], False, False).predict(true)[0].T)  # noqa: E731
    fitted, test = moved(steps()), moved(steps(seed=1))
    predict, summary = textbook.fit([fitted], force=False, loaded=False, budget_s=2.0, seed=0)
    assert league_sets.rmse(predict([test])[0], test)[0] < 10.0, summary


def test_a_textbook_axis_takes_forces_and_long_recordings_are_fitted_in_windows():
    long = steps(21.0)
    axis = textbook.Servo([long], force=True, loaded=False)
    assert axis.names == ["stiffness", "damping", "dry", "delay", "constant"]
    (q,) = axis.predict(np.array([[*np.log([2.0, 1.0, 1e-4, 1e-4]), 0.5]]))
    pushed = replace(long, position=q.T)
    parts = textbook.windows(pushed)
    assert [len(p.t) for p in parts] == [500, 500, 500, 600]
    assert parts[1].start[0] == pytest.approx([q[0, 500], (q[0, 501] - q[0, 499]) / 0.02], abs=0.01)
    assert textbook.windows(fitted := steps()) == [fitted]


def test_published_sets_hold_their_goals_and_differ():
    ends = {
        name: published.predict(name, [replace(steps(), command=np.full((300, 1), 0.3))])[0]
        for name in published.SERVOS
    }
    for name, q in ends.items():
        assert q.shape == (300, 1)
        assert q[0, 0] == 0.0
        assert q[-1, 0] == pytest.approx(0.3, abs=0.02), f"{name}: friction over stiffness"
    assert np.ptp([q[10, 0] for q in ends.values()]) > 0.01


def test_a_published_axis_sticks_and_then_moves_as_its_equation_says():
    """Friction of 20.4 N holds it under 15 + 3.2 N; 100 N end at (100 + 3.2 - 20.4) N / 203.5 N s/m."""
    held, pushed = (replace(steps(6.0), command=np.full((600, 1), force)) for force in (15.0, 100.0))
    (still,), (moving,) = published.predict("published_idim", [held]), published.predict("published_idim", [pushed])
    assert abs(still[-1, 0]) < 1e-4
    assert (moving[-1, 0] - moving[-101, 0]) / 1.0 == pytest.approx(0.4067, rel=2e-3)


def described_set(folder, **changed):
    """A folder with a model, a log of a goal that is followed late, and a description."""
    (folder / "arm").mkdir()
    (folder / "arm" / "arm.xml").write_text(league_ours.ARM.format(mass=0.5, length=0.1))
    own = steps(12.0)
    late = np.interp(own.t - 0.05, own.t, np.convolve(own.command[:, 0], np.full(9, 1 / 9), "same"))
    np.savez(folder / "arm" / "a.npz", t_s=own.t, q_rad=late[:, None], q_goal_rad=own.command)
    about = {"mjcf": "arm.xml", "fit": ["a.npz[0:0.6]"], "test": ["a.npz[0.6:1]"], "terms": "auto", **changed}
    (folder / "arm" / "league.toml").write_text("".join(f"{n} = {v!r}\n" for n, v in about.items()))
    return league_sets.available(folder)


def test_a_folder_with_a_description_is_a_set_and_a_fit_gets_no_test_part(tmp_path, monkeypatch):
    (own,) = described_set(tmp_path).values()
    (fold,) = own.folds(tmp_path)
    assert [len(r.t) for r in (*fold.fitted, *fold.test)] == [720, 480]
    assert fold.test[0].constants["terms"] == "auto"
    options = argparse.Namespace(budget_s=0.5, seed=0, samples=None, data=tmp_path)
    for entrant in ("textbook", "sysid"):
        result = bench.judge(own, fold, entrant, options)
        assert 0.0 < result["value"] <= result["worst_joint"] < 1000.0
    assert bench.judge(own, fold, "bam_m1", options)["value"] is None

    def fit(name, fold, data, seed):
        assert fold.test == ()
        return lambda test: [r.position + 0.002 for r in test], "", "terms a\ngain"

    monkeypatch.setattr(league_ours, "fit", fit)
    result = bench.judge(own, fold, "ours", options)
    assert (result["value"], result["unit"]) == (pytest.approx(2.0), "mrad")
    assert result["sha256"] == hashlib.sha256(b"terms a\ngain").hexdigest()


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"test": ["a.npz[0.5:1]"]}, "parts of a.npz are fitted and judged"),
        ({"test": ["a.npz[1:0]"]}, "no part of a file"),
        ({"tests": ["b.npz"]}, "tests is missing, unknown"),
        ({"test": []}, "mjcf, fit or test is missing"),
    ],
)
def test_a_description_that_is_wrong_is_refused(tmp_path, changed, message):
    with pytest.raises(UsageError, match=message):
        described_set(tmp_path, **changed)["arm"].folds(tmp_path)


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


@pytest.mark.night
def test_ours_identifies_an_arm_from_logs_and_sees_of_the_test_its_start_alone(recorded, quick_to_compile, monkeypatch):
    monkeypatch.setattr(league_ours, "CHOOSES", ())  # two logs of 2 s are too few to choose terms
    fold = Fold("a gain", (recorded(5.0, 4.0), recorded(10.0, 7.0)), (recorded(7.0, 5.0, (0.2, -1.0)),))
    predict, told, structure = league_ours.fit("sts3250", fold, Path(), 0)
    assert len(structure.splitlines()) == 7
    assert structure.startswith("terms \n")
    assert told == "6 parameters of --mjcf, refined from the model's; terms none; engine c"
    (test,) = fold.test
    found, blind = predict([test, replace(test, position=np.full_like(test.position, 9.0))])
    assert np.ptp(test.position) > 0.5
    assert league_sets.mae(found, test)[0] < 3.0, "gains that differ are a factor of one stiffness"
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
