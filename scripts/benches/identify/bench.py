"""Identification on recordings of real motors: fitted on one part, judged on another.

    python scripts/bench.py identify --data DIR --case disk --fit :25000 --test 25000:30000

Beside our model stand: hold (nothing moves), goal (each joint is at its goal), the same model without delay, and
mujoco.sysid on the same split in the same run.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from benches import rows as figures
from benches.identify import recordings
from benches.identify.recordings import ITERATIONS, PAST, SPECS
from benches.rows import Report, Row, markdown, mean_absolute, rmse, values
from sim2real.graph.episode import Episode
from sim2real.identify.fit import Fit, fit, refit
from sim2real.identify.problem.problem import Problem
from sim2real.identify.problem.segments import Span
from sim2real.identify.validation import prediction
from sim2real.stages.config import IdentifyConfig
from sim2real.stages.estimation import held_out_parts, promises
from sim2real.stages.estimation.predicted_logs import LEAST_PARTS
from sim2real.stages.pipeline.pipeline import load_pipeline

SETTLE_S = 0.3
"""Length of the samples from which the initial state of the disk's free run is estimated [s]."""
BUDGET = ("generations", "population", "refine", "long_s")
QUICK = {"fit": ":200", "test": "200:300", "generations": 2, "population": 8, "refine": 1, "long_s": 0.0}

Columns = Mapping[str, np.ndarray]
"""Samples of free runs: ``recording``, ``ahead`` [s], and of each field the measured and the predicted values."""


@dataclass(frozen=True)
class Case:
    """A robot that is judged, with the settings of its identification."""

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
    parser.add_argument("--fit", help="part to fit; the syntax is in benches/identify/recordings.py")
    parser.add_argument("--test", help="part to predict")
    parser.add_argument("--seeds", type=int, nargs="+", help="seeds of the search (xl330: 0 1 2, else 0)")
    parser.add_argument("--generations", type=int, help="of the search; default: the pipeline's")
    parser.add_argument("--population", type=int, help="of the search; default: the pipeline's")
    parser.add_argument("--refine", type=int, help="finalists that are refined; default: the pipeline's")
    parser.add_argument("--long-s", type=float, help="segments of the last refinement [s]; default: the pipeline's")


def run(options: argparse.Namespace) -> Report:
    """Fit, predict and compare."""
    from benches.identify import sysid_rows

    case = make_case(options)
    fitted = recordings.load(case.name, options.data, options.fit or SPECS[case.name])
    test = recordings.load(case.name, options.data, options.test or SPECS[f"{case.name}_test"], PAST)
    fits, rows = fit_and_judge(case, fitted, test, options.seeds)
    # mujoco.sysid fits the same split afterwards: its rows hold the ratio of ours to its own.
    ours = {str(r["name"]).removeprefix("identify/"): r["value"] for r in rows}
    rows += [row(*columns) for columns in sysid_rows.rows(case.name, fitted, test, ours)]
    return {"rows": rows, "values": [f.values for f in fits]}


def fit_and_judge(
    case: Case, fitted: Mapping[str, Episode], test: Mapping[str, Episode], seeds: Sequence[int] | None
) -> tuple[list[Fit], list[Row]]:
    """Fit once for each seed; return the fits and the rows of their errors."""
    seeds = seeds or ([0, 1, 2] if case.name == "xl330" else [0])
    rows, fits = [], []
    for seed in seeds:
        begin = time.monotonic()
        fits.append(identify(replace(case, config=replace(case.config, seed=seed)), fitted))
        label = f"/seed_{seed}" if len(seeds) > 1 else ""
        goal = "< 60" if case.name == "disk" else ""
        rows.append(row(f"{case.name}/fit_s{label}", time.monotonic() - begin, "s", goal=goal))
    rows += promised_rows(case, fits[0], list(fitted))
    results = [predict(case, {"identified": f.values}, test) for f in fits]
    return fits, rows + error_rows(case, fits[0], results, test, seeds)


def promised_rows(case: Case, first: Fit, names: Sequence[str]) -> list[Row]:
    """Return the bound on the RMSE of each position in later free runs, from fits without one part of the recordings.

    The bound is computed before the test part is predicted.
    """
    parts, rows = held_out_parts.examined(first, case.config, names), []
    for channel, field in zip(case.model.channels, case.fields, strict=True):
        errors = np.array([e for part in parts if (e := part.free.get(field)) is not None and np.isfinite(e)])
        if errors.size >= LEAST_PARTS:
            about = f"95 % of later free runs, from {errors.size} held-out parts"
            name = f"{case.name.removesuffix('_log')}/promised/{channel.name or field}_mrad"
            rows.append(row(name, 1e3 * promises.further(errors), "mrad", about))
    return rows


def make_case(options: argparse.Namespace) -> Case:
    """Return the case that the flags name, with the settings of its pipeline."""
    pipeline = load_pipeline(options.case)
    robot: Any = pipeline.load()
    budget = {n: getattr(options, n) for n in BUDGET if getattr(options, n) is not None}
    config = replace(pipeline.identify, **budget)
    return Case(options.case, config, robot, robot.identifiable(config.max_delay_s))


def row(name: str, value: float, unit: str, yardstick: str = "", goal: str = "") -> Row:
    """Return a row of the result, rounded to four digits."""
    return figures.row(f"identify/{name}", figures.four_digits(value), unit, yardstick, goal)


def identify(case: Case, fitted: Mapping[str, Episode]) -> Fit:
    """Fit with the settings of the case."""
    c, episodes = case.config, list(fitted.values())
    longer = windows(episodes, c.long_s, 0.0, c.initial_state == "free") if c.long_s else []
    length = c.settle_s + c.horizon_s
    spans = windows(episodes, length, c.spacing_s, c.initial_state == "free")
    return fit(case.model, episodes, spans, length, c, None, longer)


def windows(episodes: Sequence[Episode], length_s: float, spacing_s: float, estimated: bool) -> list[Span]:
    """Return the segments of all recordings; 0.3 s at both ends stay free where initial states are estimated."""
    edge = 0.3 if estimated else 0.0
    step = spacing_s or length_s
    begins = [np.arange(edge, e.duration_s - length_s - edge, step) for e in episodes]
    return [Span(r, float(b)) for r, times in enumerate(begins) for b in times]


def predict(case: Case, models: Mapping[str, Any], test: Mapping[str, Episode]) -> Columns:
    """Return columns of one free run over each whole test recording."""
    episodes = list(test.values())
    if case.name == "disk":  # The initial state is estimated from the samples before the part.
        begin, settle, config = PAST * 0.025 - SETTLE_S, SETTLE_S, case.config
    else:
        begin, settle, config = 0.0, 0.0, replace(case.config, initial_state="rest")
    length = max(e.duration_s for e in episodes) - begin
    problem = Problem(case.model, episodes, [Span(r, begin, False) for r in range(len(episodes))], length, config)
    columns = prediction.samples(problem, models, settle)
    return columns | {"ahead": columns["into"] - settle}


def errors_of(case: Case, columns: Columns, recording: int, model: str) -> np.ndarray:
    """Return a model's errors over one recording, ``(N, joints)`` [rad]."""
    pick = (columns["recording"] == recording) & (columns["ahead"] > 0)
    return np.stack([columns[f"{f}_{model}"][pick] - columns[f"{f}_measured"][pick] for f in case.fields], axis=1)


def error_rows(
    case: Case, first: Fit, results: Sequence[Columns], test: Mapping[str, Episode], seeds: Sequence[int]
) -> list[Row]:
    """Return the errors of our model, of the same without delay, and of no model."""
    selected = np.array([c.parameter.kind != "delay" for c in first.problem.table.columns])
    undelayed = predict(case, {"identified": refit(first.problem, selected, first.z)}, test)
    if case.name == "disk":
        return _disk_rows(case, results[0], undelayed)
    if case.name == "xl330":
        return _xl330_rows(case, results, undelayed, list(test), seeds)
    return _so101_rows(case, results[0], undelayed, test)


def _disk_rows(case: Case, columns: Columns, undelayed: Columns) -> list[Row]:
    ours, without = (errors_of(case, c, 0, "identified") for c in (columns, undelayed))
    pick = columns["ahead"] > 0
    held = columns["th_measured"][~pick][-1] - columns["th_measured"][pick]
    return [
        row("disk/free_run_rmse_rad", rmse(ours), "rad", "0.0349 mujoco.sysid 4.0.0", "<= 0.030, 0.025 wanted"),
        row("disk/no_delay_free_run_rmse_rad", rmse(without), "rad", "same model without delay"),
        row("disk/hold_free_run_rmse_rad", rmse(held), "rad", "hold"),
    ]


def _xl330_rows(
    case: Case, results: Sequence[Columns], undelayed: Columns, names: list[str], seeds: Sequence[int]
) -> list[Row]:
    def maes(columns: Columns) -> np.ndarray:
        return np.array([1e3 * mean_absolute(errors_of(case, columns, r, "identified")) for r in range(len(names))])

    each = np.stack([maes(c) for c in results])
    rows = [row(f"xl330/test_mae_mrad/seed_{s}", e.mean(), "mrad") for s, e in zip(seeds, each, strict=True)]
    rows.append(row("xl330/test_mae_mrad", float(np.median(each.mean(axis=1))), "mrad", "53 BAM M1 refitted", "<= 30"))
    rows += [row(f"xl330/test_mae_mrad/{n}", v, "mrad") for n, v in zip(names, np.median(each, axis=0), strict=True)]
    at_zero = {**results[0], "position_zero": np.zeros_like(results[0]["into"])}
    measured = [errors_of(case, at_zero, r, "zero") for r in range(len(names))]
    hold = [1e3 * mean_absolute(m - m[0]) for m in measured]
    rows.append(row("xl330/no_delay_test_mae_mrad", maes(undelayed).mean(), "mrad", "same model without delay"))
    rows.append(row("xl330/hold_test_mae_mrad", float(np.mean(hold)), "mrad", "hold"))
    return rows


def _so101_rows(case: Case, columns: Columns, undelayed: Columns, test: Mapping[str, Episode]) -> list[Row]:
    rows, ratios = [], []
    for r, (name, episode) in enumerate(test.items()):
        ours, without = (errors_of(case, c, r, "identified") for c in (columns, undelayed))
        goal, position = episode.outputs["actuator"]["goal"], episode.outputs["sensor"]["position"]
        for j, channel in enumerate(case.model.channels):
            # The yardstick is the distance of the joint from its goal; only a joint that moves has a goal to reach.
            off = rmse(goal[:, j] - position[:, j])
            moves = bool(np.ptp(goal[:, j]) > 0.02)
            wanted = ("<= 9" if channel.name == "rotation" else f"<= {500 * off:.3g}") if moves else ""
            kind = f"{1e3 * off:.3g} from the goal" + ("" if moves else ", is not moved")
            base = f"so101/{name}/{channel.name}"
            rows.append(row(f"{base}_rmse_mrad", 1e3 * rmse(ours[:, j]), "mrad", kind, wanted))
            if moves:
                rows.append(row(f"{base}_no_delay_mrad", 1e3 * rmse(without[:, j]), "mrad", "no delay"))
                ratios.append(rmse(ours[:, j]) / off)
    return [*rows, row("so101/worst_over_goal", max(ratios), "1", "distance from the goal", "<= 0.5")]


def table(*reports: Report) -> str:
    """Return the errors on recordings of real motors, and the time of each fit: of the disk, the XL330, the SO-101."""
    v = {name: value for report in reports for name, value in values(report, "identify/").items()}
    joints = [
        n.removesuffix("_sysid_rmse_mrad") for n in v if n.startswith("so101/") and n.endswith("_sysid_rmse_mrad")
    ]
    kinds = ("_rmse_mrad", "_sysid_rmse_mrad", "_no_delay_mrad")
    arm, worst = ([of([v[j + kind] for j in joints]) for kind in kinds] for of in (np.mean, np.max))
    disk = [1e3 * v[f"disk/{n}free_run_rmse_rad"] for n in ("", "sysid_", "no_delay_")]
    servo = [v[f"xl330/{n}test_mae_mrad"] for n in ("", "sysid_", "no_delay_")]
    expected = {kind: [v[n] for n in v if n.startswith(f"{kind}/promised/")] for kind in ("disk", "xl330")}
    moved = [v[n] for j in joints if (n := f"so101/promised/{j.rpartition('/')[2]}_mrad") in v]
    fits = {kind: [x for n, x in v.items() if n.startswith(f"{kind}/fit_s")] for kind in ("disk", "xl330", "so101_log")}
    lines = [
        [about, f"{errors[0]:.{digits}f}", f"{bound:.{digits}f}", *(f"{x:.{digits}f}" for x in errors[1:])]
        for about, errors, bound, digits in (
            ("motor with eccentric mass, 125 s free run, RMSE", disk, np.mean(expected["disk"]), 0),
            ("DYNAMIXEL XL330, a gain that was not fitted, MAE", servo, np.mean(expected["xl330"]), 0),
            ("SO-101 arm, joints that move, mean RMSE", arm, np.mean(moved), 1),
            ("SO-101 arm, worst joint of a motion, RMSE", worst, np.max(moved), 0),
        )
    ]
    held_out, bound = "held-out data, whole recordings [mrad]", "95 % bound, RMSE"
    head = [held_out, "sim2real", bound, "mujoco.sysid", "sim2real without delay"]
    took = ", ".join(f"{np.median(seconds):.0f} s" for seconds in fits.values())
    iterations = ", ".join(map(str, ITERATIONS.values()))
    return markdown(head, lines) + (
        f"\nsim2real fits until it converges: {took} of wall clock for motor, XL330 and SO-101. mujoco.sysid has one "
        f"start and at most {iterations} iterations: {v['disk/sysid_s']:.0f} s for the motor.\n"
    )
