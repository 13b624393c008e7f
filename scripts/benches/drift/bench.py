"""How often the drift test detects a change of the robot from the logs of a deployment, and names its parameter.

Each robot is recorded, identified, and deployed: unchanged, with twice the friction, with 30 % more payload, and 15 ms
later. Policies are written by hand for the unchanged robots; small steps before each deployment measure the delay. With
--restore the command of the verdict runs once, as ``sim2real run`` does it: identify, from the deployment's own logs if
they suffice, else from a new recording; train; deploy.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from benches import jobs
from benches.drift.arms import ReachingArm, ReachingSO101
from benches.drift.pendulum import Pendulum
from benches.figures import Report, Row, row, share
from benches.hidden import randomise
from sim2real.errors import Sim2RealError

ROBOTS: dict[str, Any] = {"pendulum": Pendulum, "arm": ReachingArm, "so101": ReachingSO101}
CHANGES = ("none", "friction", "payload", "delay")
QUICK = {"runs": 1, "generations": 5, "record_s": 12.0, "seconds": 5.0, "folds": 0, "trials": 1, "steps": 512,
         "envs": 16}  # fmt: skip


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of this bench."""
    parser.add_argument("--robot", choices=list(ROBOTS), default="pendulum", help="which kind of robot")
    parser.add_argument("--runs", type=int, default=40, help="robots, each deployed unchanged and changed")
    parser.add_argument("--first", type=int, default=0, help="number of the first robot")
    parser.add_argument("--changes", nargs="*", default=list(CHANGES), choices=CHANGES, help="changes of each robot")
    parser.add_argument("--record-s", type=float, help="length of the recording [s]; default: the robot's, as below")
    parser.add_argument("--seconds", type=float, help="length of an episode [s]")
    parser.add_argument("--episodes", type=int, help="episodes of a deployment")
    parser.add_argument("--generations", type=int, help="generations of the search")
    parser.add_argument("--folds", type=int, default=5, help="held-out parts of the identification")
    parser.add_argument("--restore", action="store_true", help="run the command of the verdict, test the new policy")
    parser.add_argument("--trials", type=int, default=10, help="deployments of the new policy")
    parser.add_argument("--volts", type=float, default=2.0, help="largest command of a pendulum")
    parser.add_argument("--steps", type=int, help="policy steps of its training; default: the robot's")
    parser.add_argument("--envs", type=int, help="copies of its training")
    parser.add_argument("--jobs", type=int, default=1, help="robots at once, one process each; 1: in this process")
    parser.add_argument(
        "--within-s", type=float, help="end after this time [s]; the rows count robots that are not done"
    )


def run(options: argparse.Namespace) -> Report:
    """Record, identify, change, deploy and test each robot."""
    for name, value in ROBOTS[options.robot].defaults.items():
        if getattr(options, name) is None:
            setattr(options, name, value)
    outcomes, failed = jobs.robots(one_robot, range(options.first, options.first + options.runs), options)
    lines = rows(outcomes, options)
    lines.append(row(f"drift/{options.robot}/failed", len(failed), f"of {options.runs}", "", "0"))
    if outcomes:
        spent = sum(robot["cpu_s"] for robot in outcomes) / len(outcomes)
        lines.append(row(f"drift/{options.robot}/robot_cpu_s", spent, "s"))
    return {"rows": lines, "robots": outcomes, "failed": failed}


def rows(outcomes: list[Row], options: argparse.Namespace) -> list[Row]:
    """Return the shares of verdicts, of right names, and of the tests' alarms, with exact 95 % intervals.

    A change counts as detected if the verdict is "re-identify", by a test of the parameters or by errors beyond the
    promised ones.
    """
    lines, causes = [], ROBOTS[options.robot].causes
    for change in options.changes:
        results = [r["changes"][change] for r in outcomes]
        tested = [t for t in results if "alarms" in t]
        count = lambda holds, tested=tested: (sum(map(holds, tested)), len(tested))  # noqa: E731
        base = f"drift/{options.robot}/{change}"
        detected, alarms = count(lambda t: t["verdict"] == "re-identify"), count(lambda t: bool(t["alarms"]))
        if change == "none":
            lines += _share(f"{base}/false_alarms", *detected, "<= 0.05")
            lines += _share(f"{base}/by_test", *alarms, "<= 0.05")
        else:
            right = count(lambda t, cause=causes[change]: cause in (t["named"], t["likely"]))
            lines += _share(f"{base}/detected", *detected, ">= 0.95")
            lines += _share(f"{base}/named", *right, ">= 0.9")
            lines += _share(f"{base}/by_test", *alarms, "")
        if after := [s >= randomise.UPRIGHT for t in results for s in t.get("restored", {}).get("success", [])]:
            lines += _share(f"{base}/restored", sum(after), len(after), ">= 0.95")
        lines.append(row(f"{base}/not_tested", len(outcomes) - len(tested), f"of {len(outcomes)}"))
    return lines


def _share(name: str, count: int, trials: int, goal: str) -> list[Row]:
    value, low, high = share(count, trials) if trials else (float("nan"),) * 3
    rows = [row(name, value, f"of {trials}", "", goal)]
    return [*rows, row(f"{name}/low95", low, ""), row(f"{name}/high95", high, "")] if trials else rows


def one_robot(number: int, options: argparse.Namespace) -> dict[str, Any]:
    """Return the test's results for one robot, unchanged and changed."""
    from sim2real.stages.pipeline.pipeline import load_pipeline

    begin = time.process_time()
    robot, pipeline = ROBOTS[options.robot].draw(number), load_pipeline(options.robot)
    with tempfile.TemporaryDirectory() as folder:
        session = Path(folder) / "session.mcap"
        robot.record(session, options.record_s, 0)
        identified = identify(pipeline, [session], number, options)
        results: dict[str, Any] = {c: {"refused": "not done in time"} for c in options.changes}
        try:
            for c in options.changes:
                results[c] = one_change(robot, c, pipeline, identified, Path(folder), options)
        except Exception as error:  # XLA wraps an error that a callback raises
            if jobs.OVER not in str(error):
                raise
    about = {"number": number, "verdict": identified.verdict.status, "widening": identified.widening}
    return {**about, "cpu_s": time.process_time() - begin, "truth": robot.truth, "changes": results}


def one_change(
    robot: Any, change: str, pipeline: Any, identified: Any, folder: Path, options: argparse.Namespace
) -> dict[str, Any]:
    """Return the test's results for a robot after one change."""
    # Deploy the changed robot, with the small steps that measure the delay.
    from sim2real.artifacts.recording import Recording
    from sim2real.stages.deploy.verdict import model_advice
    from sim2real.stages.estimation.replay import tested

    now, first = robot.changed(change), 1 + CHANGES.index(change) * (options.episodes + 2)
    logs = [folder / f"{change}_{e}.mcap" for e in range(options.episodes + 1)]
    success = [now.deploy(log, options.seconds, first + e) for e, log in enumerate(logs[:-1])]
    now.probe(logs[-1], first + options.episodes)
    try:
        replay, drifted = tested(pipeline, identified, [Recording.load(log).episode for log in logs])
    except Sim2RealError as error:
        return {"success": success, "refused": str(error)}
    verdict = model_advice(replay, drifted)
    result = {
        "success": success,
        "alarms": list(drifted.alarms),
        "named": drifted.named.name if drifted.named else "",
        "likely": drifted.likely.name if drifted.likely else "",
        "verdict": "" if verdict is None else verdict.status,
        "seconds": drifted.seconds,
        "off": {r.name: [r.rmse, r.promised] for r in replay},
        "changes": [vars(c) for c in drifted.changes],
    }
    print(f"robot {robot.number}, {change}: {drifted.changes[0].name}, alarms {drifted.alarms}", flush=True)
    if options.restore and change != "none":
        result["restored"] = restored(now, change, pipeline, identified, drifted, result, logs, options)
    return result


def restored(
    now: Any,
    change: str,
    pipeline: Any,
    identified: Any,
    drifted: Any,
    result: dict[str, Any],
    logs: list[Path],
    options: argparse.Namespace,
) -> dict[str, Any]:
    """Run the command of a verdict once, as a run does it; return the new policy's success, or that of the old one.

    Args:
        change: Name of the change, for the file's name.
        result: Results for the report, with the old policy's success.
    """
    import sim2real
    from sim2real.artifacts.identification import ROUND_TRIP
    from sim2real.commands.loop.retry import MAX_RETRIES, run_with_retries, why_insufficient, with_more_steps
    from sim2real.stages.deploy.next_command import logs_to_identify, terms_to_identify

    if result["verdict"] != "re-identify":
        return {"success": result["success"], "from": "not done"}
    recordings: list[Path] = []
    if result["named"] != ROUND_TRIP:  # that is refused before the policy moves anything: there is no such log
        recordings = [Path(log) for log in logs_to_identify(logs, drifted, identified, logs[0].parent)]
    terms = terms_to_identify(pipeline.identify.terms, pipeline, identified, drifted)
    try:
        again = identify(pipeline, recordings, now.number, options, terms) if recordings else None
    except Sim2RealError:
        again = None
    if again is None or why_insufficient(again):
        recordings = [logs[0].with_name(f"{change}_session.mcap")]
        now.record(recordings[0], options.record_s, 1000)
        again = identify(pipeline, recordings, now.number, options, terms)
    config, bundle = run_with_retries(
        lambda config: sim2real.train(pipeline, again, config),
        randomise.train_config(pipeline, "all", now.number, options),
        lambda config, bundle: with_more_steps(config, bundle.history),
        MAX_RETRIES["train"],
    )[-1]
    success = now.success(bundle, options)
    print(f"robot {now.number}, {change}: {success} after one iteration from {len(recordings)} logs", flush=True)
    wider = {p.name: p.upper for p in again.parameters if p.upper != _upper(identified, p.name)}
    summary = {"verdict": again.verdict.status, "misfit": again.misfit, "terms": terms, "bounds": wider}
    summary |= {"simulated": float(bundle.history.success.max()), "steps": config.ppo.total_steps}
    return {"success": success, "from": [log.name for log in recordings], **summary}


def _upper(identified: Any, name: str) -> float | None:
    return next((p.upper for p in identified.parameters if p.name == name), None)


def identify(pipeline: Any, logs: list[Path], number: int, options: argparse.Namespace, terms: str = "own") -> Any:
    """Return the identification of a robot, with wider bounds for an estimate at a bound, as a run does it."""
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
