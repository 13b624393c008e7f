"""Does a deployment's log tell that the robot has changed, and what? Robots that are changed behind a policy's back.

Each is recorded, identified, and deployed: as it was, with twice the friction, with 30 % more to carry, 15 ms later.
Policies are written by hand for the robots as they were; before each deployment come the small steps by which deploy
measures the delay. With --restore what the verdict asks for is done once, unattended, as ``sim2real run`` does it:
identify, from the deployment's own logs where they suffice, else from a new recording; train; deploy.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from scipy.stats import binomtest

from benches import jobs
from benches.drift.arms import ReachingArm, ReachingSO101
from benches.drift.pendulum import Pendulum
from benches.figures import row
from benches.hidden import randomise
from sim2real.errors import Sim2RealError

ROBOTS: dict[str, Any] = {"pendulum": Pendulum, "arm": ReachingArm, "so101": ReachingSO101}
CHANGES = ("none", "friction", "payload", "delay")
QUICK = {"runs": 1, "generations": 5, "record_s": 12.0, "seconds": 5.0, "folds": 0, "trials": 1, "steps": 512,
         "envs": 16}  # fmt: skip


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of this bench."""
    parser.add_argument("--robot", choices=list(ROBOTS), default="pendulum", help="which kind of robot")
    parser.add_argument("--runs", type=int, default=40, help="robots; each is deployed as it was, and changed")
    parser.add_argument("--first", type=int, default=0, help="number of the first of them")
    parser.add_argument("--changes", nargs="*", default=list(CHANGES), choices=CHANGES, help="what is changed")
    parser.add_argument("--record-s", type=float, help="length of the recording [s]; default: the robot's, as below")
    parser.add_argument("--seconds", type=float, help="length of an episode [s]")
    parser.add_argument("--episodes", type=int, help="episodes of a deployment")
    parser.add_argument("--generations", type=int, help="generations of the search")
    parser.add_argument("--folds", type=int, default=5, help="parts that identification leaves out")
    parser.add_argument("--restore", action="store_true", help="do what the verdict asks for, and judge the new policy")
    parser.add_argument("--trials", type=int, default=10, help="deployments of the new policy")
    parser.add_argument("--volts", type=float, default=2.0, help="most that it may command a pendulum")
    parser.add_argument("--steps", type=int, help="policy steps of its training; default: the robot's")
    parser.add_argument("--envs", type=int, help="copies of its training")
    parser.add_argument("--jobs", type=int, default=1, help="robots at once, one process each; 1: in this process")
    parser.add_argument("--within-s", type=float, help="end after this [s]: what was not done is told")


def run(options: argparse.Namespace) -> dict[str, Any]:
    """Record, identify, change, deploy and test each robot."""
    for name, value in ROBOTS[options.robot].defaults.items():
        if getattr(options, name) is None:
            setattr(options, name, value)
    found, failed = jobs.robots(one_robot, range(options.first, options.first + options.runs), options)
    lines = rows(found, options)
    lines.append(row(f"drift/{options.robot}/failed", len(failed), f"of {options.runs}", "", "0"))
    if found:
        spent = sum(robot["cpu_s"] for robot in found) / len(found)
        lines.append(row(f"drift/{options.robot}/robot_cpu_s", spent, "s"))
    return {"rows": lines, "robots": found, "failed": failed}


def rows(found: list[dict[str, Any]], options: argparse.Namespace) -> list[dict[str, Any]]:
    """Return the shares of verdicts and of right names, and of the tests' own alarms, with exact 95 % intervals.

    A robot is said to have changed where the verdict is to identify it again, be it by a test of its parameters or by
    errors beyond what was promised.
    """
    lines, causes = [], ROBOTS[options.robot].causes
    for change in options.changes:
        told = [r["changes"][change] for r in found]
        tested = [t for t in told if "alarms" in t]
        count = lambda holds, tested=tested: (sum(map(holds, tested)), len(tested))  # noqa: E731
        base = f"drift/{options.robot}/{change}"
        again, sure = count(lambda t: t["verdict"] == "re-identify"), count(lambda t: bool(t["alarms"]))
        if change == "none":
            lines += _share(f"{base}/false_alarms", *again, "<= 0.05") + _share(f"{base}/by_test", *sure, "<= 0.05")
        else:
            right = count(lambda t, cause=causes[change]: cause in (t["named"], t["likely"]))
            lines += _share(f"{base}/detected", *again, ">= 0.95") + _share(f"{base}/named", *right, ">= 0.9")
            lines += _share(f"{base}/by_test", *sure, "")
        if after := [s >= randomise.UPRIGHT for t in told for s in t.get("restored", {}).get("success", [])]:
            lines += _share(f"{base}/restored", sum(after), len(after), ">= 0.95")
        lines.append(row(f"{base}/not_tested", len(found) - len(tested), f"of {len(found)}"))
    return lines


def _share(name: str, count: int, of: int, goal: str) -> list[dict[str, Any]]:
    if not of:
        return [row(name, float("nan"), "of 0", "", goal)]
    ends = binomtest(count, of).proportion_ci(method="exact")
    return [row(name, count / of, f"of {of}", "", goal), row(f"{name}/low95", ends.low, ""),
            row(f"{name}/high95", ends.high, "")]  # fmt: skip


def one_robot(number: int, options: argparse.Namespace) -> dict[str, Any]:
    """Return what the test said about one robot, as it was and changed."""
    from sim2real.stages.pipeline.pipeline import load_pipeline

    begin = time.process_time()
    robot, pipeline = ROBOTS[options.robot].draw(number), load_pipeline(options.robot)
    with tempfile.TemporaryDirectory() as folder:
        session = Path(folder) / "session.mcap"
        robot.record(session, options.record_s, 0)
        identified = identify(pipeline, [session], number, options)
        said: dict[str, Any] = {c: {"refused": "not done in time"} for c in options.changes}
        try:
            for c in options.changes:
                said[c] = one_change(robot, c, pipeline, identified, Path(folder), options)
        except Exception as error:  # out of a callback from XLA it comes as one of XLA's
            if jobs.OVER not in str(error):
                raise
    about = {"number": number, "verdict": identified.verdict.status, "widening": identified.widening}
    return {**about, "cpu_s": time.process_time() - begin, "truth": robot.truth, "changes": said}


def one_change(
    robot: Any, change: str, pipeline: Any, identified: Any, folder: Path, options: argparse.Namespace
) -> dict[str, Any]:
    """Return what the test said about a robot after one change."""
    from sim2real.artifacts.recording import Recording
    from sim2real.stages.deploy.verdict import verdict_of
    from sim2real.stages.estimation.replay import tested

    now, first = robot.changed(change), 1 + CHANGES.index(change) * (options.episodes + 2)
    logs = [folder / f"{change}_{e}.mcap" for e in range(options.episodes + 1)]
    success = [now.deploy(log, options.seconds, first + e) for e, log in enumerate(logs[:-1])]
    now.probe(logs[-1], first + options.episodes)
    try:
        replay, drifted = tested(pipeline, identified, [Recording.load(log).episode for log in logs])
    except Sim2RealError as error:
        return {"success": success, "refused": str(error)}
    told = verdict_of(replay, drifted)
    said = {
        "success": success,
        "alarms": list(drifted.alarms),
        "named": drifted.named.name if drifted.named else "",
        "likely": drifted.likely.name if drifted.likely else "",
        "verdict": "" if told is None else told.status,
        "seconds": drifted.seconds,
        "off": {r.name: [r.rmse, r.promised] for r in replay},
        "changes": [vars(c) for c in drifted.changes],
    }
    print(f"robot {robot.number}, {change}: {drifted.changes[0].name}, alarms {drifted.alarms}", flush=True)
    if options.restore and change != "none":
        said["restored"] = restored(now, change, pipeline, identified, drifted, said, logs, options)
    return said


def restored(
    now: Any,
    change: str,
    pipeline: Any,
    identified: Any,
    drifted: Any,
    said: dict[str, Any],
    logs: list[Path],
    options: argparse.Namespace,
) -> dict[str, Any]:
    """Do what a verdict asks for, once, as a run does it; return the new policy's success, or that of the old one.

    Args:
        change: What has changed, for the file's name.
        said: That for the report, with the old policy's success.
    """
    import sim2real
    from sim2real.artifacts.identification import ROUND_TRIP
    from sim2real.commands.loop.retry import MAX_RETRIES, run_with_retries, why_insufficient, with_more_steps
    from sim2real.stages.deploy.next_command import logs_to_identify, terms_to_identify

    if said["verdict"] != "re-identify":
        return {"success": said["success"], "from": "not done"}
    own: list[Path] = []
    if said["named"] != ROUND_TRIP:  # that is refused before the policy moves anything: there is no such log
        own = [Path(log) for log in logs_to_identify(logs, drifted, identified, logs[0].parent)]
    terms = terms_to_identify(pipeline.identify.terms, pipeline, identified, drifted)
    try:
        again = identify(pipeline, own, now.number, options, terms) if own else None
    except Sim2RealError:
        again = None
    if again is None or why_insufficient(again):
        own = [logs[0].with_name(f"{change}_session.mcap")]
        now.record(own[0], options.record_s, 1000)
        again = identify(pipeline, own, now.number, options, terms)
    config, bundle = run_with_retries(
        lambda config: sim2real.train(pipeline, again, config),
        randomise.train_config(pipeline, "all", now.number, options),
        lambda config, bundle: with_more_steps(config, bundle.history),
        MAX_RETRIES["train"],
    )[-1]
    success = now.success(bundle, options)
    print(f"robot {now.number}, {change}: {success} after one iteration from {len(own)} logs", flush=True)
    wider = {p.name: p.upper for p in again.parameters if p.upper != _upper(identified, p.name)}
    found = {"verdict": again.verdict.status, "misfit": again.misfit, "terms": terms, "bounds": wider}
    found |= {"simulated": float(bundle.history.success.max()), "steps": config.ppo.total_steps}
    return {"success": success, "from": [log.name for log in own], **found}


def _upper(found: Any, name: str) -> float | None:
    return next((p.upper for p in found.parameters if p.name == name), None)


def identify(pipeline: Any, logs: list[Path], number: int, options: argparse.Namespace, terms: str = "own") -> Any:
    """Return what logs say about a robot; with wider bounds where an estimate lies at one, as a run does it."""
    import sim2real
    from sim2real.artifacts.recording import Recording
    from sim2real.commands.loop.retry import MAX_RETRIES, run_with_retries, with_wider_bounds

    few = {"folds": options.folds, "generations": options.generations}
    config = replace(pipeline.identify, seed=number, terms=terms, **few)
    recordings = [Recording.load(log) for log in logs]
    tried = run_with_retries(
        lambda c: sim2real.identify(pipeline, recordings, c), config, with_wider_bounds, MAX_RETRIES["identify"]
    )
    return tried[-1][1]
