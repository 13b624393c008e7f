"""Benefit of identification for training: policies trained in five ways, and deployed on hidden robots.

The robots are far from ideal: measurements are noisy, latencies jitter, the computer pauses, answers get lost, some
have play. A deployment succeeds that stays up: within 18 degrees of upright for 80 % of its second half.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from benches.hidden import robots as hidden
from benches.jobs import robots
from benches.rows import Report, Row, markdown, row, share, values

RECORD_S, UPRIGHT = 40.0, 0.8
"""Length of the recording [s]; share of the second half in which a deployment that succeeds is upright."""
UP, STILL_RAD_S = 0.95, 0.5
"""Smallest cosine of an angle that is upright; fastest of what also counts as still [rad/s]."""
GROWING = {"curriculum": (0.0, 1.0)}
WAYS: dict[str, dict[str, Any]] = {
    "data_sheet": {"model": "nominal"},
    "uniform": {"model": "nominal", "uniform": 0.3, **GROWING},
    "point": {"randomise": 0.0, "noise": 0.0, "pauses": False},
    "posterior": {"misfit": False, "noise": 0.0, "pauses": False, **GROWING},
    "all": GROWING,
}
"""Data sheet; 30 % around it; the estimate; its posterior; the posterior with misfit, timing and noise. The width of
the draws grows to its final value during the training."""
WEAR = hidden.Wear(jitter_s=0.008, lost=0.05, play_rad=0.02, noise_rad=0.05, hiccups_hz=1.5, hiccup_s=0.04)
QUICK = {"robots": 1, "trials": 1, "seconds": 2.0, "steps": 512, "generations": 5, "record_s": 8.0, "envs": 16}


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of this bench."""
    parser.add_argument("--robots", type=int, default=20, help="hidden robots")
    parser.add_argument("--first", type=int, default=0, help="number of the first robot")
    parser.add_argument("--trials", type=int, default=10, help="deployments of each policy")
    parser.add_argument("--seconds", type=float, default=8.0, help="length of a deployment")
    parser.add_argument("--record-s", type=float, default=RECORD_S, help="length of the recording")
    parser.add_argument("--record-volts", type=float, default=1.8, help="largest voltage of the recording")
    for field in fields(hidden.Wear):
        flag = f"--{field.name.replace('_', '-')}"
        parser.add_argument(flag, type=float, default=getattr(WEAR, field.name), help="see hidden_robots.Wear")
    parser.add_argument("--volts", type=float, default=2.0, help="largest command of a policy")
    parser.add_argument("--steps", type=int, default=3_000_000, help="policy steps of a training")
    parser.add_argument("--envs", type=int, default=256, help="copies of a training")
    parser.add_argument("--generations", type=int, default=80, help="generations of the search")
    parser.add_argument("--ways", nargs="*", default=list(WAYS), choices=list(WAYS), help="kinds of training")
    parser.add_argument("--jobs", type=int, default=1, help="robots at once, one process each; 1: in this process")


def run(options: argparse.Namespace) -> Report:
    """Record, identify, train and deploy for each robot."""
    numbers = list(range(options.first, options.first + options.robots))
    begin = time.perf_counter()
    outcomes, failed = robots(one_robot, numbers, options)
    lines = rows(outcomes, options, time.perf_counter() - begin)
    lines.append(row("randomise/failed", len(failed), f"of {len(numbers)}", "", "<= 0"))
    return {"rows": lines, **({"failed": failed} if failed else {})}


def rows(outcomes: list[Row], options: argparse.Namespace, seconds: float) -> list[Row]:
    """Return each way's share of success with its exact 95 % interval, all deployments of all robots together."""
    lines = []
    for way in options.ways:
        good = np.array([np.array(robot["ways"][way]["success"]) >= UPRIGHT for robot in outcomes])
        still = np.array([np.mean(np.array(robot["ways"][way].get("still", [0.0])) >= UPRIGHT) for robot in outcomes])
        value, low, high = share(int(good.sum()), good.size)
        name = f"randomise/{way}"
        lines += [
            row(f"{name}/success", value, f"of {good.size} deployments", "", ">= 0.95" if way == "all" else ""),
            row(f"{name}/low95", low, "share"),
            row(f"{name}/high95", high, "share"),
            row(f"{name}/still", still.mean(), f"upright and below {STILL_RAD_S} rad/s"),
            row(f"{name}/robots", int((good.mean(axis=1) >= 0.95).sum()), f"of {len(outcomes)} with 95 %"),
        ]
    accepted = sum(robot["verdict"] == "accepted" for robot in outcomes)
    lines.append(row("randomise/accepted", accepted, f"of {len(outcomes)} identifications"))
    lines.append(row("randomise/robot_s", seconds * options.jobs / max(len(outcomes), 1), "s"))
    return lines


def one_robot(number: int, options: argparse.Namespace) -> dict[str, Any]:
    """Return the results of one robot."""
    import sim2real
    from sim2real.errors import Sim2RealError
    from sim2real.stages.load import load_robot

    wear = hidden.Wear(**{f.name: getattr(options, f.name) for f in fields(hidden.Wear)})
    robot, pipeline = hidden.Hidden.draw(number, wear), load_robot("pendulum")
    ways: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder:
        recording = recorded(robot, options, Path(folder) / "session.mcap")
        config = replace(pipeline.defaults.identify, folds=0, generations=options.generations, seed=number)
        identified = sim2real.identify(pipeline, recording, config)
        for way in options.ways:
            begin = time.perf_counter()
            try:
                bundle = sim2real.train(pipeline, identified, train_config(pipeline, way, number, options))
                motions = [played(robot, bundle, options, 1 + trial) for trial in range(options.trials)]
            except Sim2RealError as error:  # a policy that is not trained, or that the gate stops, has no success
                ways[way] = {"success": [0.0] * options.trials, "refused": str(error)}
                print(f"robot {number}, {way}: {error}", flush=True)
                continue
            ways[way] = {
                "success": [upright(*motion, np.inf) for motion in motions],
                "still": [upright(*motion, STILL_RAD_S) for motion in motions],
                "in simulation": bundle.summary["success in simulation"],
                "seconds": time.perf_counter() - begin,
            }
            print(f"robot {number}, {way}: {np.round(ways[way]['success'], 2)}", flush=True)
    return {"number": number, "verdict": identified.verdict.status, "ways": ways}


def recorded(robot: hidden.Hidden, options: argparse.Namespace, path: Path) -> Any:
    """Return a recording of the robot."""
    from sim2real.artifacts.recording import Recording

    excited = hidden.excited(options.record_s, robot.seed, options.record_volts)
    hidden.write(path, hidden.play(robot, excited, options.record_s, 0))
    return Recording.load(path)


def played(robot: hidden.Hidden, bundle: Any, options: argparse.Namespace, session: int) -> tuple[np.ndarray, ...]:
    """Return times [s], true angles [rad] and speeds [rad/s] of a session on the simulated clock."""
    session_log = hidden.play(robot, controller(bundle, options.volts), options.seconds, session)
    return session_log.t, session_log.angle, session_log.speed


def upright(t_s: np.ndarray, angle: np.ndarray, speed: np.ndarray, fastest: float) -> float:
    """Return the share of the second half in which the robot is upright and not faster than that.

    Args:
        t_s: Times, ``(N,)`` [s].
        angle: True angles, ``(N,)`` [rad].
        speed: True speeds, ``(N,)`` [rad/s].
        fastest: Largest speed that counts [rad/s].
    """
    up = (np.cos(angle) > UP) & (np.abs(speed) < fastest)
    return float(up[t_s >= t_s[-1] / 2].mean())


def train_config(pipeline: Any, way: str, seed: int, options: argparse.Namespace) -> Any:
    """Return the training's configuration for one of ``WAYS``."""
    settings = dict(WAYS[way])
    top = {n: settings.pop(n) for n in ("model", "randomise") if n in settings}
    few = {"minibatches": 2, "evaluations": 1} if options.envs < pipeline.defaults.train.ppo.minibatches else {}
    ppo = replace(pipeline.defaults.train.ppo, total_steps=options.steps, num_envs=options.envs, **few)
    vary = replace(pipeline.defaults.train.vary, **settings)
    return replace(pipeline.defaults.train, seed=seed, force=True, vary=vary, ppo=ppo, **top)


def controller(bundle: Any, volts: float) -> Callable[[float, float], float]:
    """Return the policy as the robot runs it: cos, sin and speed, and the last four steps of these and of its voltage.

    Args:
        volts: Its commands are cut off here [V].
    """
    from sim2real.policy.runner import NumpyBackend

    backend = NumpyBackend(bundle.weights)
    history = int(next(t.history for t in bundle.contract.observation if t.history > 1))
    readings, sent = np.zeros((history, 3)), np.zeros(history)

    def act(angle: float, speed: float) -> float:
        now = np.array([np.cos(angle), np.sin(angle), speed / 10.0])
        observation = np.concatenate([now, readings.ravel(), sent]).astype(np.float32)
        command = float(np.clip(backend(observation)[0], -volts, volts))
        readings[1:], sent[1:] = readings[:-1].copy(), sent[:-1].copy()
        readings[0], sent[0] = now, command
        return command

    return act


TRAINED_ON = {
    "data_sheet": "data-sheet values, no delays",
    "uniform": "data-sheet values, varied by 30 %",
    "point": "identified values and delays",
    "posterior": "the same, varied by their uncertainty",
    "all": "the same, with model error, timing, noise",
}


def table(ideal: Report, worn: Report) -> str:
    """Return the success on hidden robots that are nearly ideal, and on worn ones, with exact 95 % intervals."""
    lines = []
    for way, about in TRAINED_ON.items():
        line = [about]
        for v in (values(report, f"randomise/{way}/") for report in (ideal, worn)):
            line += [f"{100 * v['success']:.0f} %", f"{100 * v['low95']:.0f} to {100 * v['high95']:.0f} %"]
        lines.append(line)
    count, trials = (ideal["flags"][name] for name in ("robots", "trials"))
    head = f"trained on, {count} hidden robots with {trials} deployments each"
    return markdown([head, "nearly ideal", "95 %", "worn", "95 %"], lines)
