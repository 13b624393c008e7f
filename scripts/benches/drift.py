"""How often the drift test detects a change of an SO-101 from the logs of a deployment, and names its parameter.

Each arm is recorded, identified, and deployed: unchanged, with twice the friction, with 30 % more payload, and 15 ms
later. Arms differ in the parameters of their servos and in their latencies. Plant, latencies and gate are those of the
wall clock; random times replace bus and threads. The policy is written by hand for the unchanged robots: it moves the
goals from target to target, as fast as a trained one may. Small steps before each deployment measure the delay.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from benches import jobs
from benches.hidden import arms
from benches.hidden.robots import RATE_HZ, write_log
from benches.rows import Report, Row, row, share
from sim2real.errors import Sim2RealError
from sim2real.hardware.safety.gate import SafetyGate
from sim2real.stages.load import load_robot

CAUSES = {"none": "", "friction": "friction", "payload": "payload", "delay": "round_trip_delay"}
"""Change of the robot -> the parameter that the verdict must name."""
FRICTION, DELAY_S, PAYLOAD_KG = 2.0, 0.015, 0.3 * 0.485
"""Factor on the friction, more latency, and the mass between the jaws: 30 % of that of all links."""
TARGET_S, APPROACH_HZ = 4.0, 4.0
"""Time at each target; rate at which a goal approaches it."""
STEP_RAD, STEP_S, STEPS = 0.12, 0.5, 8
"""Size, duration and number of the small steps that measure the delay."""
QUICK = {"runs": 1, "changes": ["friction"], "generations": 5, "record_s": 12.0, "seconds": 5.0, "folds": 0}
Policy = Callable[[int, np.ndarray], np.ndarray]
"""Number of a step, and the goals of the one before [rad] -> goals [rad]."""


def draw(number: int) -> arms.HiddenArm:
    """Draw a robot: within 20 % of the pipeline's, 10 to 28 ms late."""
    rng = np.random.default_rng([20261124, number])
    plant = {"gain": rng.uniform(0.8, 1.2), "friction": rng.uniform(0.8, 1.2)}
    sensing, acting = rng.uniform(0.003, 0.010), rng.uniform(0.007, 0.018)
    return arms.HiddenArm("so101", plant, sensing, acting, 0.15 * sensing, (0.0, 0.0), 0.0, number)


def changed(arm: arms.HiddenArm, change: str) -> arms.HiddenArm:
    """Return the robot after a change; ``none``: no change."""
    if change == "friction":
        return replace(arm, plant={**arm.plant, "friction": FRICTION * arm.plant["friction"]})
    if change == "delay":
        return replace(arm, acting=arm.acting + DELAY_S)
    return replace(arm, load_kg=PAYLOAD_KG) if change == "payload" else arm


def play(path: Path, arm: arms.HiddenArm, robot: Any, policy: Policy, seconds: float, session: int) -> None:
    """Write the log of a session in which a policy's goals pass the gate."""
    gate, goal = SafetyGate(robot.drive.gate(robot.defaults.deploy.gate)), robot.drive.servos.at_rest
    gate.reset(goal)

    def act(reading: Any, k: int) -> np.ndarray:
        nonlocal goal
        goal = gate.apply(policy(k, goal), 0.0, k / RATE_HZ, reading.velocity)
        return goal

    played = arms.play(arm, robot, act, seconds, session)
    commands = [{"goal": np.float32(row)} for row in played.goals]
    write_log(path, "so101", played.times, played.readings, commands, robot.units)


def steps(robot: Any) -> Policy:
    """Return the small steps before a deployment: away from rest and back."""
    rest, each = np.asarray(robot.drive.servos.at_rest, float), round(STEP_S * RATE_HZ)
    away = rest + STEP_RAD * (np.arange(len(rest)) == 0)
    return lambda k, _: away if k // each % 2 else rest


def by_hand(robot: Any, seconds: float, seed: Any) -> Policy:
    """Return the policy written by hand, which moves the goals to random targets."""
    module, rng = sys.modules[type(robot).__module__], np.random.default_rng(seed)
    targets = rng.uniform(module.LOW, module.HIGH, (int(seconds / TARGET_S) + 1, len(module.LOW)))
    fastest = robot.drive.servos.speed

    def policy(k: int, goal: np.ndarray) -> np.ndarray:
        way = targets[int(k / RATE_HZ / TARGET_S)] - goal
        return goal + np.clip(APPROACH_HZ * way, -fastest, fastest) / RATE_HZ

    return policy


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of this bench."""
    parser.add_argument("--runs", type=int, default=12, help="robots, each deployed unchanged and changed")
    parser.add_argument("--first", type=int, default=700, help="number of the first robot")
    parser.add_argument("--changes", nargs="*", default=list(CAUSES), choices=CAUSES, help="changes of each robot")
    parser.add_argument("--record-s", type=float, default=40.0, help="length of the recording [s]")
    parser.add_argument("--seconds", type=float, default=16.0, help="length of an episode [s]")
    parser.add_argument("--episodes", type=int, default=2, help="episodes of a deployment")
    parser.add_argument("--generations", type=int, default=40, help="generations of the search")
    parser.add_argument("--folds", type=int, default=5, help="held-out parts of the identification")
    parser.add_argument("--jobs", type=int, default=1, help="robots at once, one process each; 1: in this process")


def run(options: argparse.Namespace) -> Report:
    """Record, identify, change, deploy and test each robot."""
    outcomes, failed = jobs.robots(one_robot, range(options.first, options.first + options.runs), options)
    lines = rows(outcomes, options.changes)
    lines.append(row("drift/so101/failed", len(failed), f"of {options.runs}", "", "<= 0"))
    if outcomes:
        lines.append(row("drift/so101/robot_cpu_s", np.mean([robot["cpu_s"] for robot in outcomes]), "s"))
    return {"rows": lines, **({"failed": failed} if failed else {})}


def rows(outcomes: list[Row], changes: list[str]) -> list[Row]:
    """Return the shares of verdicts, of right names, and of the tests' alarms, with exact 95 % intervals.

    A change counts as detected if the verdict is "re-identify", by a test of the parameters or by errors beyond the
    expected ones.
    """
    lines = []
    for change in changes:
        results = [robot["changes"][change] for robot in outcomes]
        tested, base = [t for t in results if "alarms" in t], f"drift/so101/{change}"
        unchanged = change == "none"
        counts = {
            "false_alarms" if unchanged else "detected": [t["verdict"] == "re-identify" for t in tested],
            **({} if unchanged else {"named": [CAUSES[change] in (t["named"], t["likely"]) for t in tested]}),
            "by_test": [bool(t["alarms"]) for t in tested],
        }
        goals = {"false_alarms": "<= 0.05", "detected": ">= 0.95", "named": ">= 0.9"}
        for what, happened in counts.items():
            value, low, high = share(sum(happened), len(happened)) if happened else (float("nan"),) * 3
            goal = goals["false_alarms"] if unchanged else goals.get(what, "")
            lines.append(row(f"{base}/{what}", value, f"of {len(happened)}", "", goal))
            lines += [row(f"{base}/{what}/low95", low, ""), row(f"{base}/{what}/high95", high, "")] * bool(happened)
        lines.append(row(f"{base}/not_tested", len(outcomes) - len(tested), f"of {len(outcomes)}"))
    return lines


def one_robot(number: int, options: argparse.Namespace) -> dict[str, Any]:
    """Return the test's results for one robot, unchanged and changed."""
    import sim2real
    from sim2real.artifacts.recording import Recording

    begin, arm, pipeline = time.process_time(), draw(number), load_robot("so101")
    with tempfile.TemporaryDirectory() as folder:
        session = Path(folder) / "session.mcap"
        arms.record(session, arm, pipeline, options.record_s)
        config = replace(pipeline.defaults.identify, seed=number, folds=options.folds, generations=options.generations)
        identified = sim2real.identify(pipeline, [Recording.load(session)], config)
        changes = {c: one_change(arm, c, pipeline, identified, Path(folder), options) for c in options.changes}
    return {"number": number, "cpu_s": time.process_time() - begin, "truth": asdict(arm), "changes": changes}


def one_change(
    arm: arms.HiddenArm, change: str, pipeline: Any, identified: Any, folder: Path, options: argparse.Namespace
) -> dict[str, Any]:
    """Return the test's results for a robot after one change, from a deployment with the small steps."""
    from sim2real.artifacts.deployment import Deployment, EpisodeRow
    from sim2real.artifacts.recording import Recording
    from sim2real.stages.deploy.replay import tested
    from sim2real.stages.deploy.verdict import decide

    now, first = changed(arm, change), 1 + list(CAUSES).index(change) * (options.episodes + 2)
    logs = [folder / f"{change}_{e}.mcap" for e in range(options.episodes + 1)]
    for e, log in enumerate(logs[:-1]):
        play(log, now, pipeline, by_hand(pipeline, options.seconds, [arm.seed, first + e]), options.seconds, first + e)
    play(logs[-1], now, pipeline, steps(pipeline), STEP_S * (STEPS + 1), first + options.episodes)
    try:
        replay, drifted = tested(pipeline, identified, [Recording.load(log).episode for log in logs])
    except Sim2RealError as error:
        return {"refused": str(error)}
    # Of a policy that fails, the verdict is about the model unless the model holds.
    failed = (EpisodeRow({"success": 0.0}),)
    verdict = decide(Deployment(failed, replay=tuple(replay), drift=drifted))
    print(f"robot {arm.seed}, {change}: {drifted.changes[0].name}, alarms {drifted.alarms}", flush=True)
    return {
        "alarms": list(drifted.alarms),
        "named": drifted.named.name if drifted.named else "",
        "likely": drifted.likely.name if drifted.likely else "",
        "verdict": "" if verdict.status == "re-train" else verdict.status,
    }


def table(report: Mapping[str, Any]) -> str:
    """Return the number of robots for which the verdict was to identify again, by change."""
    counts = {r["name"].removeprefix("drift/so101/"): (r["value"], r["unit"]) for r in report["rows"]}
    whats = ["none/false_alarms", *(f"{change}/detected" for change in list(CAUSES)[1:])]
    sound, friction, payload, delay = (
        f"{round(v * int(unit.split()[1]))} {unit}" for v, unit in map(counts.__getitem__, whats)
    )
    return (
        f"The verdict is `re-identify` for {sound} unchanged SO-101s, {friction} with friction doubled, {payload} with "
        f"30 % more payload, and {delay} with 15 ms more delay.\n"
    )
