"""Faults while a policy runs: time until the motor is safe, readable log, exit code and message of the command.

A deployment of a policy that swings the pendulum runs in one process, an emulated XM430 in another; one fault happens
at a random moment of the motion. The emulator records the time at which the motor stopped: its torque is off, or its
own watchdog has stopped it.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import json
import multiprocessing
import os
import random
import signal
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import numpy as np

from benches.rows import Report, row, values
from sim2real import cli
from sim2real.emulation import process as emulator
from sim2real.emulation.truth import Kind, Truth, read_truth
from sim2real.errors import ERROR, HARDWARE_LOST, SAFETY_STOP, Sim2RealError
from sim2real.hardware.device import OperatingMode
from sim2real.log.reader import TruncatedLogWarning, read_log
from sim2real.policy import PolicyContract, save_bundle
from sim2real.stages.load import load_robot

SAFE_S = 0.2
KILLED, STOPPED, NAN = "killed", "stopped", "nan"
QUICK = {"runs": 1, "faults": ["wild"]}
_START_S, _END_S, _MOVING_V = 60.0, 30.0, 0.1
_TRIES = 4
"""Largest number of starts of a deployment that ends before its fault."""
_ROUND_RAD_S = 15.0
"""Speed from which the pendulum turns over [rad/s]; at low speeds a frozen encoder cannot be detected."""
_SWINGS_S = (0.2, 1.2)
"""Range of the time between that speed and the fault [s]."""


class NotBegun(Sim2RealError):  # noqa: N818
    """The deployment ended before the fault."""


@dataclass(frozen=True)
class Fault:
    """A fault.

    Attributes:
        emulator: Settings of the emulator, from the moment of the fault.
        codes: Possible exit codes of the command.
        message: A part of its error message; empty: not checked.
    """

    name: str
    emulator: dict[str, Any]
    codes: tuple[int, ...]
    message: str


FAULTS = {
    fault.name: fault
    for fault in (
        Fault("silent", {"silent_after_s": 0.0}, (HARDWARE_LOST,), "no answer to"),
        Fault("late", {"late": 1.0, "late_s": 0.05}, (HARDWARE_LOST, SAFETY_STOP), ""),
        Fault("wild", {"wild": 1.0}, (SAFETY_STOP,), "rad from the last reading"),
        Fault("frozen", {"frozen_after_s": 0.0}, (SAFETY_STOP,), "has read"),
        Fault(NAN, {}, (SAFETY_STOP,), "is NaN"),
        Fault(KILLED, {}, (-signal.SIGKILL,), ""),
        Fault(STOPPED, {}, (SAFETY_STOP,), "the guardian has taken the torque off"),
        Fault("unplugged", {"unplugged_after_s": 0.0}, (HARDWARE_LOST,), ""),
    )
}


@dataclass(frozen=True)
class Outcome:
    """The outcome of one run.

    Attributes:
        safe_s: Time from the fault to the motor's stop [s]; infinite: it did not stop.
        code: Exit code of the command.
        message: The end of its output.
        right: Whether the exit code is one of the fault's, and the message names it where it is checked.
        again: Number of earlier starts in which the deployment ended before its fault.
    """

    fault: str
    seed: int
    safe_s: float
    code: int
    message: str
    readable: bool
    right: bool
    again: int = 0


def swinging_bundle(folder: Path) -> Path:
    """Write a policy that pumps the pendulum: full voltage in the direction of the motion."""
    robot = load_robot("pendulum")
    size, low, high = robot.agent.observation_size, *np.array([(a.low, a.high) for a in robot.agent.action]).T
    kernel = np.zeros((size, 1))
    kernel[2] = 40.0  # thdot / 10
    bias = np.full(1, 0.6)  # from rest it needs a push
    weights = {"mean": np.zeros(size), "std": np.ones(size), "low": low, "high": high, "log_std": np.zeros(1)}
    contract = PolicyContract(robot.agent.observation, robot.agent.action, robot.rate_hz)
    return save_bundle(folder, {**weights, "layers.0.kernel": kernel, "layers.0.bias": bias}, contract)


@functools.cache
def _server() -> Any:
    """Return the server that forks the processes; it has imported the slow modules, and computed nothing."""
    server = multiprocessing.get_context("forkserver")
    server.set_forkserver_preload(["sim2real.stages.deploy.stage", "sim2real.emulation.dynamixel", "mujoco"])
    return server


@contextlib.contextmanager
def emulated(config: Any, plant: str, truth: Path) -> Iterator[tuple[str, int]]:
    """Run an emulator that outlives the host; return its port and its process id."""
    kind = f"{type(config).__module__}:{type(config).__qualname__}"
    flags = ["--plant", plant, "--truth", str(truth), "--emulation", kind]
    flags += [f"--{n.replace('_', '-')}={v!r}" for n, v in asdict(config).items() if v is not None]
    ready, sender = _server().Pipe(duplex=False)
    process = _server().Process(target=_emulate, args=(flags, sender))
    process.start()
    sender.close()
    try:
        with os.fdopen(os.dup(ready.fileno())) as lines:
            yield json.loads(lines.readline())["port"], process.pid
    finally:
        process.terminate()
        process.join(timeout=_END_S)


def _emulate(flags: list[str], sender: Connection) -> None:
    os.setsid()
    os.dup2(sender.fileno(), 1)
    sys.exit(emulator.main(flags))


def deployed(port: str, bundle: Path, runs: Path, messages: Path, watchdog_s: float, *more: str) -> BaseProcess:
    """Start a deployment in a process of its own; SIGUSR1 makes its sensor's readings NaN from then on.

    Args:
        watchdog_s: The gate's longest silence [s].
    """
    flags = ["--port", port, "--bundle", str(bundle), "--runs", str(runs), "--duration-s", "8", "--episodes", "1"]
    flags += ["--no-measure-delay", f"--gate.servo-watchdog-s={watchdog_s}", *more]
    process = _server().Process(target=_deploy, args=(flags, messages))
    process.start()
    return process


def _deploy(flags: list[str], messages: Path) -> None:
    os.setsid()
    sys.stdout = sys.stderr = messages.open("w", buffering=1)
    os.dup2(sys.stdout.fileno(), 1)  # the guardian's process reports there
    os.dup2(sys.stdout.fileno(), 2)
    _nan_on_signal(load_robot("pendulum").sensor)
    os._exit(cli.main(["deploy", "pendulum", *flags]))


def _nan_on_signal(sensor: Any) -> None:
    kind, factor = type(sensor), [1.0]
    read: Callable[..., Any] = kind.read

    def ill(self: Any, reading: Any) -> Any:
        message = read(self, reading)
        return message.replace(th=message.th * factor[0])

    kind.read = ill
    signal.signal(signal.SIGUSR1, lambda *_: factor.__setitem__(0, float("nan")))


def run_once(fault: Fault, seed: int, bundle: Path, folder: Path, watchdog_s: float) -> Outcome:
    """Deploy, let the fault happen, and return the outcome.

    Raises:
        NotBegun: The deployment did not begin to move, or a busy machine stopped it before the fault.
    """
    draw = random.Random(f"{fault.name}/{seed}")
    robot = load_robot("pendulum")
    config = replace(robot.drive.embedded.emulator, seed=seed, model_number=1020, on_signal=True, **fault.emulator)
    truth, messages = folder / "truth.bin", folder / "messages.txt"
    with emulated(config, robot.drive.embedded.plant, truth) as (port, emulator_pid):
        child = deployed(port, bundle, folder / "runs", messages, watchdog_s)
        try:
            wait_until_moving(truth, messages, child, _ROUND_RAD_S)
            time.sleep(draw.uniform(*_SWINGS_S))
            number = {KILLED: signal.SIGKILL, STOPPED: signal.SIGSTOP, NAN: signal.SIGUSR1}.get(fault.name)
            began_ns = time.monotonic_ns()
            os.kill(emulator_pid if number is None else child.pid, number or signal.SIGUSR1)
            if fault.name == STOPPED:
                time.sleep(0.5)
                os.kill(child.pid, signal.SIGCONT)
            code = ended(child)
        finally:
            child.kill()
            child.join()
        time.sleep(0.3)  # the last commands take effect
    printed = messages.read_text(errors="replace")
    (log,) = (folder / "runs").glob("pendulum/*/deploy/episode_0.mcap")
    account = read_truth(truth)
    if stopped_before(account, began_ns):
        raise NotBegun(f"the motor stopped before the fault: {printed}")
    safe_s = safe_after(account, began_ns)
    right = code in fault.codes and fault.message in printed and (fault.name == KILLED or "error: " in printed)
    return Outcome(fault.name, seed, safe_s, code, printed.strip()[-300:], _readable(log), right)


def begun(fault: Fault, seed: int, bundle: Path, root: Path, watchdog_s: float) -> Outcome:
    """Return the outcome of a run whose robot moved before the fault; on a busy machine it may start several times.

    Args:
        seed: Seed of the time of the fault.
        watchdog_s: The gate's longest silence [s].

    Raises:
        NotBegun: It never moved.
    """
    for again in range(_TRIES - 1):
        with contextlib.suppress(NotBegun):
            outcome = run_once(fault, seed, bundle, _new(root / f"{fault.name}_{seed}_{again}"), watchdog_s)
            return replace(outcome, again=again)
    outcome = run_once(fault, seed, bundle, _new(root / f"{fault.name}_{seed}"), watchdog_s)
    return replace(outcome, again=_TRIES - 1)


def outcomes(names: Sequence[str], seeds: Sequence[int], watchdog_s: float, jobs: int, root: Path) -> Iterator[Outcome]:
    """Let each fault happen in some runs, several at a time; yield their outcomes in order.

    A run that raises an error yields an infinite time, with its message.
    """
    bundle = swinging_bundle(root / "bundle")
    runs = [(FAULTS[name], seed) for name in names for seed in seeds]
    with ProcessPoolExecutor(jobs, mp_context=_server()) as pool:
        begun_runs = [pool.submit(begun, fault, seed, bundle, root, watchdog_s) for fault, seed in runs]
        for (fault, seed), one in zip(runs, begun_runs, strict=True):
            try:
                yield one.result()
            except ValueError as error:  # the base class of all errors of sim2real
                yield Outcome(fault.name, seed, float("inf"), ERROR, str(error)[-300:], False, False)


def _new(folder: Path) -> Path:
    folder.mkdir()
    return folder


def safe_after(truth: Truth, since_ns: int) -> float:
    """Return the time from a moment [ns] to the motor's final stop [s]: torque off, or its own firmware's zero."""
    effects = truth.of(Kind.EFFECT)
    off = (effects["values"][:, 0] == OperatingMode.OFF) | (effects["values"][:, 1] == 0.0)
    turning = np.flatnonzero(~off)
    if not turning.size or turning[-1] + 1 == len(off):
        return 0.0 if not turning.size else float("inf")
    return max(0.0, 1e-9 * float(effects["t_ns"][turning[-1] + 1] - since_ns))


def stopped_before(truth: Truth, at_ns: int) -> bool:
    """Return whether the motor's torque was off at a moment [ns]."""
    effects = truth.of(Kind.EFFECT)
    before = effects["values"][effects["t_ns"] < at_ns, 0]
    return not len(before) or before[-1] == OperatingMode.OFF


def wait_until_moving(truth: Path, messages: Path, child: BaseProcess, speed_rad_s: float = 0.0) -> None:
    """Wait until the emulator's motor has been driven, and was measured to be as fast as this.

    Args:
        speed_rad_s: The motor's speed [rad/s].

    Raises:
        NotBegun: It ended before, or took a minute.
    """
    end = time.monotonic() + _START_S
    while time.monotonic() < end and child.is_alive():
        time.sleep(0.1)
        if truth.is_file() and truth.stat().st_size > 0:
            account = read_truth(truth)
            driven = np.abs(account.of(Kind.EFFECT)["values"][:, 1])
            speeds = np.abs(account.of(Kind.SAMPLE)["values"][:, 1])
            if driven.any() and speeds.max(initial=0.0) >= speed_rad_s:
                return
    raise NotBegun(f"the deployment did not begin to move: {messages.read_text(errors='replace')}")


def ended(process: BaseProcess) -> int:
    """Return the exit code of a process once it has ended; of one that a signal killed, minus its number.

    Raises:
        Sim2RealError: It did not end in time.
    """
    process.join(_END_S)
    if process.exitcode is None:
        raise Sim2RealError(f"the deployment had not ended after {_END_S:g} s")
    return process.exitcode


def _readable(log: Path) -> bool:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TruncatedLogWarning)
        try:
            return len(read_log(log).steps["sensor"]) > 0
        except Sim2RealError:
            return False


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of this bench."""
    parser.add_argument("--runs", type=int, default=50, help="runs of each fault, each at another moment")
    parser.add_argument("--faults", nargs="+", choices=FAULTS, default=list(FAULTS), help="which; default: all")
    parser.add_argument("--first-seed", type=int, default=0, help="seed of the first run")
    parser.add_argument(
        "--servo-watchdog-s", type=float, default=0.1, help="the gate's limit; more where others compute"
    )
    parser.add_argument("--jobs", type=int, default=1, help="runs at a time; each takes most of a core as it begins")


def run(options: argparse.Namespace) -> Report:
    """Let each fault happen in some runs."""
    rows, by_fault = [], {name: [] for name in options.faults}
    seeds = range(options.first_seed, options.first_seed + options.runs)
    with tempfile.TemporaryDirectory(prefix="sim2real-faults-") as name:
        for one in outcomes(options.faults, seeds, options.servo_watchdog_s, options.jobs, Path(name)):
            by_fault[one.fault].append(one)
            print(f"{one.fault} {one.seed}: {one.safe_s:.3f} s, exit {one.code}", file=sys.stderr)
    for kind, runs in by_fault.items():
        safe = np.array([o.safe_s for o in runs])
        what, of = f"faults/{kind}", f"of {len(runs)}"
        rows.append(row(f"{what}/safe", int((safe < SAFE_S).sum()), of, goal="all within 0.2 s"))
        spread = [round(float(s), 3) for s in np.sort(safe)[[len(safe) // 2, -1]]]
        rows.append(row(f"{what}/safe_s", spread, "s", "p50, max", "< 0.2"))
        rows.append(row(f"{what}/log_readable", sum(o.readable for o in runs), of, goal="all"))
        checked = "code_and_reason" if FAULTS[kind].message else "code"
        rows.append(row(f"{what}/{checked}", sum(o.right for o in runs), of, goal="all"))
        rows.append(row(f"{what}/begun_again", sum(o.again for o in runs), "times: it had ended before the fault"))
    wrong = [
        asdict(o) for runs in by_fault.values() for o in runs if not (o.safe_s < SAFE_S and o.readable and o.right)
    ]
    return {"rows": rows, **({"wrong": wrong} if wrong else {})}


def table(report: Report) -> str:
    """Return how many runs were safe, how late the latest one was, and what of their ends was compared."""
    v, kinds, each = values(report, "faults/"), report["flags"]["faults"], report["flags"]["runs"]
    runs = len(kinds) * each
    compared, by_code = ([k for k in kinds if bool(FAULTS[k].message) == has] for has in (True, False))
    safe, readable, again = (sum(v[f"{k}/{what}"] for k in kinds) for what in ("safe", "log_readable", "begun_again"))
    named, right = sum(v[f"{k}/code_and_reason"] for k in compared), sum(v[f"{k}/code"] for k in by_code)
    return (
        f"Of {runs} runs, {report['flags']['jobs']} at a time, {safe} were safe, the latest after "
        f"{max(v[f'{k}/safe_s'][1] for k in kinds):.3f} s. {readable} left a readable log.\n"
        f"Exit code and reason are compared for {each * len(compared)} runs ({', '.join(compared)}): "
        f"{named} were right.\n"
        f"For the other {each * len(by_code)} ({', '.join(by_code)}) no reason is compared: {right} ended with an\n"
        f"exit code that the fault may have; a killed process always has its signal's.\n"
        f"A run that stops before its fault happens is begun again, at most {_TRIES - 1} times: {again} were.\n"
    )
