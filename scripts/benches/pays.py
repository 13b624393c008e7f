"""What identification is worth to a policy: four ways to train with one budget, judged on the same hidden robots.

    python scripts/bench.py pays --robots arm so101 --jobs 16 --work runs/pays --json reports/pays.json

``data_sheet``: nominal values, no delays. ``wide``: the ranges that an expert would choose, in the report. ``point``:
identified values and delays. ``posterior``: the same, drawn from their posterior, with model error, timing and noise.

Each seed has a unit of its own: drawn parameters and delays. It is recorded and identified once, and a policy of each
way is trained with that seed. All four are judged on the unit on several days, each with a load, jitter and pauses of
the computer of its own, and with the same aims. Loads are drawn from the same range by all ways.

The judge is C MuJoCo with the emulation's servos, on a clock of its own; no code of the training moves it. Every result
is a file in the folder of --work, and what is there is not computed again: the same command continues. Rows compare the
seeds whose trainings of all ways are in the folder; a task without such a seed has no figures.

    python scripts/bench.py pays --minutes 0 --work runs/pays --measured there.json --commit HASH --json pays.json

computes a report from results of another machine, whose own report ``there.json`` names that machine.
"""

from __future__ import annotations

import argparse
import json
import shlex
import sys
import tempfile
import time
import traceback
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from benches.hidden import arms, legs, randomise
from benches.hidden import robots as pendulums
from benches.jobs import Work, each
from benches.rows import Report, Row, four_digits, markdown, row, share, values
from benches.walk import EVERY_S
from benches.walking.delays import WIDE_MS
from benches.walking.train import require_gpu, train

NOMINAL, IDENTIFIED = ("data_sheet", "wide"), ("point", "posterior")
WAYS = {
    "data_sheet": "data sheet, no delays",
    "wide": "wide ranges, with delays",
    "point": "identified, one model",
    "posterior": "identified, posterior and timing",
}
LOAD = {"payload": (0.0, arms.MOST_KG)}
FACTORS: dict[str, dict[str, tuple[float, float]]] = {
    "pendulum": dict.fromkeys(("gain", "gravity", "damping", "friction"), (0.7, 1.3)),
    "arm": {"gain": (0.7, 1.3), "damping": (0.5, 2.0), "armature": (0.5, 2.0), "friction": (0.5, 3.0)},
    "so101": {
        "gain": (0.7, 1.3),
        "damping": (0.5, 2.0),
        "armature": (0.5, 2.0),
        "friction": (0.3, 4.0),
        "stribeck": (0.4, 2.0),
        "saturation": (0.3, 1.2),
    },
}
"""What ``wide`` draws: factors on the data sheet's values, by the beginning of a parameter's name."""
DELAYS = {"sensor_delay": (0.002, 0.02), "actuator_delay": (0.002, 0.04)}
"""And delays [s]; those of the pendulum reach to 60 ms together, those of all hidden robots lie within."""


@dataclass(frozen=True)
class Case:
    """A robot of the bench.

    Attributes:
        tasks: Its tasks.
        days: On how many days each unit is judged.
        trials: Deployments on each day.
        seconds: Length of a deployment [s].
        record_s: Length of the recording [s].
        steps: Task -> policy steps of a training.
        ppo: Settings of PPO that differ from the robot's, of all ways.
    """

    tasks: tuple[str, ...]
    days: int
    trials: int
    seconds: float
    record_s: float
    steps: Mapping[str, int]
    ppo: Mapping[str, float]


# Goals move up to three times as fast as in reaching: with the usual exploration the tip never comes within 1 cm.
CALMER = {"learning_rate": 1.5e-3, "log_std_init": -1.5}
CASES = {
    "pendulum": Case(("swing_up",), 1, 10, 8.0, 40.0, {"swing_up": 3_000_000}, {}),
    # With 1.5 million steps three of five trainings on the arm's posterior were at their beginning: success 5 to 80 %;
    # of the fast task nine of twenty ended below 75 %, data sheet and all others alike.
    "arm": Case(("follow", "fast"), 4, 3, 4.0, 40.0, {"follow": 3_000_000, "fast": 3_000_000}, CALMER),
    "so101": Case(("follow", "fast"), 4, 3, 4.0, 40.0, {"follow": 1_500_000, "fast": 1_500_000}, CALMER),
    "go2": Case(("walk",), 4, 1, 20.0, 12.0, {"walk": 60_000_000}, {}),
}
PUSH_M_S = 0.5
"""Push of a Go2 every 5 s [m/s]; its commanded velocity changes every 2.5 s."""
FIGURES = {
    "swing_up": (),
    "follow": (("error_m", 1e3, "error_mm", "mm"),),
    "fast": (("settled_s", 1.0, "settled_s", "s"), ("overshoot_m", 1e3, "overshoot_mm", "mm")),
    "walk": (("error_m_s", 1.0, "error_m_s", "m/s"), ("error_rad_s", 1.0, "error_rad_s", "rad/s")),
}
"""Task -> figures of a deployment beside success and energy: key, factor, name of the row, unit."""
GOALS = {"follow": ("error_m", "<= 0.75"), "fast": ("settled_s", "<= 0.8"), "walk": ("error_m_s", "<= 0.8")}
"""Task -> the figure of ``posterior`` over the better one of ``data_sheet`` and ``wide``, and its goal."""
_ONE = dict.fromkeys(("units", "days", "trials"), 1)
QUICK = {"robots": ["pendulum"], "tasks": ["swing_up"], "ways": ["data_sheet"], "steps": 512, "envs": 16, **_ONE}


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of this bench."""
    parser.add_argument("--robots", nargs="+", default=["arm", "so101"], choices=list(CASES), help="robots")
    parser.add_argument("--tasks", nargs="+", choices=list(FIGURES), help="tasks; default: all of each robot")
    parser.add_argument("--ways", nargs="+", default=list(WAYS), choices=list(WAYS), help="ways to train")
    parser.add_argument("--seeds", "--units", dest="units", type=int, default=5, help="units: one seed each")
    parser.add_argument("--first", type=int, default=0, help="number of the first unit")
    parser.add_argument("--days", type=int, help="days on which a unit is judged; default: 4, of a pendulum 1")
    parser.add_argument("--trials", type=int, help="deployments a day; default: 3, of a pendulum 10")
    parser.add_argument("--steps", type=int, help="policy steps of each training; default: the robot's own")
    parser.add_argument("--envs", type=int, default=256, help="copies of a training")
    usual = "--ppo.num-envs=8192 --ppo.rollout-steps=12 --ppo.minibatches=8 --ppo.evaluations=1"
    parser.add_argument("--flags", default=usual, help="flags of `sim2real train go2`, in one word")
    parser.add_argument("--work", type=Path, help="folder of the results; what is in it is used again")
    parser.add_argument("--minutes", type=float, default=1e6, help="time after which nothing new is begun")
    parser.add_argument("--jobs", type=int, default=1, help="trainings at once, one processor each")
    parser.add_argument("--measured", type=Path, help="report of the machine on which the folder's results were made")


def run(options: argparse.Namespace) -> Report:
    """Identify all units, train and judge what is missing, and return the figures of all results in the folder."""
    with tempfile.TemporaryDirectory() as scratch:
        options.folder = options.work or Path(scratch)
        options.until = time.time() + 60.0 * options.minutes
        jobs = [
            (name, task, way, unit)
            for name in options.robots
            for task in CASES[name].tasks
            if task in (options.tasks or FIGURES)
            for unit in range(options.first, options.first + options.units)
            for way in options.ways
        ]
        jobs = [job for job in jobs if not _file(options, *job).is_file()]
        needed = dict.fromkeys((name, unit) for name, _, way, unit in jobs if way in IDENTIFIED)
        missing = [unit for unit in needed if not (_model(options, *unit) / "parameters.json").is_file()]
        # A Go2 trains on the GPU: one after the other.
        alone = argparse.Namespace(**{**vars(options), "jobs": 1})
        walking, others = ([job for job in jobs if (job[0] == "go2") is walks] for walks in (True, False))
        for work, tasks, how in (
            (identify, missing, options),
            (train_and_judge, others, options),
            (train_to_walk, walking, alone),
        ):
            for i, done in each(partial(_tried, work), tasks, how):
                print(*tasks[i], done.get("failed", done.get("about", "")), flush=True)
        results = [json.loads(file.read_text()) for file in sorted(options.folder.glob("*.json"))]
        models = [json.loads(file.read_text()) for file in sorted(options.folder.glob("*/about.json"))]
    del options.folder, options.until
    ranges = {name: wide_ranges(name) for name in options.robots}
    there = json.loads(options.measured.read_text()) if options.measured else {}
    about = {n: there[n] for n in ("date", "machine", "versions") if n in there}
    return {**about, "rows": rows(results, options), "ranges": ranges, "models": models, "results": results}


def _tried(work: Work, *task: Any) -> dict[str, Any]:
    try:
        return work(*task)
    except Exception as error:  # the other results must not be lost
        print(traceback.format_exc(), file=sys.stderr, flush=True)
        return {"failed": f"{type(error).__name__}: {error}"}


def _time_is_up(name: str, options: argparse.Namespace) -> bool:
    """Return whether a training as long as the longest of this robot would end too late."""
    took = [json.loads(f.read_text())["train_s"] for f in options.folder.glob(f"{name}-*.json")]
    return time.time() + max(took, default=0.0) > options.until


def _file(options: argparse.Namespace, *job: Any) -> Path:
    return options.folder / f"{'-'.join(map(str, job))}.json"


def _model(options: argparse.Namespace, name: str, unit: int) -> Path:
    return options.folder / f"{name}-{unit}"


def identify(name: str, unit: int, options: argparse.Namespace) -> dict[str, Any]:
    """Record a unit without a load, identify it, and write the identification into the folder."""
    import sim2real
    from sim2real.artifacts.recording import Recording
    from sim2real.stages.load import load_robot

    if time.time() > options.until:
        return {"about": "not begun: the time is up"}
    begin, robot, case = time.perf_counter(), load_robot(name), CASES[name]
    folder = _model(options, name, unit)
    folder.mkdir(parents=True, exist_ok=True)
    log = folder / "session.mcap"
    log.unlink(missing_ok=True)
    if name == "pendulum":
        excited = pendulums.excited(case.record_s, unit)
        pendulums.write(log, pendulums.play(_pendulum(unit), excited, case.record_s, 0))
    elif name == "go2":
        hidden = _twin(unit, 0)
        legs.record(log, unit, case.record_s, (hidden.sensing_s, hidden.acting_s, 5e-4))
    else:
        arms.record(log, arms.HiddenArm.draw(name, unit, 0), robot, case.record_s)
    config = replace(robot.defaults.identify, folds=0, seed=unit)
    found = sim2real.identify(robot, Recording.load(log), config)
    about = {
        "robot": name,
        "unit": unit,
        "verdict": found.verdict.status,
        "values": {n: four_digits(v) for n, v in found.values.items()},
        "identify_s": round(time.perf_counter() - begin, 1),
        "hidden": _hidden(name, unit),
    }
    found.save(folder)
    (folder / "about.json").write_text(json.dumps(about))
    return {"about": f"{about['verdict']}, {about['identify_s']} s"}


def _pendulum(unit: int) -> pendulums.Hidden:
    return pendulums.Hidden.draw(unit, randomise.WEAR)


def _hidden(name: str, unit: int) -> dict[str, Any]:
    if name == "pendulum":
        robot = _pendulum(unit)
        return {"round_trip_s": four_digits(robot.sensing + robot.acting)}
    if name == "go2":
        twin = _twin(unit, 0)
        return {"round_trip_s": four_digits(twin.sensing_s + twin.acting_s)}
    arm = arms.HiddenArm.draw(name, unit, 0)
    plant = {n: np.round(v, 4).tolist() for n, v in arm.plant.items()}
    return {"round_trip_s": four_digits(arm.sensing + arm.acting), **plant}


def wide_ranges(name: str) -> dict[str, tuple[float, float]]:
    """Return the ranges of the way ``wide``: parameter -> lowest and highest value."""
    from sim2real.stages.load import load_robot

    robot: Any = load_robot(name)
    if name == "go2":
        return {**robot.defaults.train.vary.range, **{n: (low / 1e3, high / 1e3) for n, (low, high) in WIDE_MS.items()}}
    factors = {n: f for n in robot.nominal() for start, f in FACTORS[name].items() if n.startswith(start)}
    ranges = {n: tuple(four_digits(robot.nominal()[n] * f) for f in ends) for n, ends in factors.items()}
    return {**ranges, **DELAYS, **({} if name == "pendulum" else LOAD)}


def train_config(robot: Any, task: str, way: str, seed: int, options: argparse.Namespace) -> Any:
    """Return the settings of a training: the robot's own but for what the way draws."""
    usual = robot.defaults.train
    load = {} if robot.name == "pendulum" else LOAD
    vary = {
        "data_sheet": {"range": load},
        "wide": {"range": wide_ranges(robot.name)},
        "point": {"range": load, "noise": 0.0, "pauses": False},
        "posterior": {"range": load},
    }[way]
    few = {"minibatches": 2, "evaluations": 1} if options.envs < usual.ppo.minibatches else {}
    case = CASES[robot.name]
    return replace(
        usual,
        model="nominal" if way in NOMINAL else "identified",
        randomise=0.0 if way == "point" else 1.0,
        seed=seed,
        force=True,
        sensitivity=False,
        vary=replace(usual.vary, **vary),
        ppo=replace(
            usual.ppo, total_steps=options.steps or case.steps[task], num_envs=options.envs, **{**case.ppo, **few}
        ),
    )


def train_and_judge(name: str, task: str, way: str, unit: int, options: argparse.Namespace) -> dict[str, Any]:
    """Train a policy, judge it on the unit's days, and write the results into the folder."""
    import sim2real
    from benches.hidden.targets import tasked
    from sim2real.artifacts.identification import Identification
    from sim2real.stages.load import load_robot

    if _time_is_up(name, options):
        return {"about": "not begun: the time is up"}
    robot: Any = load_robot(name)
    robot = robot if name == "pendulum" else tasked(robot, task)
    model = Identification.load(_model(options, name, unit)) if way in IDENTIFIED else None
    begin = time.perf_counter()
    bundle = sim2real.train(robot, model, train_config(robot, task, way, unit, options))
    train_s = time.perf_counter() - begin
    trials = _judged(name, task, robot, bundle, unit, options)
    in_simulation = np.round(np.asarray(bundle.history.success).max(axis=1), 3).tolist() if bundle.history else []
    return _kept((name, task, way, unit), train_s, trials, options, in_simulation=in_simulation)


def train_to_walk(name: str, task: str, way: str, unit: int, options: argparse.Namespace) -> dict[str, Any]:
    """Train a Go2 by its command, judge the policy on the unit's days, and write the results into the folder."""
    from sim2real.stages.load import load_robot

    if _time_is_up(name, options):
        return {"about": "not begun: the time is up"}
    require_gpu("pays")
    robot: Any = load_robot(name)
    model = _model(options, name, unit) / "parameters.json"
    named = ["--model", "identified", "--parameters", str(model), "--force"]
    ranges = wide_ranges(name) if way == "wide" else {}
    if way == "data_sheet":  # load and floor are the task's
        usual = {n: v for n, v in robot.nominal().items() if n in wide_ranges(name)} | dict.fromkeys(WIDE_MS, 0.0)
        ranges = {n: (v, v + 1e-6) for n, v in usual.items() if n not in ("payload", "foot_friction")}
    flags = [*shlex.split(options.flags), "--seed", str(unit), *(named if way in IDENTIFIED else ())]
    flags += ["--randomise", "0", "--vary.no-pauses"] if way == "point" else []
    flags += [word for n, (low, high) in ranges.items() for word in ("--vary.range", n, f"{low:.7f}", f"{high:.7f}")]
    begin = time.perf_counter()
    with tempfile.TemporaryDirectory() as runs:
        done = train(options.steps or CASES[name].steps[task], flags, Path(runs), {})
        train_s = time.perf_counter() - begin
        trials = [
            {"day": day, "trial": 0, **_walked(robot, done.folder / "bundle", unit, day)}
            for day in range(options.days or CASES[name].days)
        ]
    flags = [flag.replace(f"{options.folder}/", "") for flag in flags]
    return _kept((name, task, way, unit), train_s, trials, options, flags=flags)


def _twin(unit: int, day: int) -> Any:
    """Return the hidden parameters of a Go2, 12 to 42 ms late, and of a day: load and floor."""
    from sim2real.emulation.body import HiddenTwin

    rng, today = np.random.default_rng([20261129, unit]), np.random.default_rng([20261129, unit, 1 + day])
    total_s = rng.uniform(0.012, 0.042)
    return replace(
        HiddenTwin.draw(np.random.default_rng([unit, 2]), 12),  # as the emulator draws the robot of a number
        sensing_s=total_s / 3,
        acting_s=total_s / 1.5,
        load_kg=today.uniform(-1.0, 2.5),
        friction=today.uniform(0.4, 1.3),
    )


def _walked(robot: Any, bundle: Path, unit: int, day: int) -> dict[str, float]:
    """Return the figures of a walk with velocity steps and pushes."""
    from sim2real.policy.bundle import load_bundle
    from sim2real.robots.walking.twin import Twin, walk

    rng, seconds, most = np.random.default_rng([unit, day]), CASES["go2"].seconds, robot.commands.most
    commands = rng.uniform(-1.0, 1.0, (int(seconds / EVERY_S) + 1, 3)) * most
    twin = Twin(robot, _twin(unit, day), 100 * unit + day)
    walked = walk(
        twin, load_bundle(bundle), lambda t_s: commands[int(t_s / EVERY_S + 1e-6)], seconds, push_m_s=PUSH_M_S
    )
    lasted_s = seconds if walked.fell_s is None else walked.fell_s
    return {
        "success": float(walked.fell_s is None),
        "error_m_s": walked.error_m_s,
        "error_rad_s": walked.error_rad_s,
        "energy_j": twin.energy_j * seconds / max(lasted_s, 0.1),
    }


def _kept(
    job: tuple[Any, ...], train_s: float, trials: list[dict[str, float]], options: argparse.Namespace, **more: Any
) -> dict[str, Any]:
    """Write the results of a training into the folder, and return them in words."""
    result = {
        **dict(zip(("robot", "task", "way", "unit"), job, strict=True)),
        "train_s": round(train_s, 1),
        **more,
        "trials": [{n: four_digits(v) for n, v in trial.items()} for trial in trials],
    }
    file = _file(options, *job)
    partly = file.with_suffix(".part")
    partly.write_text(json.dumps(result))
    partly.rename(file)
    means = {n: float(np.nanmean([t[n] for t in trials])) for n in trials[0] if n not in ("day", "trial")}
    return {"about": f"{train_s:.0f} s " + ", ".join(f"{n} {v:.4g}" for n, v in means.items())}


def _judged(
    name: str, task: str, robot: Any, bundle: Any, unit: int, options: argparse.Namespace
) -> list[dict[str, float]]:
    """Return the figures of all deployments of a policy."""
    from sim2real.policy.bundle import make_runner

    case = CASES[name]
    results = []
    for day in range(options.days or case.days):
        for trial in range(options.trials or case.trials):
            if name == "pendulum":
                wear = argparse.Namespace(volts=2.0, seconds=case.seconds)
                session = 1 + 100 * day + trial
                up = randomise.upright(*randomise.played(_pendulum(unit), bundle, wear, session), np.inf)
                figures = {"success": float(up >= randomise.UPRIGHT)}
            else:
                runner = make_runner(bundle.weights, bundle.contract, None, bundle.spec, bundle.graph)
                arm = arms.HiddenArm.draw(name, unit, day)
                number = 10 * day + trial
                act = arms.agent(robot, runner, number)
                figures = arms.judge(arm, robot, task, act, number, case.seconds)
            results.append({"day": day, "trial": trial, **figures})
    return results


# -- the report


SHOWN = {
    ("pendulum", "swing_up"): ("Pendulum, swing up: success", "success", 100.0, "%"),
    ("arm", "follow"): ("Arm, figure of eight: error", "error_m", 1e3, "mm"),
    ("arm", "fast"): ("Arm, time to stay within 1 cm", "settled_s", 1.0, "s"),
    ("so101", "follow"): ("SO-101, figure of eight: error", "error_m", 1e3, "mm"),
    ("so101", "fast"): ("SO-101, time to stay within 1 cm", "settled_s", 1.0, "s"),
    ("go2", "walk"): ("Go2, pushed: error of the velocity", "error_m_s", 1.0, "m/s"),
}
"""Robot and task -> what tables and the figure show: label, figure of a deployment, factor, unit."""
UNLEARNT = 0.1
"""A training whose best seed succeeds less often than this at its end, in its own simulation, has not learnt."""
Results = list[dict[str, Any]]


def rows(results: Results, options: argparse.Namespace) -> list[Row]:
    """Return the figures of each robot, task and way; each is a mean over the seeds' means, with the seeds' ends."""
    lines = []
    for name, task in dict.fromkeys((r["robot"], r["task"]) for r in results):
        these = [r for r in results if (r["robot"], r["task"]) == (name, task)]
        trained = ", ".join(f"{way} {sum(r['way'] == way for r in these)}" for way in options.ways)
        of = common(these, options.ways)
        seeds = sorted({r["unit"] for r in of})
        about = f"seeds {', '.join(map(str, seeds)) or 'none'}; trained: {trained}"
        lines.append(row(f"pays/{name}/{task}/seeds", len(seeds), f"of {options.units}", about, "all"))
        for way in options.ways if seeds else ():
            lines += _rows_of_a_way(f"pays/{name}/{task}/{way}", task, [r for r in of if r["way"] == way])
        if task in GOALS and seeds:
            lines += ratio(f"pays/{name}/{task}", of, *GOALS[task])
    return lines


def _rows_of_a_way(prefix: str, task: str, found: Results) -> list[Row]:
    lines = []
    good = [t["success"] for r in found for t in r["trials"]]
    if task == "follow":  # a share of the time, not of the deployments
        lines.append(row(f"{prefix}/success", four_digits(float(np.mean(good))), "share of the time"))
    else:
        value, low, high = share(round(sum(good)), len(good))
        about = f"95 %: {low:.3f} to {high:.3f}"
        lines.append(row(f"{prefix}/success", four_digits(value), f"of {len(good)} deployments", about))
    energy = (("energy_j", 1.0, "energy_j", "J"),) * ("energy_j" in found[0]["trials"][0])
    for key, factor, label, unit in (*FIGURES[task], *energy):
        means = [factor * mean_of(r, key) for r in found]
        ends = f"{len(means)} seeds: {min(means):.4g} to {max(means):.4g}"
        lines.append(row(f"{prefix}/{label}", four_digits(float(np.mean(means))), unit, ends))
    lines.append(row(f"{prefix}/train_s", four_digits(float(np.mean([r["train_s"] for r in found]))), "s"))
    return lines


def common(results: Results, ways: Iterable[str]) -> Results:
    """Return the results of those seeds of a task that were trained in all ways."""
    by_way = [{r["unit"] for r in results if r["way"] == way} for way in ways]
    seeds = set.intersection(*by_way) if by_way else set()
    return [r for r in results if r["unit"] in seeds]


def mean_of(result: Mapping[str, Any], key: str) -> float:
    """Return the mean of a figure over a policy's deployments, without those that have none."""
    return float(np.nanmean([np.nan if t[key] is None else t[key] for t in result["trials"]]))


def ratio(prefix: str, results: Results, key: str, goal: str) -> list[Row]:
    """Return the figure of ``posterior`` over that of the better one of ``data_sheet`` and ``wide``."""
    means = {way: {r["unit"]: mean_of(r, key) for r in results if r["way"] == way} for way in WAYS}
    others = {way: float(np.mean(list(means[way].values()))) for way in NOMINAL if means[way]}
    ours = means["posterior"]
    if not ours or not others:
        return []
    best = min(others, key=lambda way: others[way])
    value = float(np.mean(list(ours.values()))) / others[best]
    by_seed = [ours[unit] / means[best][unit] for unit in sorted(ours)]
    better = sum(r < 1.0 for r in by_seed)
    about = f"over {best}; better with {better} of {len(by_seed)} seeds, {min(by_seed):.2f} to {max(by_seed):.2f}"
    return [row(f"{prefix}/identified_over_best", four_digits(value), "", about, goal)]


def _compared(report: Report) -> dict[tuple[str, str], dict[str, Results]]:
    """Return the results that are compared: robot and task -> way -> results."""
    ways = report["flags"]["ways"]
    found = {}
    for of in SHOWN:
        these = common([r for r in report["results"] if (r["robot"], r["task"]) == of], ways)
        found[of] = {way: [r for r in these if r["way"] == way] for way in ways}
    return {of: by_way for of, by_way in found.items() if all(by_way.values())}


def table(report: Report) -> str:
    """Return the table: a row for each robot and task, the four ways, and identification over the better of others."""
    found, lines = values(report, "pays/"), []
    compared = _compared(report)
    for (name, task), by_way in compared.items():
        label, key, factor, unit = SHOWN[name, task]
        cells = []
        for way in WAYS:
            means = [factor * mean_of(r, key) for r in by_way.get(way, ())]
            ends = f"{min(means):.3g} to {max(means):.3g}" if means else ""
            cells.append(f"{np.mean(means):.3g} {unit} ({ends})" if means else "")
        over = found.get(f"{name}/{task}/identified_over_best")
        cells.append("" if over is None else f"{over:.2f}, goal {GOALS[task][1]}")
        lines.append((label, f"{found[f'{name}/{task}/seeds']} of {report['flags']['units']}", *cells))
    head = ("hidden robots", "seeds", *WAYS.values(), "the last over the better of the first two")
    text = markdown(head, lines)
    if missing := [SHOWN[of][0] for of in SHOWN if of not in compared and f"{'/'.join(of)}/seeds" in found]:
        text += f"\nNo seed was trained in all ways in the time that there was: {'; '.join(missing)}.\n"
    return text


def unlearnt(result: Mapping[str, Any]) -> bool:
    """Return whether a training had not learnt its task at its end."""
    last = result.get("in_simulation", [])[-1:]
    return bool(last) and last[0] < UNLEARNT


def figure(report: Report) -> Figure:
    """Return README's figure: the mean of each robot, task and way, and the single seeds."""
    compared = _compared(report)
    drawn = Figure((5.2, 0.5 + 1.25 * len(compared)), layout="constrained")  # readable at the width of a telephone
    for axes, (of, by_way) in zip(drawn.subplots(len(compared), squeeze=False)[:, 0], compared.items(), strict=True):
        label, key, factor, unit = SHOWN[of]
        for i, (way, found) in enumerate(by_way.items()):
            means = [factor * mean_of(r, key) for r in found]
            color = "C0" if way in IDENTIFIED else "0.65"
            axes.barh(i, np.mean(means), 0.7, color=color, alpha=0.6)
            for value, result in zip(means, found, strict=True):
                axes.plot(value, i, "o", ms=4, color="black", mfc="white" if unlearnt(result) else "black")
            mean = f"{np.mean(means):#.2g}".rstrip(".")
            axes.text(1.02, i, f"{mean} {unit}", transform=axes.get_yaxis_transform(), va="center")
        axes.set_yticks(range(len(by_way)), [WAYS[way] for way in by_way])
        axes.set(xlim=(0, None))
        axes.set_title(f"{label}, {len(next(iter(by_way.values())))} robots", loc="left", fontsize=9)
        axes.invert_yaxis()
        axes.spines[["top", "right"]].set_visible(False)
    return drawn
