"""The league: all recordings, with parts held out in turn, fitted by sim2real and by the tools of others.

    python scripts/bench.py league --data DIR --json reports/league.json
    python scripts/bench.py league --data DIR --sets xl330 --entrants bam_m1 bam_m6 --budget-s 20 --results league.jsonl

Each entrant fits the same parts of the same recordings within the same processor time, compilation included, and
predicts the held-out part. The settings of its pipeline determine the time of ours, which is reported. The rows are
mean and worst over the folds of a set, and the worst joint. A fit gets no test part.
--results gets a line for each fold and entrant at once: an interrupted run continues from there.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benches import jobs
from benches import rows as figures
from benches.recorded import bam, ours, published, textbook
from benches.recorded.sets import SETS, Fold, LeagueSet, Recording
from benches.rows import Report, Row, markdown, values
from sim2real.errors import UsageError

Predict = Callable[[Sequence[Recording]], list[np.ndarray]]


class Fitted(NamedTuple):
    """A predictor, and a line on the fit."""

    predict: Predict
    summary: str


ENTRANTS = {
    "ours": "sim2real identify with the pipeline's settings; sets without a pipeline as new describes them",
    "sysid": "mujoco.sysid with a user's terms: gain, damping, dry friction, inertia; no delay",
    "sysid_delay": "mujoco.sysid with a delay and our terms",
    "pace": "PACE's form: inertia, damping, friction, bias of each joint, a delay in steps; CMA-ES",
    "bam_m1": "BAM M1: Coulomb and viscous friction; CMA-ES",
    "bam_m6": "BAM M6: Stribeck, load, direction, quadratic; CMA-ES",
    "textbook": "stiffness, damping, dry friction, delay, limit of the rate; scipy.optimize.least_squares",
    **dict.fromkeys(published.SETS, "published parameters of the SO-101 or the EMPS, not fitted"),
}
QUICK: dict[str, Any] = {"budget_s": 0.2, "folds": 1, "samples": 120, "entrants": [e for e in ENTRANTS if e != "ours"]}


class NoFormError(Exception):
    """An entrant has no form for a set; the message is the reason."""


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of this bench."""
    parser.add_argument("--data", type=Path, required=True, help="folder of all recordings")
    parser.add_argument("--sets", nargs="+", help="default: all whose folders are there")
    parser.add_argument("--entrants", nargs="+", choices=list(ENTRANTS), default=list(ENTRANTS))
    parser.add_argument("--budget-s", type=float, default=60.0, help="processor time of a fit, over all threads")
    parser.add_argument("--folds", type=int, help="largest number of folds of a set; default: all")
    parser.add_argument("--samples", type=int, help="largest number of samples of a recording; default: all")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=1, help="fits at once, of one thread each; 1: in this process")
    parser.add_argument("--results", type=Path, help="JSON lines: an earlier run's are read, new ones are added")


def run(options: argparse.Namespace) -> Report:
    """Fit, predict, and return the rows and every fold's figures."""
    if options.jobs < 1:
        raise UsageError(f"jobs must be at least 1, got {options.jobs}")
    results, tasks = _earlier_results(options), _tasks(options)
    missing = {key: task for key, task in tasks.items() if key not in results}
    keys = list(missing)
    for i, result in jobs.each(judge, list(missing.values()), options):
        results[keys[i]] = {**dict(zip(_KEY, keys[i], strict=True)), **result}
        _add(options.results, results[keys[i]])
    measured = [results[key] for key in tasks]
    kept = ("set", "fold", "entrant", "value", "worst_joint", "unit", "seconds")
    return {"rows": rows(measured), "folds": [{key: fold[key] for key in kept} for fold in measured]}


_KEY = ("set", "fold", "entrant", "budget_s", "seed")


def _tasks(options: argparse.Namespace) -> dict[tuple[Any, ...], tuple[LeagueSet, Fold, str]]:
    """Return the fits to do: key in --results -> set, fold and entrant."""
    tasks, there = {}, {n: s for n, s in SETS.items() if (options.data / s.folder).is_dir()}
    for name in options.sets or there:
        if name not in there:
            raise UsageError(f"{options.data} has no set {name!r}", hint=f"available: {', '.join(there)}")
        for fold in there[name].folds(options.data)[: options.folds]:
            for entrant in options.entrants:
                if published.SETS.get(entrant, name) == name:
                    tasks[name, fold.name, entrant, options.budget_s, options.seed] = (there[name], fold, entrant)
    return tasks


def judge(league_set: LeagueSet, fold: Fold, entrant: str, options: argparse.Namespace) -> dict[str, Any]:
    """Return one entrant's figures on one fold of a set, or the reason why it has none."""
    fitted, test = (_short(part, options.samples) for part in (fold.fitted, fold.test))
    begin, unit = time.process_time(), "mm" if test[0].constants.get("sliding") else "mrad"
    try:
        predict, summary = fit(league_set.name, replace(fold, fitted=fitted, test=()), entrant, options)
    except NoFormError as reason:
        return {"value": None, "worst_joint": None, "unit": unit, "seconds": None, "summary": str(reason)}
    seconds = time.process_time() - begin
    each = [league_set.score(p, r) for p, r in zip(predict(test), test, strict=True)]
    errors = np.concatenate(each)
    finite = len(errors) > 0 and bool(np.isfinite(errors).all())
    value, worst = (float(errors.mean()), float(errors.max())) if finite else (None, None)
    return {"value": value, "worst_joint": worst, "unit": unit, "seconds": seconds, "summary": summary}


def fit(name: str, fold: Fold, entrant: str, options: argparse.Namespace) -> Fitted:
    """Fit one entrant; raise NoFormError if it has no form for such a rig."""
    budget_s, seed, constants = options.budget_s, options.seed, fold.fitted[0].constants
    if entrant == "ours":
        return Fitted(*ours.fit(name, fold, seed))
    if entrant in published.SETS:
        return Fitted(lambda recordings: published.predict(entrant, recordings), "not fitted")
    if entrant == "textbook":
        force = name in ("disk", "emps")
        loaded = name in ("disk", "xl330", "sts3250")
        return _joint_by_joint(fold, lambda rs, s: Fitted(*textbook.fit(rs, force, loaded, s, seed)), budget_s)
    if entrant.startswith("bam"):
        if "mjcf" in constants:
            raise NoFormError("BAM's form is a bench with one joint and a given load; a robot's load is not one number")
        kind = entrant.removeprefix("bam_").upper()
        load = bam.DISK_LOAD if name == "disk" else bam.ARM_LOAD if name == "so101" else {}
        loaded = replace(fold, fitted=tuple(_loaded(r, load) for r in fold.fitted))
        predict, summary = _joint_by_joint(loaded, lambda rs, s: Fitted(*bam.fit(kind, rs, s, seed)), budget_s)
        return Fitted(lambda recordings: predict([_loaded(r, load) for r in recordings]), summary)
    from benches.recorded import rigs

    def mujoco(rig: rigs.Rig, fitted: Sequence[Recording], seconds: float) -> Fitted:
        if entrant == "pace":
            found = rigs.fit_pace(rig, fitted, seconds, seed)
            return Fitted(found.predict, f"{found.evaluations} evaluations")
        found = rigs.fit_sysid(rig, fitted, entrant == "sysid_delay", seconds, seed)
        return Fitted(found.predict, f"{found.evaluations} evaluations, {found.starts} starts")

    if "mjcf" not in constants:
        rig = rigs.one_joint(name)
        return _joint_by_joint(fold, lambda rs, s: mujoco(rig, rs, s), budget_s)
    return mujoco((rigs.legs if name == "go2" else rigs.axis)(fold.fitted[0]), fold.fitted, budget_s)


def _joint_by_joint(fold: Fold, single: Callable[[list[Recording], float], Fitted], budget_s: float) -> Fitted:
    """Fit every joint alone, each in its share of the time, on the recordings in which it is moved."""
    joints = fold.fitted[0].position.shape[1]
    fits: list[Fitted] = []
    for j in range(joints):
        moved = [r.joint(j) for r in fold.fitted if joints == 1 or np.ptp(r.command[:, j]) > 0.02]
        fits.append(single(moved or [fold.fitted[0].joint(j)], budget_s / joints))

    def predict(recordings: Sequence[Recording]) -> list[np.ndarray]:
        columns = [p([r.joint(j) for r in recordings]) for j, (p, _) in enumerate(fits)]
        return [np.hstack(joint_columns) for joint_columns in zip(*columns, strict=True)]

    return Fitted(predict, "; ".join(dict.fromkeys(f.summary for f in fits)))


def _loaded(recording: Recording, load: dict[str, Any]) -> Recording:
    return replace(recording, constants={**load, **recording.constants})


def _short(recordings: tuple[Recording, ...], samples: int | None) -> tuple[Recording, ...]:
    return tuple(_first(r, samples) for r in recordings) if samples else recordings


def _first(recording: Recording, samples: int) -> Recording:
    cut = recording.part(0, samples)
    constants = {n: v[:samples] if isinstance(v, np.ndarray) else v for n, v in recording.constants.items()}
    return replace(cut, constants=constants)


def rows(measured: Sequence[dict[str, Any]]) -> list[Row]:
    """Return mean, worst fold and worst joint of each set and entrant, or the reason why there is no figure."""
    table = []
    for name in dict.fromkeys(r["set"] for r in measured):
        for entrant in dict.fromkeys(r["entrant"] for r in measured if r["set"] == name):
            selected = [r for r in measured if r["set"] == name and r["entrant"] == entrant]
            values, unit = [r["value"] for r in selected if r["value"] is not None], selected[0]["unit"]
            joints = [r["worst_joint"] for r in selected if r["value"] is not None]
            lost = f", {len(selected) - len(values)} without a figure" if len(values) < len(selected) else ""
            took = [r["seconds"] for r in selected if r["seconds"] is not None]
            spent = f"{len(selected)} folds, {np.median(took):.0f} s of processor time a fit{lost}" if took else ""
            about = spent if values else selected[0].get("summary", "")
            for what, of, figures_of in (
                ("mean", np.mean, values), ("worst", np.max, values), ("worst_joint", np.max, joints)
            ):  # fmt: skip
                value = float(f"{of(figures_of):.4g}") if values else None
                table.append(figures.row(f"league/{name}/{entrant}/{what}", value, unit, about))
    return table


def _earlier_results(options: argparse.Namespace) -> dict[tuple[Any, ...], dict[str, Any]]:
    """Return the results of an earlier run in --results, by key."""
    if options.results is None or not options.results.is_file():
        return {}
    lines = [json.loads(line) for line in options.results.read_text().splitlines() if line.strip()]
    return {tuple(r[k] for k in _KEY): r for r in lines}


def _add(results: Path | None, measured: dict[str, Any]) -> None:
    value = "no figure" if measured["value"] is None else f"{measured['value']:.4g}"
    print(
        f"{measured['set']}, {measured['fold']}: {measured['entrant']} {value} ({measured['summary']})", file=sys.stderr
    )
    if results is not None:
        with results.open("a") as file:
            file.write(json.dumps(measured) + "\n")


LABELS = {
    "disk": "DC motor with an eccentric mass, RMSE",
    "xl330": "DYNAMIXEL XL330 servo lifting a mass, MAE",
    "so101": "SO-101 arm, joints that move, RMSE",
    "go2": "Unitree Go2 on a stand, RMSE",
    "sts3250": "Feetech STS3250 servo lifting a mass, MAE",
    "emps": "EMPS, a linear axis, RMSE",
}
"""Sets with these names; others have their folder's name."""
REASONS = {"lift_and_drop": "the only motion in which torque is off and the arm falls"}
"""Part -> why its error may be larger than expected."""
NAMES = {
    "sysid": "mujoco.sysid",
    "sysid_delay": "mujoco.sysid with a delay",
    "pace": "PACE",
    "bam_m1": "BAM M1",
    "bam_m6": "BAM M6",
    "textbook": "textbook servo",
    "published": "best published set",
}
WIDER, LEAST_PARTS = 1.25, 2
"""The expected error is 1.25 times the worst of the other parts, as in a verdict; at least two others are needed."""


class Part(NamedTuple):
    """Our error on a held-out part, the error expected from the other parts of the set, and the errors on these."""

    name: str
    error: float
    expected: float | None
    others: list[float]


def parts(report: Report, name: str) -> list[Part]:
    """Return our parts of a set, the largest error first."""
    folds = [f for f in report["folds"] if (f["set"], f["entrant"]) == (name, "ours") and f["value"] is not None]
    found = []
    for fold in folds:
        others = [f["value"] for f in folds if f is not fold]
        found.append(
            Part(fold["fold"], fold["value"], WIDER * max(others) if len(others) >= LEAST_PARTS else None, others)
        )
    return sorted(found, key=lambda part: -part.error)


def sets_of(report: Report) -> list[str]:
    """Return the sets of a report, those of the list first."""
    there = dict.fromkeys(f["set"] for f in report["folds"])
    return [*(n for n in LABELS if n in there), *(n for n in there if n not in LABELS)]


def errors_of(report: Report, name: str, what: str) -> dict[str, float]:
    """Return entrant -> error on a set [mrad, mm]; the published sets are one entrant, with the least."""
    errors: dict[str, float] = {}
    for entrant, value in ((n.split("/"), v) for n, v in values(report, f"league/{name}/").items()):
        if entrant[1] == what and value is not None:
            label = "published" if entrant[0].startswith("published") else entrant[0]
            errors[label] = min(value, errors.get(label, value))
    return errors


def seconds_of(report: Report, name: str, entrant: str) -> str:
    """Return the median processor time of a fit; none for published sets, which are not fitted."""
    folds = [f for f in report["folds"] if f["set"] == name and f["entrant"] == entrant]
    took = [f["seconds"] for f in folds if f["seconds"] is not None]
    return f"{np.median(took):.0f} s" if took and entrant != "published" else "no fit"


def unit_of(report: Report, name: str) -> str:
    """Return the unit of a set's errors."""
    return next(f["unit"] for f in report["folds"] if f["set"] == name)


def short(value: float | None) -> str:
    """Return an error with three digits; "-" if there is none."""
    return "-" if value is None else f"{value:.1f}" if value < 100 else f"{value:.0f}"


def with_expected(part: Part) -> str:
    """Return an error, and the expected one in brackets."""
    return short(part.error) + (f" ({short(part.expected)})" if part.expected else "")


def about_budget(report: Report) -> str:
    """Return the sentences on what each tool was given."""
    ours = [seconds_of(report, name, "ours") for name in sets_of(report)]
    longest = max(ours, key=lambda text: float(text.split()[0]))
    shortest = min(ours, key=lambda text: float(text.split()[0]))
    return (
        f"Every tool gets the same recordings without the held-out part. Each other tool has "
        f"{report['flags']['budget_s']:g} s of processor time for a fit;\nsim2real fits until it converges: {shortest} "
        f"to {longest}, medians of the sets. PACE and BAM are re-implemented from their equations.\n"
    )


def about_exceptions(report: Report) -> str:
    """Return the number of errors below the expected ones, and a sentence for each exception."""
    judged = [(n, p) for n in sets_of(report) for p in parts(report, n) if p.expected]
    larger = [(name, p) for name, p in judged if p.error > (p.expected or np.inf)]
    text = (
        f"The expected error is {WIDER} times the worst of the other parts; {len(judged) - len(larger)} of "
        f"{len(judged)} errors are within it.\n"
    ) * bool(judged)
    for name, part in larger:
        rig, unit = LABELS.get(name, name).partition(", ")[0], unit_of(report, name)
        reason = f", {REASONS[part.name]}" if part.name in REASONS else ""
        text += (
            f"The exception is `{part.name}` of the {rig}{reason}: {short(part.error)} {unit} "
            f"instead of {short(part.expected)} {unit}.\n"
        )
    return text


def table(report: Report) -> str:
    """Return the errors of all entrants, a line for each set, what each was given, and the sets that another wins."""
    lines, lost = [], ""
    for name in sets_of(report):
        means, joint, unit = (
            errors_of(report, name, "mean"),
            errors_of(report, name, "worst_joint"),
            unit_of(report, name),
        )
        count = len({f["fold"] for f in report["folds"] if f["set"] == name})
        about = f"{LABELS.get(name, name)}, {count} fold{'s' * (count > 1)} [{unit}]"
        ours = short(means.get("ours")), with_expected(parts(report, name)[0]), short(joint.get("ours"))
        others = [short(means.get(entrant)) for entrant in NAMES]
        lines.append((about, *ours, seconds_of(report, name, "ours"), *others))
        better = [e for e in sorted(means, key=lambda e: means[e]) if means[e] < means["ours"]]
        if better:
            listed = ", ".join(f"{NAMES[e]} ({short(means[e])} {unit})" for e in better)
            lost += f"\nBetter than sim2real on the set {LABELS.get(name, name)}: {listed}.\n"
    head = (
        "mean held-out error",
        "sim2real",
        "worst part (expected)",
        "worst joint",
        "processor time",
        *NAMES.values(),
    )
    return markdown(head, lines) + f"\n{about_budget(report)}{about_exceptions(report)}{lost}"


def why(report: Report, trained: Report) -> str:
    """Return README's reason to use sim2real: two figures of its evidence, beside those of the alternatives.

    Args:
        report: The league's.
        trained: That of the ways to train.
    """
    arm, share = errors_of(report, "so101", "mean"), values(trained, "pays/pendulum/swing_up/")
    best = min((e for e in arm if e != "ours"), key=lambda e: arm[e])
    ours, wide, sheet = (100 * share[f"{way}/success"] for way in ("posterior", "wide", "data_sheet"))
    return (
        f"Of an SO-101 arm, motions that no fit saw are predicted to {arm['ours']:.1f} mrad; by the best other tool, "
        f"{NAMES[best]}, to {arm[best]:.1f} mrad. Policies trained on the identified model swing simulated pendulums "
        f"up in {ours:.0f} % of the deployments; with wide randomisation {wide:.0f} %, with data-sheet values "
        f"{sheet:.0f} %.\n"
    )


def evidence(report: Report) -> str:
    """Return README's evidence: our errors beside the best of the others, and the exceptions."""
    lines, lost = [], ""
    for name in sets_of(report):
        errors, unit = errors_of(report, name, "mean"), unit_of(report, name)
        best = min((e for e in errors if e != "ours"), key=lambda e: errors[e])
        what = LABELS.get(name, name)
        ours, other = f"{errors['ours']:.1f} {unit}", f"{errors[best]:.1f} {unit}"
        if errors["ours"] < errors[best]:
            lines.append((what, ours, other, NAMES[best], with_expected(parts(report, name)[0])))
        else:
            lost += f"\nsim2real loses on the {what}: {ours} against {other} ({NAMES[best]}).\n"
    head = ("recorded robot", "sim2real", "best other tool", "which is", "worst part of sim2real (expected)")
    return f"{markdown(head, lines, 'lrrlr')}\n{about_budget(report)}{about_exceptions(report)}{lost}"
