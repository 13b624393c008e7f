"""Identification on recordings of real motors: fitted on one part, judged on another.

    python scripts/bench.py identify --data DIR --case disk --fit :25000 --test 25000:30000

Beside our model stand: hold (nothing moves), told (each joint is where it was told to be), the same model without
delay, and mujoco.sysid on the same split in the same run.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import numpy as np

from benches import figures, recordings
from benches.recordings import PAST, SPECS
from sim2real.graph.episode import Episode
from sim2real.identify.fit import Fit, as_numbers, fit, refit, run_search
from sim2real.identify.problem.problem import Problem
from sim2real.identify.problem.segments import Span
from sim2real.identify.search.refine import refine
from sim2real.identify.uncertainty.aggregate import aggregate
from sim2real.identify.uncertainty.uncertainty import uncertainty
from sim2real.identify.validation import prediction
from sim2real.stages.config import IdentifyConfig
from sim2real.stages.pipeline.pipeline import load_pipeline

SETTLE_S = 0.3
"""How much of the past the initial state of the disk's free run is estimated from [s]."""
PARTS = ("fit", "half", "others", "sysid", "delays", "speed")
BUDGET = ("generations", "population", "refine", "long_s")
QUICK = {
    **{"fit": ":200", "test": "200:300", "parts": ["fit", "sysid", "speed"]},
    **{"generations": 2, "population": 8, "refine": 1, "long_s": 0.0, "candidates": 4, "speed_s": 0.1},
}
OTHERS = {
    "kp=100": "kp=200,800",
    "kp=800": "kp=100,200",
    "motion=sin_sin": "motion=lift_and_drop,up_and_down,sin_time_square",
    "motion=lift_and_drop": "motion=sin_sin,up_and_down,sin_time_square",
    "motion=up_and_down": "motion=sin_sin,lift_and_drop,sin_time_square",
    "motion=sin_time_square": "motion=sin_sin,lift_and_drop,up_and_down",
}
"""What else is held out of the XL330's recordings, one at a time, and what is fitted then."""
DELAY_PARTS = [(5000 * i, 5000 * i + 4000) for i in range(5)]
DELAY_STARTS_S = (0.0, 0.02, 0.04, 0.06)


@dataclass(frozen=True)
class Case:
    """What is judged."""

    name: str
    config: IdentifyConfig
    robot: Any
    model: Any

    @property
    def fields(self) -> list[str]:
        """The columns of positions."""
        return [c.position if c.index is None else f"{c.position}[{c.index}]" for c in self.model.channels]


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of this bench."""
    parser.add_argument("--data", type=Path, required=True, help="folder of the recordings, or one of their files")
    parser.add_argument("--case", choices=["disk", "xl330", "so101_log"], default="disk")
    parser.add_argument("--fit", help="what to fit on; see benches/recordings.py")
    parser.add_argument("--test", help="what to judge on")
    parser.add_argument("--seeds", type=int, nargs="+", help="seeds of the search (xl330: 0 1 2, else 0)")
    parser.add_argument("--parts", nargs="+", default=list(PARTS), choices=PARTS, help="what to measure")
    parser.add_argument("--generations", type=int, help="of the search; default: the pipeline's")
    parser.add_argument("--population", type=int, help="of the search; default: the pipeline's")
    parser.add_argument("--refine", type=int, help="finalists that are refined; default: the pipeline's")
    parser.add_argument("--long-s", type=float, help="segments of the last refinement [s]; default: the pipeline's")
    parser.add_argument("--candidates", type=int, help="speed: at once; default: 2048 on the CPU, 65536 on a GPU")
    parser.add_argument("--speed-s", type=float, default=20.0, help="speed: how long mujoco.sysid is measured [s]")


def run(options: argparse.Namespace) -> dict[str, Any]:
    """Fit, predict, compare; return the rows."""
    case, parts = make_case(options), options.parts
    fitted = recordings.load(case.name, options.data, options.fit or SPECS[case.name])
    test = recordings.load(case.name, options.data, options.test or SPECS[f"{case.name}_test"], PAST)
    rows: list[dict[str, Any]] = []
    found: list[Fit] = []
    if "fit" in parts:
        found, rows = fit_and_judge(case, fitted, test, options.seeds)
        if case.name == "xl330" and "half" in parts:
            rows += half_step(case, found, test)
        if "sysid" in parts:
            rows += yardstick(case, fitted, test, rows)
    if case.name == "xl330" and "others" in parts:
        rows += others(case, options.data)
    if case.name == "disk" and "delays" in parts:
        rows += delays(case, options.data)
    if case.name == "disk" and "speed" in parts:
        rows += speed(case, fitted, options.candidates, options.speed_s)
    return {"rows": rows, "fit": list(fitted), "test": list(test), "values": [f.values for f in found]}


def fit_and_judge(
    case: Case, fitted: Mapping[str, Episode], test: Mapping[str, Episode], seeds: Sequence[int] | None
) -> tuple[list[Fit], list[dict[str, Any]]]:
    """Fit once a seed, and return the fits and what they are worth."""
    seeds = seeds or ([0, 1, 2] if case.name == "xl330" else [0])
    rows, found = [], []
    for seed in seeds:
        begin = time.monotonic()
        found.append(identify(replace(case, config=replace(case.config, seed=seed)), fitted))
        label = f"/seed_{seed}" if len(seeds) > 1 else ""
        goal = "< 60" if case.name == "disk" else ""
        rows.append(row(f"{case.name}/fit_s{label}", time.monotonic() - begin, "s", goal=goal))
    results = [predict(case, {"identified": f.values}, test) for f in found]
    return found, rows + judged(case, found[0], results, test, seeds)


def make_case(options: argparse.Namespace) -> Case:
    """Return the pipeline's part of a case."""
    pipeline = load_pipeline(options.case)
    robot: Any = pipeline.load()
    budget = {n: getattr(options, n) for n in BUDGET if getattr(options, n) is not None}
    config = replace(pipeline.identify, **budget)
    return Case(options.case, config, robot, robot.identifiable(config.max_delay_s))


def row(name: str, value: float, unit: str, yardstick: str = "", goal: str = "") -> dict[str, Any]:
    """Return a row of the result, rounded to four digits."""
    return figures.row(f"identify/{name}", float(f"{value:.4g}"), unit, yardstick, goal)


def identify(case: Case, fitted: Mapping[str, Episode]) -> Fit:
    """Fit as the pipeline's configuration says."""
    c, episodes = case.config, list(fitted.values())
    longer = windows(episodes, c.long_s, 0.0, c.initial_state == "free") if c.long_s else []
    length = c.settle_s + c.horizon_s
    spans = windows(episodes, length, c.spacing_s, c.initial_state == "free")
    return fit(case.model, episodes, spans, length, c, None, longer)


def windows(episodes: Sequence[Episode], length_s: float, spacing_s: float, estimated: bool) -> list[Span]:
    """Return the segments of all recordings; where initial states are estimated, not at their very start."""
    edge = 0.3 if estimated else 0.0
    step = spacing_s or length_s
    begins = [np.arange(edge, e.duration_s - length_s - edge, step) for e in episodes]
    return [Span(r, float(b)) for r, own in enumerate(begins) for b in own]


def predict(case: Case, models: Mapping[str, Any], test: Mapping[str, Episode]) -> dict[str, np.ndarray]:
    """Return columns of one free run over each test recording, whole."""
    episodes = list(test.values())
    if case.name == "disk":  # from a state that is estimated from the samples before
        begin, settle, config = PAST * 0.025 - SETTLE_S, SETTLE_S, case.config
    else:
        begin, settle, config = 0.0, 0.0, replace(case.config, initial_state="rest")
    length = max(e.duration_s for e in episodes) - begin
    problem = Problem(case.model, episodes, [Span(r, begin, False) for r in range(len(episodes))], length, config)
    columns = prediction.samples(problem, models, settle)
    return columns | {"ahead": columns["into"] - settle}


def errors_of(case: Case, columns: Mapping[str, np.ndarray], recording: int, model: str) -> np.ndarray:
    """Return a model's errors over one recording, ``(N, joints)`` [rad]."""
    pick = (columns["recording"] == recording) & (columns["ahead"] > 0)
    return np.stack([columns[f"{f}_{model}"][pick] - columns[f"{f}_measured"][pick] for f in case.fields], axis=1)


def rmse(errors: np.ndarray) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(errors**2)))


def judged(
    case: Case, first: Fit, results: list[dict[str, np.ndarray]], test: Mapping[str, Episode], seeds: Sequence[int]
) -> list[dict[str, Any]]:
    """Return the errors of our model, of the same without delay, and of none."""
    kept = np.array([c.parameter.kind != "delay" for c in first.problem.table.columns])
    bare = predict(case, {"identified": refit(first.problem, kept, first.z)}, test)
    if case.name == "disk":
        return _disk_rows(case, results[0], bare)
    if case.name == "xl330":
        return _xl330_rows(case, results, bare, list(test), seeds)
    return _so101_rows(case, results[0], bare, test)


def _disk_rows(case: Case, columns: dict[str, np.ndarray], bare: dict[str, np.ndarray]) -> list[dict[str, Any]]:
    own, none = (errors_of(case, c, 0, "identified") for c in (columns, bare))
    pick = columns["ahead"] > 0
    held = columns["th_measured"][~pick][-1] - columns["th_measured"][pick]
    return [
        row("disk/free_run_rmse_rad", rmse(own), "rad", "0.0349 mujoco.sysid 4.0.0", "<= 0.030, 0.025 wanted"),
        row("disk/no_delay_free_run_rmse_rad", rmse(none), "rad", "same model without delay"),
        row("disk/hold_free_run_rmse_rad", rmse(held), "rad", "hold"),
    ]


def _xl330_rows(
    case: Case,
    results: list[dict[str, np.ndarray]],
    bare: dict[str, np.ndarray],
    names: list[str],
    seeds: Sequence[int],
) -> list[dict[str, Any]]:
    def maes(columns: dict[str, np.ndarray]) -> np.ndarray:
        return np.array([1e3 * np.abs(errors_of(case, columns, r, "identified")).mean() for r in range(len(names))])

    each = np.stack([maes(c) for c in results])
    rows = [row(f"xl330/test_mae_mrad/seed_{s}", e.mean(), "mrad") for s, e in zip(seeds, each, strict=True)]
    rows.append(row("xl330/test_mae_mrad", float(np.median(each.mean(axis=1))), "mrad", "53 BAM M1 refitted", "<= 30"))
    rows += [row(f"xl330/test_mae_mrad/{n}", v, "mrad") for n, v in zip(names, np.median(each, axis=0), strict=True)]
    at_zero = results[0] | {"position_zero": np.zeros_like(results[0]["into"])}
    measured = [errors_of(case, at_zero, r, "zero") for r in range(len(names))]
    hold = [1e3 * np.abs(m - m[0]).mean() for m in measured]
    rows.append(row("xl330/no_delay_test_mae_mrad", maes(bare).mean(), "mrad", "same model without delay"))
    rows.append(row("xl330/hold_test_mae_mrad", float(np.mean(hold)), "mrad", "hold"))
    return rows


def _so101_rows(
    case: Case, columns: dict[str, np.ndarray], bare: dict[str, np.ndarray], test: Mapping[str, Episode]
) -> list[dict[str, Any]]:
    rows, ratios = [], []
    for r, (name, episode) in enumerate(test.items()):
        own, none = (errors_of(case, c, r, "identified") for c in (columns, bare))
        goal, position = episode.outputs["actuator"]["goal"], episode.outputs["sensor"]["position"]
        for j, channel in enumerate(case.model.channels):
            told = rmse(goal[:, j] - position[:, j])
            moves = bool(np.ptp(goal[:, j]) > 0.02)
            wanted = ("<= 9" if channel.name == "rotation" else f"<= {500 * told:.3g}") if moves else ""
            kind = f"{1e3 * told:.3g} told" + ("" if moves else ", is not moved")
            rows.append(row(f"so101/{name}/{channel.name}_rmse_mrad", 1e3 * rmse(own[:, j]), "mrad", kind, wanted))
            if moves:
                rows.append(
                    row(f"so101/{name}/{channel.name}_no_delay_mrad", 1e3 * rmse(none[:, j]), "mrad", "no delay")
                )
                ratios.append(rmse(own[:, j]) / told)
    return [*rows, row("so101/worst_over_told", max(ratios), "1", "where it was told to be", "<= 0.5")]


def half_step(case: Case, found: Sequence[Fit], test: Mapping[str, Episode]) -> list[dict[str, Any]]:
    """Return the errors with half the step of integration: stick-slip must not decide."""
    servo: Any = type(load_pipeline("xl330").load())

    class Halved(servo):
        """The servo, in a world with two substeps a tick."""

        def make_nodes(self) -> Any:
            """Return sensor, actuator and world."""
            nodes = super().make_nodes()
            nodes[2].substeps *= 2
            return nodes

    own = replace(case, model=Halved().identifiable(case.config.max_delay_s))
    maes = []
    for f in found:
        columns = predict(own, {"identified": f.values}, test)
        each = [1e3 * np.abs(errors_of(own, columns, r, "identified")).mean() for r in range(len(test))]
        maes.append(float(np.mean(each)))
    return [row("xl330/half_step_test_mae_mrad", float(np.median(maes)), "mrad", "the same with half the step")]


def others(case: Case, data: Path) -> list[dict[str, Any]]:
    """Return the errors where another gain, or one motion of all gains, is held out."""
    rows = []
    for held_out, fitted in OTHERS.items():
        test = recordings.load("xl330", data, held_out)
        columns = predict(case, {"identified": identify(case, recordings.load("xl330", data, fitted)).values}, test)
        each = [1e3 * np.abs(errors_of(case, columns, r, "identified")).mean() for r in range(len(test))]
        about = "beyond the gains that were fitted" if held_out == "kp=800" else ""
        rows.append(row(f"xl330/held_out/{held_out}_mae_mrad", float(np.mean(each)), "mrad", about))
    return rows


def delays(case: Case, data: Path) -> list[dict[str, Any]]:
    """Return the delay from five recordings of 100 s each, from four starts, and what they say together."""
    # Windows of a second, every half a second, and squares left early: the error of the friction moves the delay least.
    config = replace(case.config, settle_s=0.0, horizon_s=1.0, reach=2.5)
    rows, values, errors, spreads = [], [], [], []
    nominal = {p.name: p.nominal for p in case.model.parameters}
    for i, (a, b) in enumerate(DELAY_PARTS):
        part = list(recordings.load("disk", data, f"{a}:{b}").values())
        problem = Problem(case.model, part, windows(part, 1.0, 0.5, True), 1.0, config)
        starts = [problem.table.encode(nominal | {"delay": s}) for s in DELAY_STARTS_S]
        searched = [run_search(problem, s) for s in starts]
        ended = [refine(problem, f.finalists) for f in searched]
        found = [as_numbers(problem.table, e.z)["delay"] for e in ended]
        best = min(ended, key=lambda e: e.loss)
        spread = uncertainty(problem, best.z)
        values.append(as_numbers(problem.table, best.z)["delay"])
        errors.append(float(spread.standard_error[problem.table.names.index("delay")]))
        spreads.append(float(np.ptp(found)))
        rows.append(row(f"disk/delay_ms/part_{i}", 1e3 * values[-1], "ms", f"+- {1960 * errors[-1]:.2g} at 95 %"))
    total = aggregate(np.array(values), np.array(errors))
    covered = sum(total.low <= v <= total.high for v in values)
    return [
        *rows,
        row("disk/delay_spread_ms", 1e3 * np.ptp(values), "ms", "five recordings of 100 s", "<= 0.5"),
        row("disk/delay_starts_spread_ms", 1e3 * max(spreads), "ms", "each from 0, 20, 40 and 60 ms", "<= 0.5"),
        row("disk/delay_ms", 1e3 * total.mean, "ms", f"[{1e3 * total.low:.2f}, {1e3 * total.high:.2f}] for one more"),
        row("disk/delay_recordings_covered", covered, "of 5", "the aggregate's 95 % interval", "5"),
    ]


def yardstick(
    case: Case, fitted: Mapping[str, Episode], test: Mapping[str, Episode], ours: list[dict[str, Any]]
) -> list[dict[str, Any]]:
    """Return what mujoco.sysid reaches on the same split."""
    from benches import sysid_rows

    values = {r["name"].removeprefix("identify/"): r["value"] for r in ours}
    return [row(*r) for r in sysid_rows.rows(case.name, fitted, test, values)]


def speed(case: Case, fitted: Mapping[str, Episode], count: int | None, seconds: float) -> list[dict[str, Any]]:
    """Return how many candidates a second are simulated over 6,000 samples, 30,000 steps of the physics, each.

    Args:
        fitted: Its recording; of a shorter one all is simulated.
        seconds: How long mujoco.sysid is measured [s].
    """
    from benches import sysid

    config = replace(case.config, initial_state="measured")
    episode = next(iter(fitted.values()))
    problem = Problem(case.model, [episode], [Span(0, 0.3)], min(150.0, episode.duration_s - 0.6), config)
    device = jax.devices()[0].platform
    count = count or (65536 if device == "gpu" else 2048)
    candidates = 0.3 * jax.random.normal(jax.random.key(0), (count, len(problem.table)))
    run = jax.jit(lambda c, data: problem.residuals.losses(c, c[0], data))
    run(candidates, problem.data).block_until_ready()
    times = []
    for i in range(3):
        begin = time.monotonic()
        run(candidates + 0.01 * i, problem.data).block_until_ready()
        times.append(time.monotonic() - begin)
    took = float(np.median(times))
    rows = [row(f"disk/{device}/candidates_per_s", count / took, "1/s", "30,000 steps each")]
    if device == "gpu":
        rows.append(row(f"disk/{device}/generation_of_{count}_s", took, "s", "30,000 steps each"))
        return rows
    theirs = sysid.disk_speed(seconds)
    return [
        *rows,
        row("disk/sysid_evaluations_per_s", theirs, "1/s", "mujoco.sysid, 30,000 steps each"),
        row("disk/candidates_over_sysid", count / took / theirs, "1", "mujoco.sysid", ">= 200"),
    ]
