"""The doctor on robots drawn at random, each deployed with one fault, with two, or with none.

With ``--efferent`` the package efferent, if it is installed, audits the same deployments.
"""

from __future__ import annotations

import argparse
import itertools
import os
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from benches.robots_that_fail import FAULTS, KINDS, Robot, deploy, draw, draw_faults, kinds_for, write_case
from benches.rows import Report, Row, row
from sim2real.doctor.contract import Policy, read_policy
from sim2real.doctor.diagnosis import diagnose
from sim2real.doctor.log import read_deployment
from sim2real.doctor.plant import Drives, driven_joints

QUICK = {"robots": 1, "sound": 1, "pairs": 1, "seconds": 4.0, "kinds": ["pendulum"], "faults": ["scale"]}


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of this bench."""
    parser.add_argument("--robots", type=int, default=10, help="robots for each fault")
    parser.add_argument("--sound", type=int, default=40, help="robots without a fault")
    parser.add_argument("--pairs", type=int, default=20, help="robots with two faults")
    parser.add_argument("--seconds", type=float, default=15.0, help="length of a deployment [s]")
    parser.add_argument("--faults", nargs="*", default=list(FAULTS), help="faults that are drawn")
    parser.add_argument("--kinds", nargs="*", default=list(KINDS), help="kinds of robots that are drawn")
    parser.add_argument("--efferent", action="store_true", help="contract faults alone, audited by efferent too")
    parser.add_argument("--workers", type=int, default=min(2, os.cpu_count() or 1), help="deployments at a time")
    parser.add_argument("--first-seed", type=int, default=0, help="seed of the first robot")


def one(seconds: float, beside: bool, case: tuple[str, int, tuple[str, ...]]) -> tuple[list[str], float, list[str]]:
    """Deploy a robot with faults; return what the doctor names, its time [s], and what efferent names."""
    kind, seed, faults = case
    rng = np.random.default_rng([seed, 7])
    robot = draw(kind, seed)
    signals = deploy(robot, draw_faults(robot, faults, rng), seconds, rng)
    with tempfile.TemporaryDirectory() as folder:
        files = write_case(robot, signals, Path(folder), rng)
        begin = time.perf_counter()
        joints = tuple(driven_joints(files["mjcf"]))
        policy = read_policy(files["policy"], files["contract"], joints)
        log = read_deployment(files["log"], policy.contract.joints, joints)
        found = diagnose(policy, log, Drives(files["mjcf"], policy.contract), None, joints)
        took_s = time.perf_counter() - begin
        return found.faults, took_s, audit(robot, signals, Path(folder)) if beside else []


_NO_CONTRACT = ("rate", "delay", "gain", "torque limit")
_HINTS = {"PERMUTATION": ("joint order", "left and right"), "WORLD-frame": ("world frame",), "SIGN FLIP": ("sign",),
          "scale": ("scale",), "DEGREES": ("scale",), "PREVIOUS step": ("delay",)}  # fmt: skip
"""Words of efferent's hints -> the faults that they name."""


def audit(robot: Robot, signals: dict[str, np.ndarray], folder: Path) -> list[str]:
    """Return the faults that efferent names in a deployment; ``wrong``: it finds a difference.

    Its audit gets all signals of the log, and the newest step of each term: it stacks a history in another way than
    these policies. Its doctor gets the network with what it was given and gave.
    """
    import efferent
    import onnx
    import yaml

    c = robot.contract
    terms = [("joint_pos_rel" if t.kind == "joint_pos" else {"ang_vel": "base_ang_vel", "gravity": "projected_gravity"}
              .get(t.kind, t.kind), t) for t in c.observation]  # fmt: skip
    names = [f"c{i}" for i in range(signals["command"].shape[1])]
    graph = onnx.load_from_string(robot.network).graph
    manifest = {
        "policy": {"input": graph.input[0].name, "output": graph.output[0].name},
        "control": {"rate_hz": c.rate_hz, "action_scale": c.per_joint("action_scale").tolist()},
        "joints": [{"name": j, "default": float(p)} for j, p in
                   zip(c.joints, c.per_joint("default_joint_pos"), strict=True)],
        "observation": [{"term": name, "scale": t.scale} | ({"names": names} if name == "command" else {})
                        for name, t in terms],
    }  # fmt: skip
    (folder / "manifest.yaml").write_text(yaml.safe_dump(manifest))
    newest = np.concatenate([signals["observation"][:, c.block(i, 0)] for i in range(len(terms))], axis=1)
    given = {k: signals[k] for k in ("t", "q", "dq", "quat", "gyro", "command", "action") if k in signals}
    np.savez(folder / "audit.npz", obs=newest, **given)
    report = efferent.audit(folder / "manifest.yaml", folder / "audit.npz")
    hints = " ".join(term.hint for term in report.terms)
    named = {fault for word, faults in _HINTS.items() if word in hints for fault in faults}
    (folder / "network.onnx").write_bytes(robot.network)
    late = signals["t"] > 0.6  # a walking robot's actions are blended in before
    seen = Policy(robot.network, c).normalised(signals["observation"])
    np.savez(folder / "replay.npz", obs=seen[late], actions=signals["action"][late])
    replay = efferent.doctor(
        folder / "network.onnx", manifest=folder / "manifest.yaml", reference=folder / "replay.npz"
    )
    if any(check.name == "reference replay" for check in replay.failures):
        named.add("normaliser")
    return sorted(named) + ["wrong"] * (not report.passed)


def run(options: argparse.Namespace) -> Report:
    """Diagnose all robots."""
    cases: list[tuple[str, int, tuple[str, ...]]] = []
    if options.efferent:
        options.faults = [fault for fault in options.faults if fault not in _NO_CONTRACT]
    seeds = range(options.first_seed, options.first_seed + 1000)
    chosen = lambda faults: [k for k in kinds_for(faults) if k in options.kinds]  # noqa: E731
    for fault in options.faults:
        kinds = chosen((fault,))
        cases += [(kinds[i % len(kinds)], seed, (fault,)) for i, seed in zip(range(options.robots), seeds) if kinds]  # noqa: B905
    cases += [(options.kinds[i % len(options.kinds)], seed, ()) for i, seed in zip(range(options.sound), seeds)]  # noqa: B905
    pairs = [p for p in itertools.combinations(options.faults, 2) if chosen(p) and not _one_thing(p)]
    drawn = np.random.default_rng(options.first_seed).permutation(len(pairs))[: options.pairs]
    cases += [(chosen(pairs[p])[i % len(chosen(pairs[p]))], seeds[i], pairs[p]) for i, p in enumerate(drawn)]

    with ProcessPoolExecutor(options.workers, get_context("spawn")) as pool:
        results = list(pool.map(partial(one, options.seconds, options.efferent), cases))
    rows: list[Row] = []
    of = lambda wanted: [(set(n), set(e)) for (_, _, f), (n, _, e) in zip(cases, results, strict=True) if wanted(f)]  # noqa: E731
    for fault in options.faults:
        own = of(lambda faults, fault=fault: faults == (fault,))
        hits, more = sum(fault in named for named, _ in own), sum(len(named - {fault}) > 0 for named, _ in own)
        theirs = (
            f"; efferent names {sum(fault in e for _, e in own)}, and finds {sum('wrong' in e for _, e in own)} wrong"
        )
        if own:
            text = f"{more} with another name too{theirs * options.efferent}"
            rows.append(row(f"doctor/{fault}", hits, f"of {len(own)}", text, f">= {0.9 * len(own):g}"))
    sound = of(lambda faults: not faults)
    text = f"efferent: {sum(bool(e) for _, e in sound)}" * options.efferent
    rows.append(row("doctor/false alarms", sum(bool(n) for n, _ in sound), f"of {len(sound)}", text, "<= 2"))
    if both := [set(f) <= set(n) for (_, _, f), (n, _, _) in zip(cases, results, strict=True) if len(f) == 2]:
        rows.append(row("doctor/two faults", sum(both), f"of {len(both)}", "", f">= {0.6 * len(both):g}"))
    slowest = max(took_s for _, took_s, _ in results)
    rows.append(
        row("doctor/longest", round(slowest, 1), "s", f"logs of {options.seconds:g} s, {options.workers} processes", "")
    )
    listed = [{"kind": k, "seed": s, "faults": list(f), "named": n, "took_s": round(t, 1), "efferent": e}
              for (k, s, f), (n, t, e) in zip(cases, results, strict=True)]  # fmt: skip
    return {"rows": rows, "cases": listed}


def _one_thing(pair: tuple[str, ...]) -> bool:
    """Return whether two faults are set in the same place, so that a deployment has only one of them."""
    same = [{"joint order", "left and right"}, {"gyro rotated twice", "world frame"}]
    same += [{"frozen imu", "gyro rotated twice"}, {"frozen imu", "world frame"}]
    return any(set(pair) <= places for places in same)


def table(report: Report) -> str:
    """Return how many faults were named, those that were missed, false alarms and pairs."""
    of = {r["name"].removeprefix("doctor/"): r for r in report["rows"]}
    faults = {name: of[name] for name in report["flags"]["faults"]}
    named, judged = (
        sum(int(n) for n in counts)
        for counts in zip(*((r["value"], r["unit"].split()[1]) for r in faults.values()), strict=True)
    )
    extra = [n for n, r in faults.items() if not r["yardstick"].startswith("0 ")]
    less = [f"{n} {r['value']} {r['unit']}" for n, r in faults.items() if r["value"] < int(r["unit"].split()[1])]
    alarms, pairs = (f"{of[name]['value']} {of[name]['unit']}" for name in ("false alarms", "two faults"))
    robots = f"{report['flags']['robots']} robots for each of {len(faults)}"
    return (
        f"Named: {named} of {judged} faults, {robots} ({', '.join(faults)})"
        + (f", fewer of {', '.join(less)}" if less else "")
        + (f"; a second name beside the right one for {', '.join(extra)}" if extra else "")
        + f". False alarms: {alarms} sound robots. Both of two faults: {pairs}. Longest: {of['longest']['value']} s.\n"
    )
