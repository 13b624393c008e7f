"""The latency league: six emulated links, whose delays four methods estimate from recordings of a hidden servo.

    python scripts/bench.py latency-league --jobs 2 --json reports/latency_league.json

The servo gets goals a fixed time after they were sent. Each measurement shows the motion a hidden time before its
stamp, with noise and the counts of an encoder. Every method but the correlation fits the same servo: stiffness,
damping, dry friction and inertia. The rows are, for each link and method, the root mean square errors of the estimated
mean, of the 95th percentile and of the share of lost messages, over recordings that differ in goals, delays and noise.
For all links together: in how many recordings the 95 % intervals contain the truth, with the exact interval of that
share.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import mujoco
import numpy as np
from mujoco.rollout import rollout
from scipy.optimize import least_squares

from benches import jobs
from benches.recorded import rigs
from benches.recorded.sets import Recording
from benches.rows import Report, Row, four_digits, markdown, row, share
from sim2real.identification.delays import DelayEvidence, find, lost_share

KINDS = {
    "fixed": "8 ms",
    "gaussian": "8 ms, deviation 1.5 ms",
    "usb": "half of the messages 1 to 2 ms, half wait for a timer of 16 ms",
    "tail": "4 ms and a Pareto tail: 5 % above 10 ms",
    "losses": "6 ms, 2 % lost, 2 % after a retry of 5 ms",
    "steps": "5 ms, 9 ms after 60 % of the recording, and a clock that gains 100 us/s",
}
"""Link -> its delays, without those of the commands."""
COMMAND_DELAY_S, PERIOD_S, NOISE_RAD, COUNT_RAD = 0.006, 0.01, 5e-4, 2 * np.pi / 4096
DRIFT, RETRIED, LOST = 100e-6, 0.02, 0.02
SERVO = """<mujoco><option timestep="{step}" gravity="0 0 0" integrator="implicitfast"/><worldbody><body>
<joint name="j" axis="0 1 0" armature="{armature}" damping="{damping}" frictionloss="{friction}"
 solreffriction="{hold} 1" solimpfriction="0.999 0.999 0.001"/>
<inertial pos="0 0 0" mass="1" diaginertia="0.001 0.001 0.001"/></body></worldbody>
<actuator><position joint="j" kp="{kp}"/></actuator><sensor><jointpos joint="j"/></sensor></mujoco>"""
TRUE = {"kp": 20.0, "damping": 0.9, "friction": 0.1, "armature": 0.02}
"""The hidden servo: N m/rad, N m s/rad, N m, kg m^2."""


@dataclass(frozen=True)
class Log:
    """A recording of a control loop.

    Attributes:
        t: Shape ``(N,)``: when a goal was sent and a measurement was stamped [s].
        goal: Shape ``(N,)`` [rad].
        position: Shape ``(N,)`` [rad].
        lost: Shape ``(N,)``, bool: measurements that repeat the one before.
    """

    t: np.ndarray
    goal: np.ndarray
    position: np.ndarray
    lost: np.ndarray


@dataclass(frozen=True)
class Truth:
    """What a link does in the long run: mean and 95th percentile with the commands' delay [s], share of losses."""

    mean: float
    p95: float
    lost: float


def motion(t: np.ndarray, goal: np.ndarray, length_s: float, step_s: float, **servo: float) -> np.ndarray:
    """Return the servo's angles at the times ``0, step_s, ...``, for goals that hold from the times ``t`` on.

    The integrator applies forces at the begin of a step, half a step early, and damping that is half a step late, which
    acts like an inertia. Both are taken back: a fit would turn them into a delay.
    """
    servo["armature"] = max(servo["armature"] - 0.5 * step_s * servo["damping"], 0.0)
    model = mujoco.MjModel.from_xml_string(SERVO.format(step=step_s, hold=2 * step_s, **servo))
    ticks = step_s * np.arange(round(length_s / step_s))
    # A step in which the goal changes gets the mean of both.
    edges = np.concatenate([[-1.0], t + 0.5 * step_s, [length_s + 1.0]])
    total = np.concatenate([[0.0], np.cumsum(np.concatenate([goal[:1], goal]) * np.diff(edges))])
    control = np.diff(np.interp(np.append(ticks, length_s), edges, total)) / step_s
    state = np.zeros(mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS))
    state[1] = goal[0]
    states, _ = rollout(model, mujoco.MjData(model), state[None], control[None, :, None])
    return np.concatenate([[goal[0]], states[0, :-1, 1]])


def delays(kind: str, t: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return the delays of measurements with the stamps ``t (N,)`` [s], and which of them are lost."""
    n, lost = len(t), np.zeros(len(t), bool)
    if kind == "fixed":
        return np.full(n, 0.008), lost
    if kind == "gaussian":
        return np.maximum(rng.normal(0.008, 0.0015, n), 0.0), lost
    if kind == "usb":
        waits = 0.001 + np.mod(0.016 * rng.random() + t, 0.016)
        return np.where(rng.random(n) < 0.5, rng.uniform(0.001, 0.002, n), waits), lost
    if kind == "tail":
        return np.minimum(0.003 + 0.001 * (1.0 + rng.pareto(1.5, n)), 0.05), lost
    if kind == "losses":
        fate = rng.random(n)
        retried = (fate >= LOST) & (fate < LOST + RETRIED)
        return rng.normal(0.006, 0.0005, n) + 0.005 * retried, fate < LOST
    return np.where(t < 0.6 * t[-1], 0.005, 0.009) + rng.normal(0.0, 0.0003, n) + DRIFT * (t - t.mean()), lost


def log(kind: str, length_s: float, seed: int) -> Log:
    """Record a motion of the servo over a link."""
    rng, step_s = np.random.default_rng(seed), 2.5e-4
    t = np.arange(0.0, length_s, PERIOD_S) + rng.uniform(0.0, 1e-3, round(length_s / PERIOD_S))
    waves, phases = rng.uniform(0.3, 3.0, 6), rng.uniform(0.0, 2 * np.pi, 6)
    goal = 0.15 * np.sin(2 * np.pi * waves * t[:, None] + phases).sum(axis=1)
    angle = motion(t + COMMAND_DELAY_S, goal, length_s + 0.1, step_s, **TRUE)
    took, lost = delays(kind, t, rng)
    noisy = np.interp(t - took, step_s * np.arange(len(angle)), angle) + rng.normal(0.0, NOISE_RAD, len(t))
    counts = np.round(noisy / COUNT_RAD) * COUNT_RAD
    lost[0] = False
    last = np.maximum.accumulate(np.where(lost, 0, np.arange(len(t))))  # the loop uses the newest that it has
    return Log(t, goal, counts[last], lost)


def truth(kind: str, length_s: float) -> Truth:
    """Return what a link does in many recordings of a length."""
    rng, t = np.random.default_rng(1), np.arange(0.0, length_s, PERIOD_S)
    took, lost = (np.concatenate(x) for x in zip(*(delays(kind, t, rng) for _ in range(200)), strict=True))
    arrived = took[~lost] + COMMAND_DELAY_S
    return Truth(float(arrived.mean()), float(np.quantile(arrived, 0.95)), LOST if lost.any() else 0.0)


STEP_S, LONGEST_S = 0.001, 0.08
GUESS = {"kp": 14.0, "damping": 0.6, "friction": 0.05, "armature": 0.03}
"""Assumed values of the servo before it is fitted, by every method."""
_DIFFERENCE, _EVERY = 0.01, 2
PACE_STEP_S, SEARCH_S = 0.0025, 8.0
"""PACE's time step, whose multiples its delays are; processor time of its and mujoco.sysid's search [s]."""
Ends = tuple[float, float] | None


@dataclass(frozen=True)
class Estimate:
    """An estimate of a link: times with the commands' delay [s], and 95 % intervals; None: the method gives none."""

    mean: float
    p95: float
    lost: float = 0.0
    mean95: Ends = None
    p95_95: Ends = None


def ours(log: Log, seed: int) -> Estimate:
    """Fit the servo and one constant delay, then the distribution of the delays, as ``identify --links`` does."""
    del seed  # it draws nothing
    names, grid = list(GUESS), np.arange(0.0, LONGEST_S + STEP_S / 2, STEP_S)

    def angles(x: np.ndarray) -> np.ndarray:
        servo = dict(zip(names, np.exp(x).tolist(), strict=True))
        return motion(log.t, log.goal, float(log.t[-1]) + 0.01, STEP_S, **servo)

    def at(stamps: np.ndarray, simulated: np.ndarray) -> np.ndarray:
        return np.interp(stamps, STEP_S * np.arange(len(simulated)), simulated)

    def constant(x: np.ndarray) -> np.ndarray:
        return (at(log.t - x[-1], angles(x[:-1])) - log.position)[::_EVERY] / NOISE_RAD

    begin = np.append(np.log(list(GUESS.values())), 0.01)
    limits = (begin - np.append(np.full(4, 2.5), 0.01), begin + np.append(np.full(4, 2.5), LONGEST_S - 0.03))
    first = least_squares(constant, begin, bounds=limits, diff_step=_DIFFERENCE, x_scale=np.append(np.ones(4), 0.01))

    def linearise(x: np.ndarray, delay_s: float) -> DelayEvidence:
        simulated, stamps = angles(x), log.t - delay_s
        errors = at(log.t[:, None] - grid, simulated) - log.position[:, None]
        slopes = [at(stamps, angles(x + s) - simulated) / _DIFFERENCE for s in _DIFFERENCE * np.eye(len(x))]
        J = np.stack(slopes, axis=1)[:, None] / NOISE_RAD
        return DelayEvidence(grid, errors[:, None] / NOISE_RAD, J, 1e-2 * np.eye(len(x)))

    again = np.concatenate([[False], np.diff(log.position) == 0.0])
    estimate = find(linearise, first.x[:-1], float(first.x[-1]), again)
    mean, _, p95 = estimate.ranged()
    ends = [(float(r.low95 or 0.0), float(r.high95 or 0.0)) for r in (mean, p95)]
    lost = float(lost_share(estimate.lost).value or 0.0)
    return Estimate(float(mean.value or 0.0), float(p95.value or 0.0), lost, *ends)


def _put_friction(spec: mujoco.MjSpec, value: float) -> None:
    rigs.of_joint("frictionloss")(spec, value)
    joint = spec.joint(rigs.JOINT)
    joint.solref_friction, joint.solimp_friction[:2] = [2 * spec.option.timestep, 1.0], 0.999


def _problem(log: Log, step_s: float) -> tuple[rigs.Rig, Recording]:
    """Return the servo as a rig, and the recording for the toolbox."""
    puts = {
        "kp": rigs.put_kp,
        "damping": rigs.of_joint("damping"),
        "friction": _put_friction,
        "armature": rigs.of_joint("armature"),
    }
    rows = {name: (guess, guess / 5, guess * 5, puts[name]) for name, guess in GUESS.items()}
    spec, start = rigs.hinge(step_s, 1e-9, 0.1, 0.01), np.array([[log.position[0], 0.0]])
    recording = Recording(log.t, log.goal[:, None], log.position[:, None], start)
    return rigs.Rig(lambda r: [rigs.Run(r, spec)], rows, {}, rows), recording


def sysid(log: Log, seed: int) -> Estimate:
    """Fit the servo and mujoco.sysid's delay of the sensor within PACE's time; no interval."""
    rig, recording = _problem(log, STEP_S)
    # The toolbox stamps a reading at the end of the step at whose begin it was taken.
    return _constant(rigs.fit_sysid(rig, [recording], True, SEARCH_S, seed).value("delay") + 0.5 * STEP_S)


def pace(log: Log, seed: int) -> Estimate:
    """Fit the servo, an encoder's bias and a delay in whole steps by CMA-ES, as PACE does; it gives no interval."""
    rig, recording = _problem(log, PACE_STEP_S)
    return _constant(rigs.fit_pace(rig, [recording], SEARCH_S, seed).value("delay") + 0.5 * PACE_STEP_S)


def correlation(log: Log, seed: int) -> Estimate:
    """Return the lag at which the measured positions correlate most with the goals."""
    del seed
    lags = np.arange(0.0, 3 * LONGEST_S, STEP_S)
    held = [log.goal[np.maximum(np.searchsorted(log.t, log.t - lag, side="right") - 1, 0)] for lag in lags]
    return _constant(float(lags[int(np.argmax([np.corrcoef(g, log.position)[0, 1] for g in held]))]))


def _constant(delay_s: float) -> Estimate:
    """Return a delay that is the same for all messages."""
    return Estimate(delay_s, delay_s)


METHODS: dict[str, Callable[[Log, int], Estimate]] = {
    "ours": ours, "sysid": sysid, "pace": pace, "correlation": correlation,
}  # fmt: skip


def timed(method: str, log: Log, seed: int) -> tuple[Estimate, float]:
    """Return the estimate of a method, and its processor time [s]."""
    begin = time.process_time()
    return METHODS[method](log, seed), time.process_time() - begin


QUICK: dict[str, Any] = {"recordings": 1, "length_s": 3.0, "links": ["losses"], "methods": ["ours", "correlation"]}


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of this bench."""
    parser.add_argument("--links", nargs="+", choices=list(KINDS), default=list(KINDS))
    parser.add_argument("--methods", nargs="+", choices=list(METHODS), default=list(METHODS))
    parser.add_argument("--recordings", type=int, default=6, help="of each link")
    parser.add_argument("--length-s", type=float, default=8.0, help="length of a recording")
    parser.add_argument("--seed", type=int, default=0, help="seed of the first recording")
    parser.add_argument("--jobs", type=int, default=1, help="recordings at once, of one thread each")


def run(options: argparse.Namespace) -> Report:
    """Estimate each link from each recording with each method."""
    tasks = [(kind, options.seed + i) for kind in options.links for i in range(options.recordings)]
    done = dict(jobs.each(measure, tasks, options))
    records = [record for i in range(len(tasks)) for record in done[i]["records"]]
    return {"rows": rows(records), "truth": {k: asdict(truth(k, options.length_s)) for k in options.links}}


def measure(kind: str, seed: int, options: argparse.Namespace) -> dict[str, Any]:
    """Return the estimates of all methods from one recording, beside what the link did."""
    recording, true = log(kind, options.length_s, seed), truth(kind, options.length_s)
    records = []
    for method in options.methods:
        estimate, seconds = timed(method, recording, seed)
        errors = {n: getattr(estimate, n) - getattr(true, n) for n in ("mean", "p95", "lost")}
        ends = {"mean": estimate.mean95, "p95": estimate.p95_95}
        held = {n: None if e is None else bool(e[0] <= getattr(true, n) <= e[1]) for n, e in ends.items()}
        about = {"link": kind, "seed": seed, "method": method, "seconds": seconds}
        records.append({**about, "estimate": asdict(estimate), "errors": errors, "held": held})
    return {"records": records}


def rows(records: list[dict[str, Any]]) -> list[Row]:
    """Return errors of each link and method, and the coverage of each method."""
    table, units = [], {"mean": ("ms", 1e3), "p95": ("ms", 1e3), "lost": ("%", 100.0)}
    for method in dict.fromkeys(r["method"] for r in records):
        of_method = [r for r in records if r["method"] == method]
        for kind in dict.fromkeys(r["link"] for r in of_method):
            some = [r for r in of_method if r["link"] == kind]
            for what, (unit, factor) in units.items():
                error = factor * float(np.sqrt(np.mean([r["errors"][what] ** 2 for r in some])))
                name = f"latency/{kind}/{method}/{what}"
                table.append(row(name, four_digits(error), unit, f"the emulation, {len(some)} recordings"))
        for what in ("mean", "p95"):
            held = [r["held"][what] for r in of_method if r["held"][what] is not None]
            if held:
                value, low, high = share(sum(held), len(held))
                about = f"{sum(held)} of {len(held)}, 95 % interval {low:.2f} to {high:.2f}"
                table.append(
                    row(
                        f"latency/all/{method}/held_{what}",
                        four_digits(value),
                        "share",
                        about,
                        ">= 0.95" if method == "ours" else "",
                    )
                )
        seconds = float(np.median([r["seconds"] for r in of_method]))
        table.append(row(f"latency/all/{method}/seconds", four_digits(seconds), "s", "processor time of a recording"))
    return table


NAMES = {"ours": "sim2real", "sysid": "mujoco.sysid", "pace": "PACE", "correlation": "peak of the cross-correlation"}


def table(report: Report) -> str:
    """Return the errors on each link, the coverage of the intervals, and the links that another method wins."""
    of = {r["name"].removeprefix("latency/"): r for r in report["rows"]}
    methods = [m for m in NAMES if f"all/{m}/seconds" in of]
    lines, lost, better = [], [], []
    for kind, true in report["truth"].items():
        errors = {m: {w: of[f"{kind}/{m}/{w}"]["value"] for w in ("mean", "p95", "lost")} for m in methods}
        cells = [f"{errors[m]['mean']:.2f} / {errors[m]['p95']:.2f}" for m in methods]
        lines.append((kind, f"{1e3 * true['mean']:.1f} / {1e3 * true['p95']:.1f}", *cells))
        if true["lost"]:
            shares = [f"{errors[m]['lost']:.2f}" for m in methods]
            lost.append((f"{kind}: share of lost messages [%]", f"{100 * true['lost']:.1f}", *shares))
        for what, name in (("mean", "mean"), ("p95", "95th percentile")):
            better += [f"{NAMES[m]} on {kind} ({name})" for m in methods if errors[m][what] < errors["ours"][what]]
    held = [[of.get(f"all/{m}/held_{what}") for what in ("mean", "p95")] for m in methods]
    counts = ["; ".join(r["yardstick"].partition(", ")[0] for r in rs if r) or "-" for rs in held]
    lines += [*lost, ("truth within the 95 % intervals: mean; 95th percentile", "95 %", *counts)]
    lines.append(
        ("processor time of a recording [s]", "", *(f"{of[f'all/{m}/seconds']['value']:.2g}" for m in methods))
    )
    head = ("link: mean / 95th percentile [ms]", "true", *map(NAMES.__getitem__, methods))
    text = (
        "\nAll but the correlation fit the servo too. PACE's form is re-implemented; its search has a limit of time.\n"
    )
    return markdown(head, lines) + text + (f"\nBetter than sim2real: {', '.join(better)}.\n" if better else "")
