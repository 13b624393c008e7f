"""An emulated robot of Unitree: its motors and its IMU in planned time, and its process behind DDS in real time.

The times of all events are computed from the times at which the host wrote its commands, and do not depend on how late
the emulator's process runs: a command that is written at t takes effect one actuation latency later, and a state holds
the measurements of one sensing latency earlier.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import select
import socket
import sys
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Final

import numpy as np

from sim2real.emulation.body import LAW, Body
from sim2real.emulation.faults import Emulation, FaultTimes, truth_header
from sim2real.emulation.plant import STATE_PERIOD_S
from sim2real.emulation.process import StopFlag, keep_time, plant_arguments
from sim2real.emulation.truth import Kind, TruthLog
from sim2real.errors import HardwareLost
from sim2real.hardware.registry import load_named
from sim2real.hardware.unitree.dds import Address
from sim2real.hardware.unitree.messages import (
    COMMAND_TOPIC,
    HEAD,
    LOW_LEVEL,
    NO_POSITION,
    NO_VELOCITY,
    SERVO,
    STATE_TOPIC,
    LowCmd,
    LowState,
)

if TYPE_CHECKING:
    from cyclonedds.sub import DataReader

STATE_HZ = 500
"""States per second."""


@dataclass(frozen=True)
class UnitreeEmulation(Emulation):
    """Settings of an emulated robot of Unitree; see `Emulation` for the others.

    Args:
        position_noise_rad: Deviation of the noise of encoders [rad].
        velocity_noise_rad_s: Deviation of the noise of the motors' speeds [rad/s].
        gyro_noise_rad_s: Deviation of the noise of the gyro [rad/s].
        tilt_noise_rad: Deviation of the noise of the orientation, about each axis [rad].
        accelerometer_noise_m_s2: Deviation of the noise of the accelerometer [m/s^2].
        alone_after_s: Time without an intact command after which motors damp their joints [s]; None: they go on as
            commanded last, the worst that is possible: Unitree documents no reaction.
        alone_kd: Damping of the joints then [N m s/rad].
    """

    serve: ClassVar[str] = "sim2real.emulation.legs:serve_legs"

    position_noise_rad: float = 0.0003
    velocity_noise_rad_s: float = 0.03
    gyro_noise_rad_s: float = 0.01
    tilt_noise_rad: float = 0.002
    accelerometer_noise_m_s2: float = 0.05
    alone_after_s: float | None = None
    alone_kd: float = 3.0


class EmulatedLegs(FaultTimes):
    """Motors and IMU of a body.

    Args:
        start_ns: Time 0 of the body, CLOCK_MONOTONIC [ns].

    Attributes:
        ignored: Commands whose CRC or head was wrong.
    """

    def __init__(self, body: Body, config: UnitreeEmulation, truth: TruthLog, start_ns: int) -> None:
        super().__init__(config, start_ns)
        self._body, self._config, self._truth, self._start_ns = body, config, truth, start_ns
        self._rng = np.random.default_rng(config.seed)
        self._step_ns = round(1e9 * body.step_s)
        self._index = 0
        self._coming: deque[tuple[int, int, np.ndarray, np.ndarray]] = deque()
        self._modes, self._law = np.zeros(body.motors, np.uint8), np.zeros((body.motors, len(LAW)))
        self._heard_ns: int | None = None
        self._damps = False
        self.ignored = 0
        # Measurements on the grid of the physics, the newest last, as far back as a state reaches.
        self._dtype = body.measure().dtype
        depth = int(1e9 * config.sensing_latency_s) // self._step_ns + 3
        self._history: deque[np.ndarray] = deque(maxlen=depth)
        self._stride = max(1, round(STATE_PERIOD_S / body.step_s))
        self._remember()

    def receive(self, command: LowCmd, t_ns: int) -> None:
        """Schedule a command that was written at ``t_ns``; one with a wrong CRC or head is ignored, as by the robot."""
        record, config = command.record, self._config
        if tuple(record["head"]) != HEAD or record["level_flag"] != LOW_LEVEL or not command.intact:
            self.ignored += 1
            return
        motors = record["motor_cmd"][: self._body.motors]
        law = np.stack([motors[name] for name in LAW], axis=-1).astype(np.float64)
        jitter_s = self._rng.uniform(-1.0, 1.0) * config.actuation_jitter_s
        effect_ns = t_ns + round(1e9 * (config.actuation_latency_s + jitter_s))
        if self._coming:
            effect_ns = max(effect_ns, self._coming[-1][0])
        self._coming.append((effect_ns, t_ns, motors["mode"].copy(), law))

    def advance(self, t_ns: int) -> None:
        """Integrate the body to the last grid point at or before a time [ns]."""
        while (now_ns := self._now_ns()) + self._step_ns <= t_ns:
            # A command acts from the next grid point on, in the mean half a step late: the integrator moves a joint as
            # if its force had acted half a step earlier.
            while self._coming and self._coming[0][0] <= now_ns:
                self._apply(*self._coming.popleft())
            alone_s = self._config.alone_after_s
            if self._heard_ns is not None and alone_s is not None and now_ns - self._heard_ns > 1e9 * alone_s:
                self._damp(now_ns)
            self._body.step()
            self._index += 1
            self._remember()

    def state(self, t_ns: int) -> LowState:
        """Return the state that is sent at a time [ns] that `advance` has reached."""
        # Interpolate the measurements of one latency earlier between grid points.
        config, draw = self._config, self._rng.normal
        back = (self._now_ns() - t_ns) / self._step_ns + config.sensing_latency_s / self._body.step_s
        back = min(max(back, 0.0), len(self._history) - 1.0)
        later, share = self._history[-1 - int(back)], back % 1.0
        earlier = self._history[max(-2 - int(back), -len(self._history))]
        measured = (later + share * (earlier - later)).view(self._dtype)[0]
        # Fill the message, with noise.
        message, n = LowState(), self._body.motors
        record, motors, imu = message.record, message.record["motor_state"][:n], message.record["imu_state"]
        record["head"], record["level_flag"] = HEAD, LOW_LEVEL
        record["tick"] = (t_ns - self._start_ns) // 1_000_000 % (1 << 32)
        motors["mode"], motors["tau_est"], motors["temperature"] = self._modes, measured["tau_est"], 35
        motors["q"] = measured["q"] + config.position_noise_rad * draw(size=n)
        motors["dq"] = measured["dq"] + config.velocity_noise_rad_s * draw(size=n)
        quaternion = _tilted(measured["quaternion"], config.tilt_noise_rad * draw(size=3))
        imu["quaternion"], imu["rpy"] = quaternion, _roll_pitch_yaw(quaternion)
        imu["gyroscope"] = measured["gyroscope"] + config.gyro_noise_rad_s * draw(size=3)
        imu["accelerometer"] = measured["accelerometer"] + config.accelerometer_noise_m_s2 * draw(size=3)
        record["foot_force"], record["power_v"], battery = measured["foot_force"], 29.6, record["bms_state"]
        battery["soc"], battery["version_high"], battery["version_low"] = 90, 1, 4
        message.sign()
        return message

    def _apply(self, effect_ns: int, t_ns: int, modes: np.ndarray, law: np.ndarray) -> None:
        """Let a command act. A motor that is off has no torque; Unitree's two numbers take a controller out."""
        q, dq, kp, kd = (law[:, LAW.index(name)] for name in ("q", "dq", "kp", "kd"))
        kp[np.abs(q) >= 0.99 * NO_POSITION], kd[np.abs(dq) >= 0.99 * NO_VELOCITY] = 0.0, 0.0
        q[kp == 0.0], dq[kd == 0.0] = 0.0, 0.0
        law[modes != SERVO] = 0.0
        law[~np.isfinite(law).all(axis=1)] = 0.0
        changed = modes != self._modes
        self._modes, self._law, self._heard_ns, self._damps = modes, law, t_ns, False
        driven = law.copy()
        if self.has(self._config.lets_go_after_s, self._now_ns()):
            driven[self._config.lets_go] = 0.0
        self._body.drive(driven)
        # Mode, goal and position gain: of the first motor for each command, of the others if their mode changes.
        acts_ns, changed[0] = self._now_ns() - self._step_ns // 2, True
        for i in np.flatnonzero(changed).tolist():
            values = float(modes[i]), float(q[i]), float(kp[i])
            self._truth.write(Kind.EFFECT, i, t_ns, acts_ns, acts_ns, acts_ns - effect_ns, values)

    def _damp(self, now_ns: int) -> None:
        """Let the motors that are on damp their joints, as the host is silent."""
        if self._damps:
            return
        self._damps, law = True, np.zeros_like(self._law)
        law[self._modes == SERVO, LAW.index("kd")] = self._config.alone_kd
        self._body.drive(law)
        self._truth.write(Kind.WATCHDOG, 0, self._heard_ns or 0, now_ns, now_ns, 0)

    def _now_ns(self) -> int:
        return self._start_ns + self._index * self._step_ns

    def _remember(self) -> None:
        self._history.append(self._body.measure().reshape(1).view(np.float64))
        if self._index % self._stride == 0:
            now_ns = self._now_ns()
            self._truth.write(Kind.STATE, 0, 0, now_ns, now_ns, 0, tuple(self._body.state().values()))


def _tilted(quaternion: np.ndarray, angles_rad: np.ndarray) -> np.ndarray:
    """Return an orientation ``(4,)``, turned by small angles ``(3,)`` about the body's axes."""
    w, v = quaternion[0], quaternion[1:]
    half = 0.5 * angles_rad
    turned = np.concatenate([[w - v @ half], v + w * half + np.cross(v, half)])
    return turned / np.linalg.norm(turned)


def _roll_pitch_yaw(q: np.ndarray) -> tuple[float, float, float]:
    w, x, y, z = (float(c) for c in q)
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1.0, 1.0))
    return float(roll), float(pitch), float(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))


_POLL_NS: Final = 1_000_000
_PERIOD_NS: Final = 1_000_000_000 // STATE_HZ
_DOMAINS: Final = range(50, 230)
"""Domains of emulators; a real robot has domain 0."""
_LOCK_PORT: Final = 29_000
"""A domain belongs to the process that has the UDP port of this number plus the domain's."""
_DDS_PORT, _DDS_PORTS = 7400, 250
"""Every program in a domain hears on this UDP port plus a number of ports for each domain (DDSI-RTPS, section 9.6)."""


def serve_legs(options: argparse.Namespace, config: UnitreeEmulation, stop: StopFlag) -> None:
    """Emulate a robot behind the topics of its low-level interface, on this machine alone, until the flag is set."""
    # Imported here: without cyclonedds, `messages` above has raised an error that names its extra.
    from cyclonedds.domain import Domain, DomainParticipant
    from cyclonedds.pub import DataWriter
    from cyclonedds.sub import DataReader
    from cyclonedds.topic import Topic

    body = load_named(options.plant, "plant")(**plant_arguments(options.plant_args))
    lock, domain = _free_domain()
    # DDS has threads of its own, which take no part in the real-time priority.
    address = Address("lo", domain)
    network = Domain(domain, address.config)
    participant = DomainParticipant(domain)
    reader = DataReader(participant, Topic(participant, COMMAND_TOPIC, LowCmd))
    writer = DataWriter(participant, Topic(participant, STATE_TOPIC, LowState))
    keep_time()
    start_ns = time.monotonic_ns()
    truth = TruthLog(options.truth, truth_header(body, config, start_ns))
    try:
        legs = EmulatedLegs(body, config, truth, start_ns)
        ready = {"port": str(address), "pid": os.getpid(), "truth": str(options.truth.resolve())}
        print(json.dumps(ready), flush=True)
        parent_fd = sys.stdin.fileno() if options.until_stdin_closes else None
        _serve(legs, config, reader, Sender(writer.write, config, truth), truth, start_ns, stop, parent_fd)
    finally:
        truth.close()
        del writer, reader, participant, network
        lock.close()


class Sender:
    """Sends states, with the faults of the settings."""

    def __init__(
        self,
        write: Callable[[LowState], object],
        config: UnitreeEmulation,
        truth: TruthLog,
        now_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._write, self._config, self._truth, self._now_ns = write, config, truth, now_ns
        self._random = random.Random(config.seed)
        self._waiting: deque[tuple[LowState, int]] = deque()
        self._held_ns = 0

    def send(self, state: LowState, state_ns: int) -> None:
        """Send a state that is due at ``state_ns``, and those that were held up before it; or hold it up."""
        config, chance = self._config, self._random.random
        if self._held_ns == 0 and chance() < config.late:
            self._held_ns = state_ns + round(1e9 * config.late_s)
        self._waiting.append((state, state_ns))
        if state_ns < self._held_ns:
            return
        self._held_ns = 0
        while self._waiting:
            state, state_ns = self._waiting.popleft()
            if chance() < config.corrupt:
                state.record["crc"] ^= 1
            lost = chance() < config.reply_loss
            if not lost:
                self._write(state)
            done_ns, sampled_ns = self._now_ns(), state_ns - round(1e9 * config.sensing_latency_s)
            kind = Kind.LOSS if lost else Kind.SAMPLE
            self._truth.write(kind, 0, state_ns, sampled_ns, done_ns, done_ns - state_ns)


def _serve(
    legs: EmulatedLegs,
    config: UnitreeEmulation,
    reader: DataReader,
    sender: Sender,
    truth: TruthLog,
    start_ns: int,
    stop: StopFlag,
    parent_fd: int | None,
) -> None:
    """Send states and obey commands until ``stop`` is set; with ``parent_fd``, also until that pipe is closed."""
    due_ns, inputs = start_ns + _PERIOD_NS, [] if parent_fd is None else [parent_fd]
    while not stop.is_set:
        # Sleep until the next millisecond.
        now_ns = time.monotonic_ns()
        wait_s = 1e-9 * (_POLL_NS - (now_ns - start_ns) % _POLL_NS)
        if select.select(inputs, [], [], wait_s)[0] and not os.read(inputs[0], 1024):
            return
        now_ns = time.monotonic_ns()
        legs.faulty_ns = stop.faulty_ns or legs.faulty_ns
        silent = legs.has(config.silent_after_s, now_ns)
        # Commands count from the time at which they were written.
        for message in reader.take(16):
            if isinstance(message, LowCmd) and not silent:
                written_ns = message.sample_info.source_timestamp  # pyright: ignore[reportAttributeAccessIssue]
                age_ns = max(0, time.time_ns() - written_ns)
                legs.receive(message, time.monotonic_ns() - age_ns)
        legs.advance(now_ns)
        truth.flush_if_due(now_ns)
        if now_ns < due_ns:
            continue
        # A process that was held up sends the newest state alone.
        state_ns = now_ns - (now_ns - due_ns) % _PERIOD_NS
        due_ns = state_ns + _PERIOD_NS
        if not silent:
            sender.send(legs.state(state_ns), state_ns)


def _free_domain() -> tuple[socket.socket, int]:
    """Return a domain that no program of this machine uses, not even an earlier robot's guardian, and its socket."""
    for domain in _DOMAINS:
        lock, heard = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
        try:
            lock.bind(("127.0.0.1", _LOCK_PORT + domain))
            heard.bind(("", _DDS_PORT + _DDS_PORTS * domain))
        except OSError:
            lock.close()
            continue
        finally:
            heard.close()
        return lock, domain
    raise HardwareLost("all DDS domains of this machine have an emulator", hint="end emulators that still run")
