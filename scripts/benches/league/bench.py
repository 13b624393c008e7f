"""The league: all recordings, with parts held out in turn, fitted by sim2real and by the tools of others.

    python scripts/bench.py league --data DIR --json reports/league.json
    python scripts/bench.py league --data DIR --sets xl330 --entrants bam_m1 bam_m6 --budget-s 20 --results league.jsonl

Each entrant fits the same parts of the same recordings within the same processor time, compilation included, and
predicts the held-out part. The settings of its pipeline determine the time of ours, which is reported. The rows are
mean and worst over the folds of a set. --jobs runs several fits at once, each in its own process on one processor.
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
from typing import Any

import numpy as np

from benches import figures, jobs
from benches.figures import Report, Row
from benches.identify.sysid import Recording
from benches.league import bam as league_bam
from benches.league import mujoco_joints as league_mujoco
from benches.league import ours as league_ours
from benches.league.sets import SETS, Fold
from sim2real.errors import UsageError

Predict = Callable[[Sequence[Recording]], list[np.ndarray]]
Fitted = tuple[Predict, str]
ENTRANTS = {
    "ours": "sim2real identify with the pipeline's settings; go2 and sts3250 only with --mjcf and --log",
    "sysid": "mujoco.sysid with a user's terms: gain, damping, dry friction, inertia; no delay",
    "sysid_delay": "mujoco.sysid with a delay and our terms",
    "pace": "PACE's form: inertia, damping, friction, bias of each joint, a delay in steps; CMA-ES",
    "bam_m1": "BAM M1: Coulomb and viscous friction; CMA-ES",
    "bam_m6": "BAM M6: Stribeck, load, direction, quadratic; CMA-ES",
}
QUICK: dict[str, Any] = {"budget_s": 0.2, "folds": 1, "samples": 120, "entrants": [e for e in ENTRANTS if e != "ours"]}


class NoFormError(Exception):
    """An entrant has no form for a set; the message is the reason."""


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of this bench."""
    parser.add_argument("--data", type=Path, required=True, help="folder of all recordings")
    parser.add_argument("--sets", nargs="+", choices=list(SETS), default=list(SETS))
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
    return {"rows": rows(measured), "folds": measured}


_KEY = ("set", "fold", "entrant", "budget_s", "seed")


def _tasks(options: argparse.Namespace) -> dict[tuple[Any, ...], tuple[str, Fold, str]]:
    """Return the fits to do: key in --results -> set, fold and entrant."""
    tasks = {}
    for name in options.sets:
        league_set = SETS[name]
        if not (options.data / league_set.folder).is_dir():
            print(f"{options.data / league_set.folder} is not there: {name} is skipped", file=sys.stderr)
            continue
        for fold in league_set.folds(options.data)[: options.folds]:
            for entrant in options.entrants:
                tasks[name, fold.name, entrant, options.budget_s, options.seed] = (name, fold, entrant)
    return tasks


def judge(name: str, fold: Fold, entrant: str, options: argparse.Namespace) -> dict[str, Any]:
    """Return one entrant's figure on one fold of a set, or the reason why it has none."""
    league_set = SETS[name]
    short = replace(fold, fitted=_short(fold.fitted, options.samples), test=_short(fold.test, options.samples))
    begin = time.process_time()
    try:
        predict, summary = fit(name, short, entrant, options)
        seconds = time.process_time() - begin
        each = [league_set.score(p, r) for p, r in zip(predict(short.test), short.test, strict=True)]
    except NoFormError as reason:
        return {"value": None, "seconds": None, "summary": str(reason)}
    value = float(np.mean(each))
    return {"value": value if np.isfinite(value) else None, "seconds": seconds, "summary": summary}


def fit(name: str, fold: Fold, entrant: str, options: argparse.Namespace) -> Fitted:
    """Fit one entrant; return its predictor and a summary; raise NoFormError if it has no form for such a rig."""
    budget_s, seed = options.budget_s, options.seed
    if entrant == "ours":
        return league_ours.fit(name, fold, options.data, seed)
    if entrant.startswith("bam"):
        if name == "go2":
            raise NoFormError("BAM's form is a bench with one joint and a given load; a leg's load is not one number")
        kind = entrant.removeprefix("bam_").upper()
        load = league_bam.DISK_LOAD if name == "disk" else league_bam.ARM_LOAD if name == "so101" else {}
        loaded = replace(fold, fitted=tuple(_loaded(r, load) for r in fold.fitted))
        predict, summary = _joint_by_joint(loaded, lambda rs, s: league_bam.fit(kind, rs, s, seed), budget_s)
        return lambda recordings: predict([_loaded(r, load) for r in recordings]), summary
    if name == "go2":
        rig = league_mujoco.legs(fold.fitted[0])
        return _mujoco(entrant, rig, fold.fitted, budget_s, seed)
    rig = league_mujoco.one_joint(name)
    return _joint_by_joint(fold, lambda rs, s: _mujoco(entrant, rig, rs, s, seed), budget_s)


def _mujoco(entrant: str, rig: Any, fitted: Sequence[Recording], budget_s: float, seed: int) -> Fitted:
    if entrant == "pace":
        return league_mujoco.fit_pace(rig, fitted, budget_s, seed)
    return league_mujoco.fit_sysid(rig, fitted, entrant == "sysid_delay", budget_s, seed)


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

    return predict, "; ".join(dict.fromkeys(summary for _, summary in fits))


def _loaded(recording: Recording, load: dict[str, Any]) -> Recording:
    return replace(recording, constants={**load, **recording.constants})


def _short(recordings: tuple[Recording, ...], samples: int | None) -> tuple[Recording, ...]:
    return tuple(_first(r, samples) for r in recordings) if samples else recordings


def _first(recording: Recording, samples: int) -> Recording:
    cut = recording.part(0, samples)
    constants = {n: v[:samples] if isinstance(v, np.ndarray) else v for n, v in recording.constants.items()}
    return replace(cut, constants=constants)


def rows(measured: Sequence[dict[str, Any]]) -> list[Row]:
    """Return mean and worst over the folds of each set and entrant, or the reason why there is no figure."""
    table = []
    for name in dict.fromkeys(r["set"] for r in measured):
        for entrant in dict.fromkeys(r["entrant"] for r in measured if r["set"] == name):
            selected = [r for r in measured if r["set"] == name and r["entrant"] == entrant]
            values, unit = [r["value"] for r in selected if r["value"] is not None], SETS[name].unit
            lost = f", {len(selected) - len(values)} without a figure" if len(values) < len(selected) else ""
            took = [r["seconds"] for r in selected if r["seconds"] is not None]
            spent = f"{len(selected)} folds, {np.median(took):.0f} s of processor time a fit{lost}" if took else ""
            about = spent if values else selected[0].get("summary", "")
            for what, of in (("mean", np.mean), ("worst", np.max)):
                value = float(f"{of(values):.4g}") if values else None
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
