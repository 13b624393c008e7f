"""``identify go2`` on the logs of hidden Go2s in a stand: how near each estimate is to the truth, and its time."""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from benches.hidden import legs
from benches.jobs import each
from benches.rows import Report, Row, four_digits, row, share, values

QUICK = {"twins": 1, "seconds": 12.0, "settings": "quick"}
SETTINGS: dict[str, dict[str, Any]] = {
    "own": {},
    "quick": {"settle_s": 0.1, "horizon_s": 0.5, "refine_steps": 1},
}
CLOSE, CLOSE_S, CLOSE_KG = 0.1, 0.001, 0.3
"""Largest error of a parameter, as a share of the truth, of the sum of the delays [s], and of the load [kg]."""
KINDS = {"damping": "damping", "friction": "friction", "armature": "armature", "strength": "strength of motors"}


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of this bench."""
    parser.add_argument("--twins", type=int, default=20, help="hidden twins")
    parser.add_argument("--seconds", type=float, default=12.0, help="length of a log's excitation [s]")
    parser.add_argument("--jobs", type=int, default=1, help="twins at once, each in a process on one processor")
    parser.add_argument("--settings", choices=tuple(SETTINGS), default="own", help="settings of identify")


def run(options: argparse.Namespace) -> Report:
    """Record and identify all twins."""
    done = [result for _, result in each(one, [(seed,) for seed in range(options.twins)], options)]
    rows: list[Row] = []
    accepted = sum(d["verdict"] == "accepted" for d in done)
    rows.append(_share("legs_identify/accepted", accepted, len(done), "twins"))
    for kind, about in KINDS.items():
        off = np.array([e for d in done for e in d["errors"][kind]])
        rows.append(_share(f"legs_identify/{kind}/close", int((off <= CLOSE).sum()), off.size, f"{about} within 10 %"))
        worst = f"median {four_digits(100 * float(np.median(off)))} %"
        rows.append(row(f"legs_identify/{kind}/worst", four_digits(100 * float(off.max())), "%", worst, "<= 10"))
    whole = sum(max(max(e) for e in d["errors"].values()) <= CLOSE for d in done)
    rows.append(_share("legs_identify/all_close", whole, len(done), "twins with all parameters within 10 %"))
    late = np.array([d["delay_off_s"] for d in done])
    rows.append(_share("legs_identify/delay/close", int((late <= CLOSE_S).sum()), len(done), "delays within 1 ms"))
    rows.append(row("legs_identify/delay/worst", four_digits(1e3 * float(late.max())), "ms", "", "<= 1"))
    loads = np.array([d["load_off_kg"] for d in done])  # infinite where a fit did not converge
    rows.append(_share("legs_identify/load/close", int((loads <= CLOSE_KG).sum()), len(done), "loads within 0.3 kg"))
    worst = f"median {four_digits(float(np.median(loads)))} kg"
    rows.append(row("legs_identify/load/worst", four_digits(float(loads.max())), "kg", worst, f"<= {CLOSE_KG}"))
    held, count = (sum(d[key] for d in done) for key in ("held", "intervals"))
    rows.append(_share("legs_identify/intervals", held, count, "95 % intervals that hold the truth", ">= 0.95"))
    for key, unit in (("wall_s", "s"), ("cpu_s", "s of a processor")):
        times = np.array([d[key] for d in done])
        about = f"median {np.median(times):.0f} s, {os.cpu_count()} processors, {options.jobs} at once"
        rows.append(row(f"legs_identify/{key}", four_digits(float(times.max())), unit, about, "<= 90"))
    return {"rows": rows}


def one(seed: int, options: argparse.Namespace) -> dict[str, Any]:
    """Record a twin, identify it, and compare with its true parameters."""
    from sim2real.artifacts.identification import ROUND_TRIP
    from sim2real.emulation.truth import read_truth
    from sim2real.stages.identify.stage import identify

    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "session.mcap"
        legs.record(log, seed, options.seconds)
        standing = Path(folder) / "standing.mcap"
        legs.record(standing, seed, options.seconds, standing=True)
        header = read_truth(log.with_suffix(".truth.bin")).header
        begin_s, begin_cpu_s = time.perf_counter(), time.process_time()
        identification = identify("go2", log, SETTINGS[options.settings], standing=standing)
        took_s, took_cpu_s = time.perf_counter() - begin_s, time.process_time() - begin_cpu_s
    truth, rows = header["truth"], {p.name: p for p in identification.parameters}
    errors = {
        kind: [abs(p.estimate / truth[n] - 1.0) for n, p in rows.items() if n.endswith(f"_{kind}") and n in truth]
        for kind in KINDS
    }
    late_s = header["config"]["sensing_latency_s"] + header["config"]["actuation_latency_s"]
    inside = [p.low95 <= truth[n] <= p.high95 for n, p in rows.items() if n in truth and p.low95 is not None]
    return {
        "seed": seed,
        "verdict": identification.verdict.status,
        "errors": errors,
        "load_off_kg": abs(rows["payload"].estimate - truth["payload"]) if "payload" in rows else np.inf,
        "delay_off_s": abs(rows[ROUND_TRIP].estimate - late_s),
        "held": int(np.sum(inside)),
        "intervals": len(inside),
        "wall_s": took_s,
        "cpu_s": took_cpu_s,
    }


def _share(name: str, count: int, of: int, about: str, goal: str = ">= 1") -> Row:
    if not of:  # a fit that did not converge has no interval
        return row(name, 0.0, "1", f"0 of 0 {about}", goal)
    part, low, high = share(count, of)
    return row(name, four_digits(part), "1", f"{count} of {of} {about}; 95 % interval {low:.2f} to {high:.2f}", goal)


def table(report: Report) -> str:
    """Return the errors of identified Go2s."""
    v = values(report, "legs_identify/")
    about = {r["name"].removeprefix("legs_identify/"): r["yardstick"] for r in report["rows"]}

    def counted(name: str) -> str:
        return " ".join(about[name].split(" ")[:3])

    worst = ", ".join(f"{kind} {v[f'{kind}/worst']:.2g} %" for kind in KINDS)
    interval = about["all_close"].rpartition("; ")[2].replace("95 % interval ", "")
    slow = " (goal 90, missed)" * (v["cpu_s"] > 90)
    cores, too_few = report["machine"]["cores"], " (goal 95 %, missed)" * (v["intervals"] < 0.95)
    return (
        f"{counted('accepted')} identifications are accepted, and in {counted('all_close')} all parameters are within "
        f"10 % (95 % interval: {interval}). Worst errors: {worst}, delay {v['delay/worst']:.2g} ms, load in the base "
        f"{v['load/worst']:.2g} kg. The 95 % intervals hold the truth in {counted('intervals')} cases{too_few}. On "
        f"{cores} cores an identification takes {v['wall_s']:.0f} s at most, {v['cpu_s']:.0f} s of a processor{slow}.\n"
    )
