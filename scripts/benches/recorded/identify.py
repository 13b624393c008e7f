"""Identification on recordings of real motors: fitted on one part, judged on another.

    python scripts/bench.py identify --data DIR --case disk --fit :25000 --test 25000:30000

Beside our model stand: hold (nothing moves), goal (each joint is at its goal), the same model without delay, and
mujoco.sysid on the same split in the same run. Its first guess for the disk is of the size of the rig's published
constants: from one with 1.6 times the gain, 0.6 times the mass and damping and 4 times the friction it ended in one of
the many local minima of so long a free run.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from benches import rows as figures
from benches.recorded.ours import Case, Columns, identify, make_case, predict_whole
from benches.recorded.sets import BEFORE, SPECS, Recording, load, recording, servo_recording
from benches.rows import Report, Row, markdown, mean_absolute, rmse, values
from sim2real.graph.episode import Episode
from sim2real.identify.fit import Fit, refit
from sim2real.stages.estimation import held_out_parts

BUDGET = ("generations", "population", "long_s")
ITERATIONS = {"disk": 40, "xl330": 25, "so101": 8}
"""Largest number of iterations of mujoco.sysid; 15 for the SO-101 change no figure."""
DISK_SAMPLES, SO101_SPAN_S = 6000, 60.0
"""What mujoco.sysid fits of a longer recording: as in the figures published with the disk; of the SO-101 the begin."""
QUICK = {"fit": ":200", "test": "200:300", "generations": 2, "population": 8, "long_s": 0.0}


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of this bench."""
    parser.add_argument("--data", type=Path, required=True, help="folder of the recordings, or one of their files")
    parser.add_argument("--case", choices=["disk", "xl330", "so101_log"], default="disk")
    parser.add_argument("--fit", help="part to fit; the syntax is in benches/recorded/sets.py")
    parser.add_argument("--test", help="part to predict")
    parser.add_argument("--seeds", type=int, nargs="+", help="seeds of the search (xl330: 0 1 2, else 0)")
    parser.add_argument("--generations", type=int, help="of the search; default: the pipeline's")
    parser.add_argument("--population", type=int, help="of the search; default: the pipeline's")
    parser.add_argument("--long-s", type=float, help="segments of the last refinement [s]; default: the pipeline's")


def run(options: argparse.Namespace) -> Report:
    """Fit once for each seed, predict and compare."""
    case = make_case(options.case, {n: v for n in BUDGET if (v := getattr(options, n)) is not None})
    fitted = load(case.name, options.data, options.fit or SPECS[case.name])
    test = load(case.name, options.data, options.test or SPECS[f"{case.name}_test"], BEFORE)
    seeds, rows, fits = options.seeds or ([0, 1, 2] if case.name == "xl330" else [0]), [], []
    for seed in seeds:
        begin = time.monotonic()
        fits.append(identify(replace(case, config=replace(case.config, seed=seed)), fitted))
        label = f"/seed_{seed}" if len(seeds) > 1 else ""
        goal = "< 60" if case.name == "disk" else ""
        rows.append(row(f"{case.name}/fit_s{label}", time.monotonic() - begin, "s", goal=goal))
    rows += bound_rows(case, fits[0], list(fitted))
    rows += error_rows(case, fits[0], [predict_whole(case, {"identified": f.values}, test) for f in fits], test, seeds)
    # mujoco.sysid fits the same split afterwards: its rows hold the ratio of ours to its own.
    ours = {r["name"].removeprefix("identify/"): r["value"] for r in rows}
    sysid_rows = {"disk": _sysid_disk, "xl330": _sysid_xl330, "so101_log": _sysid_so101}[case.name]
    return {"rows": rows + sysid_rows(list(fitted.values()), test, ours), "values": [f.values for f in fits]}


def bound_rows(case: Case, first: Fit, names: Sequence[str]) -> list[Row]:
    """Return the expected RMSE of each position in later free runs, from fits without one part of the recordings.

    It is computed before the test part is predicted.
    """
    parts, rows = held_out_parts.examined(first, case.config, names), []
    for channel, field in zip(case.model.channels, case.fields, strict=True):
        errors = np.array([e for part in parts if (e := part.free.get(field)) is not None and np.isfinite(e)])
        if errors.size >= 2:
            about = f"1.25 times the worst of {errors.size} held-out parts"
            name = f"{case.name.removesuffix('_log')}/expected/{channel.name or field}_mrad"
            rows.append(row(name, 1.25e3 * errors.max(), "mrad", about))
    return rows


def row(name: str, value: float, unit: str, yardstick: str = "", goal: str = "") -> Row:
    """Return a row of the result, rounded to four digits."""
    return figures.row(f"identify/{name}", figures.four_digits(value), unit, yardstick, goal)


def errors_of(case: Case, columns: Columns, recording: int, model: str) -> np.ndarray:
    """Return a model's errors over one recording, ``(N, joints)`` [rad]."""
    pick = (columns["recording"] == recording) & (columns["ahead"] > 0)
    return np.stack([columns[f"{f}_{model}"][pick] - columns[f"{f}_measured"][pick] for f in case.fields], axis=1)


def error_rows(
    case: Case, first: Fit, results: Sequence[Columns], test: Mapping[str, Episode], seeds: Sequence[int]
) -> list[Row]:
    """Return the errors of our model, of the same without delay, and of no model."""
    selected = np.array([c.parameter.kind != "delay" for c in first.problem.table.columns])
    undelayed = predict_whole(case, {"identified": refit(first.problem, selected, first.z)}, test)
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


def _sysid_disk(fitted: list[Episode], test: Mapping[str, Episode], ours: Mapping[str, float]) -> list[Row]:
    """Fit the first samples in one free run of 150 s, with and without a delay."""
    from benches.recorded import rigs

    whole = recording(next(iter(test.values())), "action", "th")
    slope = np.polyfit(
        whole.t[BEFORE - 12 : BEFORE + 1] - whole.t[BEFORE], whole.position[BEFORE - 12 : BEFORE + 1, 0], 3
    )
    part = whole.part(BEFORE, len(whole.t), np.array([[slope[3], slope[2]]]))
    first = recording(fitted[0], "action", "th").part(0, DISK_SAMPLES)
    lines = []
    for delay, name in ((False, "disk/sysid_no_delay"), (True, "disk/sysid")):
        fit = rigs.fit_once(rigs.one_joint("disk"), [first], delay, ITERATIONS["disk"])
        error, about = rmse(fit.predict([part])[0] - part.position), f"mujoco.sysid, {fit.evaluations} evaluations"
        lines += [row(f"{name}_free_run_rmse_rad", error, "rad", about), row(f"{name}_s", fit.seconds, "s", about)]
    low, high = fit.interval95["delay"]
    interval, ratio = f"{1e3 * low:.2f} to {1e3 * high:.2f}", ours["disk/free_run_rmse_rad"] / error
    lines.append(row("disk/sysid_delay_ms", 1e3 * fit.value("delay"), "ms", interval))
    about = "mujoco.sysid with delay, and a constant torque"
    return [*lines, row("disk/free_run_over_sysid", ratio, "1", about, "<= 0.75")]


def _sysid_xl330(fitted: list[Episode], test: Mapping[str, Episode], ours: Mapping[str, float]) -> list[Row]:
    """Fit torque at full duty, back-EMF, damping, dry friction and armature, with and without a delay."""
    from benches.recorded import rigs

    lines, judged = [], [servo_recording(e) for e in test.values()]
    for delay, name in ((False, "xl330/sysid_no_delay"), (True, "xl330/sysid")):
        fit = rigs.fit_once(rigs.one_joint("xl330"), list(map(servo_recording, fitted)), delay, ITERATIONS["xl330"])
        off = [np.abs(p - r.position).mean() for p, r in zip(fit.predict(judged), judged, strict=True)]
        about = f"mujoco.sysid, {fit.evaluations} evaluations in {fit.seconds:.0f} s"
        lines.append(row(f"{name}_test_mae_mrad", 1e3 * float(np.mean(off)), "mrad", about))
    ratio = ours["xl330/test_mae_mrad"] / (1e3 * float(np.mean(off)))
    return [*lines, row("xl330/test_mae_over_sysid", ratio, "1", "mujoco.sysid with delay")]


def _sysid_so101(fitted: list[Episode], test: Mapping[str, Episode], ours: Mapping[str, float]) -> list[Row]:
    """Fit gain, damping, dry friction, offset and delay of each joint alone: a sixth of the work of one fit of all."""
    from benches.recorded import rigs

    del ours
    joints = ("rotation", "pitch", "elbow", "wrist_pitch", "wrist_roll", "jaw")
    judged = {name: recording(e, "goal", "position") for name, e in test.items()}
    longest = [e for e in fitted if e.duration_s > 60.0]  # each joint moves in those

    def begin(r: Recording) -> Recording:
        return r.part(0, int(np.searchsorted(r.t, r.t[0] + SO101_SPAN_S)))

    spans = [begin(recording(e, "goal", "position")) for e in longest or fitted]
    rig, count = rigs.one_joint("so101"), ITERATIONS["so101"]
    fits = [rigs.fit_once(rig, [span.joint(j) for span in spans], True, count) for j in range(len(joints))]
    about = f"mujoco.sysid, each joint alone, {sum(f.seconds for f in fits):.0f} s for all"
    lines = []
    for (name, truth), predicted in zip(judged.items(), rigs.predict_joints(fits, list(judged.values())), strict=True):
        for j, joint in enumerate(joints):
            if np.ptp(truth.command[:, j]) > 0.02:
                error = 1e3 * rmse(predicted[:, j] - truth.position[:, j])
                lines.append(row(f"so101/{name}/{joint}_sysid_rmse_mrad", error, "mrad", about))
    return lines


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
    expected = {kind: [v[n] for n in v if n.startswith(f"{kind}/expected/")] for kind in ("disk", "xl330")}
    moved = [v[n] for j in joints if (n := f"so101/expected/{j.rpartition('/')[2]}_mrad") in v]
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
