"""A simulated arm of seven joints whose own controller carries its weight, from two logs and a model to a verdict.

The model has the arm's geometry and masses, and the maker's gains; the hidden arm has others, and friction of its own.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np

from benches.rows import Report, four_digits, row, values
from sim2real.artifacts.identification import Identification

QUICK = {"seconds": 6.0, "joints": 2, "terms": "gravcomp"}
LENGTHS, MASSES = (0.333, 0.15, 0.166, 0.15, 0.19, 0.1, 0.107), (3.0, 3.5, 2.5, 2.5, 3.0, 1.5, 0.8)
KP, KV = (600, 600, 500, 500, 250, 150, 50), (60, 60, 50, 50, 25, 20, 8)
SHARES = (1.08, 0.93, 1.05, 0.9, 1.1, 0.95, 1.02)
"""The hidden gains, as shares of the maker's."""
DRY, VISCOUS = (1.2, 1.5, 0.9, 1.0, 0.5, 0.4, 0.2), (2.0, 2.5, 1.8, 1.6, 0.8, 0.5, 0.3)
ROTOR = (0.3, 0.35, 0.25, 0.25, 0.1, 0.08, 0.04)
STEP_S, DELAY_STEPS, PERIOD, NOISE_RAD = 1e-3, 6, 4, 1e-4


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of this bench."""
    parser.add_argument("--seconds", type=float, default=30.0, help="length of each of the two logs")
    parser.add_argument("--joints", type=int, default=7, help="the first joints of the arm")
    parser.add_argument("--terms", default="auto", help="optional terms")


def run(options: argparse.Namespace) -> Report:
    """Record two logs of the hidden arm, identify it by the command, and compare with the truth."""
    joints = options.joints
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        (place / "arm.xml").write_text(model(joints, hidden=False))
        for seed in (1, 2):
            np.savez(place / f"log{seed}.npz", **recorded(joints, options.seconds, seed))
        command = [sys.executable, "-m", "sim2real.cli", "identify", "--mjcf", "arm.xml", "--terms", options.terms]
        begun = time.monotonic()
        ended = subprocess.run([*command, "--log", "log1.npz", "--log", "log2.npz"], cwd=place, check=False)
        wall_s = time.monotonic() - begun
        document = Identification.load(next(place.glob("runs/arm/*/identify")))
    found = {p.name: p.estimate for p in document.parameters}
    stiffness = [_of(found, "kp", i) / (kp * share) - 1.0 for i, (kp, share) in enumerate(_firsts(joints, KP, SHARES))]
    off = float(np.abs(stiffness).max())
    return {
        "rows": [
            row("carried/seconds", round(wall_s), "s", f"exit code {ended.returncode}"),
            row("carried/terms", ", ".join(document.terms or ()), "", "the controller carries all of the weight"),
            row("carried/gravcomp", four_digits(found.get("gravcomp", 0.0)), "1", "1"),
            row("carried/stiffness_error", round(100 * off, 2), "%", "largest of the joints; of the model 11"),
            row("carried/verdict", document.verdict.status, ""),
        ]
    }


def model(joints: int, hidden: bool) -> str:
    """Return the arm as MJCF: as its maker describes it, or the hidden one."""
    head, drives = "", ""
    for i in range(joints):
        own = f'frictionloss="{DRY[i]}" damping="{VISCOUS[i]}" armature="{ROTOR[i]}"'
        usual = own if hidden else 'armature="0.1" damping="1" frictionloss="0.3"'
        below = LENGTHS[i - 1] if i else 0.1
        head += f'<body name="link{i + 1}" pos="0 0 {below}"><joint name="joint{i + 1}" axis="0 {i % 2} {1 - i % 2}" '
        head += f'range="-2.8 2.8" {usual}/><geom type="capsule" size="0.05" fromto="0 0 0 0.03 0 {LENGTHS[i]}" '
        head += f'mass="{MASSES[i]}" contype="0" conaffinity="0"/>'
        kp = KP[i] * (SHARES[i] if hidden else 1.0)
        drives += f'<position name="joint{i + 1}" joint="joint{i + 1}" kp="{kp}" kv="{KV[i]}"/>'
    options = f'<compiler angle="radian"/><option timestep="{STEP_S}" integrator="implicitfast"/>'
    bodies = f"<worldbody>{head}{'</body>' * joints}</worldbody>"
    return f'<mujoco model="arm">{options}{bodies}<actuator>{drives}</actuator></mujoco>'


def recorded(joints: int, seconds: float, seed: int) -> dict[str, np.ndarray]:
    """Return a log of the hidden arm, which follows sums of sines: stamps [s], angles and goals [rad]."""
    rng, hidden = np.random.default_rng(seed), mujoco.MjModel.from_xml_string(model(joints, hidden=True))
    data, still = mujoco.MjData(hidden), mujoco.MjData(hidden)
    t_s = STEP_S * np.arange(round(seconds / STEP_S))
    goals = np.zeros((len(t_s), joints))
    for j in range(joints):
        for hz in rng.uniform(0.05, 1.0, 5):
            goals[:, j] += rng.uniform(0.1, 0.5) / (1 + hz) * np.sin(2 * np.pi * hz * t_s + rng.uniform(0, 6))
    goals *= np.minimum(1.0, t_s / 2.0)[:, None]
    angles = np.zeros_like(goals)
    for i in range(len(t_s)):
        angles[i] = data.qpos
        data.ctrl[:] = goals[max(0, i - DELAY_STEPS)]
        # The controller carries the weight: forces without speed.
        still.qpos[:] = data.qpos
        mujoco.mj_forward(hidden, still)
        data.qfrc_applied[:] = still.qfrc_bias
        mujoco.mj_step(hidden, data)
    some = slice(0, None, PERIOD)
    measured = angles[some] + rng.normal(0.0, NOISE_RAD, angles[some].shape)
    return {"t_s": t_s[some], "q_rad": measured, "q_goal_rad": goals[some]}


def _firsts(joints: int, *rows: Sequence[float]) -> list[tuple[float, ...]]:
    return list(zip(*(row[:joints] for row in rows), strict=True))


def _of(values: dict[str, float], quantity: str, joint: int) -> float:
    """Return a quantity of a joint: that of its group, or of all, times its own share."""
    ends = f"joint{joint + 1}"
    group = next((v for n, v in values.items() if n.startswith(f"{quantity}_joint") and ends in n.split("_")), None)
    return (values[quantity] if group is None else group) * values.get(f"{quantity}_of_{ends}_alone", 1.0)


def table(report: Report) -> str:
    """Return the result for an arm that carries its own weight."""
    v, truth = values(report, "carried/"), {r["name"]: r["yardstick"] for r in report["rows"]}
    model = truth["carried/stiffness_error"].rpartition(" ")[2]
    return (
        f"`auto` chooses the terms `{v['terms']}`. The controller carries {v['gravcomp']:.2f} of the weight (true: "
        f"{truth['carried/gravcomp']}).\nStiffnesses are {v['stiffness_error']:.1f} % off, the maker's {model}. "
        f"Verdict: {v['verdict']}, after {v['seconds'] / 60:.0f} min on "
        f"{report['machine']['cores']} cores.\n"
    )
