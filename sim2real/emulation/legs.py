"""An emulated robot of Unitree: motors, IMU, and connections without DDS.

A command takes effect one actuation latency after it was written, and a state has the measurements of one sensing
latency before.
"""

from __future__ import annotations

import random
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sim2real.emulation.plant import STATE_PERIOD_S
from sim2real.emulation.robot import NUMBERS, Emulation, PlannedRobot, VirtualChannel, VirtualTime
from sim2real.emulation.truth import Kind, TruthLog
from sim2real.errors import HardwareLost
from sim2real.hardware.safety.guardian import Guardian
from sim2real.hardware.unitree.dds import EMULATED, PERIOD_S, QUEUE, Address, DdsLink
from sim2real.hardware.unitree.device import motors_of
from sim2real.hardware.unitree.legs import COLUMNS, LegDrive
from sim2real.hardware.unitree.messages import (
    HEAD,
    LOW_LEVEL,
    NO_POSITION,
    NO_VELOCITY,
    SERVO,
    LowCmd,
    LowState,
)

if TYPE_CHECKING:
    from sim2real.emulation.body import LeggedBody

_PERIOD_NS: Final = round(1e9 * PERIOD_S)


@dataclass(frozen=True)
class UnitreeEmulation(Emulation):
    """Settings of an emulated robot of Unitree; see `Emulation` for the others.

    Args:
        position_noise_rad: Standard deviation of the noise of encoders [rad].
        velocity_noise_rad_s: Standard deviation of the noise of the motors' speeds [rad/s].
        gyro_noise_rad_s: Standard deviation of the noise of the gyro [rad/s].
        tilt_noise_rad: Standard deviation of the noise of the orientation, about each axis [rad].
        accelerometer_noise_m_s2: Standard deviation of the noise of the accelerometer [m/s^2].
    """

    position_noise_rad: float = 0.0003
    velocity_noise_rad_s: float = 0.03
    gyro_noise_rad_s: float = 0.01
    tilt_noise_rad: float = 0.002
    accelerometer_noise_m_s2: float = 0.05

    def planned(self, physics: LeggedBody, truth: TruthLog, send: Callable[[LowState], object]) -> EmulatedLegs:
        return EmulatedLegs(physics, self, truth, send)

    def robot(self, physics: LeggedBody, truth_path: Path | None) -> VirtualLegs:
        return VirtualLegs(physics, self, truth_path)


class EmulatedLegs(PlannedRobot[UnitreeEmulation]):
    """Motors and IMU of a body. Without a host, motors follow the last command: the worst case, as none is documented.

    Args:
        send: Sends a state; None: states are not sent.

    Attributes:
        ignored: Commands whose CRC or head was wrong.
    """

    def __init__(
        self,
        body: LeggedBody,
        config: UnitreeEmulation,
        truth: TruthLog,
        send: Callable[[LowState], object] | None = None,
    ) -> None:
        super().__init__(config, truth)
        self._body, self._send = body, send
        self._rng, self._random = np.random.default_rng(config.seed), random.Random(config.seed)
        self._step_ns = round(1e9 * body.step_s)
        self._index = 0
        self._coming: deque[tuple[int, int, np.ndarray, np.ndarray]] = deque()
        self._modes = np.zeros(body.motors, np.uint8)
        self.ignored = 0
        # Delayed states, the end of the delay, and the time of the next state [ns].
        self._waiting: deque[tuple[LowState, int]] = deque()
        self._held_ns, self._due_ns = 0, _PERIOD_NS
        # Measurements at the physics' time steps, newest last, as far back as a state reaches.
        self._dtype = body.measure().dtype
        depth = int(1e9 * config.sensing_latency_s) // self._step_ns + 3
        self._history: deque[np.ndarray] = deque(maxlen=depth)
        self._stride = max(1, round(STATE_PERIOD_S / body.step_s))
        self._remember()

    def next_due_ns(self) -> int | None:
        return self._due_ns

    def run_until(self, t_ns: int) -> None:
        self.advance(t_ns)
        if t_ns >= self._due_ns:
            # After a pause of the process, send only the newest state.
            state_ns = t_ns - (t_ns - self._due_ns) % _PERIOD_NS
            self._due_ns = state_ns + _PERIOD_NS
            if not self.is_silent(t_ns):
                self._send_state(state_ns)

    def receive(self, command: LowCmd, t_ns: int) -> None:
        """Schedule a command that was written at ``t_ns``; like the robot, ignore one with a wrong CRC or head."""
        record, config = command.record, self.config
        if tuple(record["head"]) != HEAD or record["level_flag"] != LOW_LEVEL or not command.intact:
            self.ignored += 1
            return
        motors = record["motor_cmd"][: self._body.motors]
        law = np.stack([motors[name] for name in COLUMNS], axis=-1).astype(np.float64)
        jitter_s = self._rng.uniform(-1.0, 1.0) * config.actuation_jitter_s
        effect_ns = t_ns + round(1e9 * (config.actuation_latency_s + jitter_s))
        if self._coming:
            effect_ns = max(effect_ns, self._coming[-1][0])
        self._coming.append((effect_ns, t_ns, motors["mode"].copy(), law))

    def advance(self, t_ns: int) -> None:
        """Integrate the body to the last grid point at or before a time [ns]."""
        while (now_ns := self._now_ns()) + self._step_ns <= t_ns:
            # A command acts from the next grid point on, on average half a step late; this cancels the integrator,
            # # which moves a joint as if its force had acted half a step earlier.
            while self._coming and self._coming[0][0] <= now_ns:
                self._apply(*self._coming.popleft())
            self._body.step()
            self._index += 1
            self._remember()

    def state(self, t_ns: int) -> LowState:
        """Return the state that is sent at a time [ns] that `advance` has reached."""
        # Interpolate the measurements of one latency earlier between grid points.
        config, draw = self.config, self._rng.normal
        back = (self._now_ns() - t_ns) / self._step_ns + config.sensing_latency_s / self._body.step_s
        back = min(max(back, 0.0), len(self._history) - 1.0)
        later, share = self._history[-1 - int(back)], back % 1.0
        earlier = self._history[max(-2 - int(back), -len(self._history))]
        measured = (later + share * (earlier - later)).view(self._dtype)[0]
        # Fill the message, with noise.
        message, n = LowState(), self._body.motors
        record, motors, imu = message.record, message.record["motor_state"][:n], message.record["imu_state"]
        record["head"], record["level_flag"] = HEAD, LOW_LEVEL
        record["tick"] = t_ns // 1_000_000 % (1 << 32)
        motors["mode"], motors["tau_est"], motors["temperature"] = self._modes, measured["tau_est"], 35
        motors["q"] = measured["q"] + config.position_noise_rad * draw(size=n)
        motors["dq"] = measured["dq"] + config.velocity_noise_rad_s * draw(size=n)
        imu["quaternion"] = _tilted(measured["quaternion"], config.tilt_noise_rad * draw(size=3))
        imu["gyroscope"] = measured["gyroscope"] + config.gyro_noise_rad_s * draw(size=3)
        imu["accelerometer"] = measured["accelerometer"] + config.accelerometer_noise_m_s2 * draw(size=3)
        record["foot_force"], record["power_v"], battery = measured["foot_force"], 29.6, record["bms_state"]
        battery["soc"], battery["version_high"], battery["version_low"] = 90, 1, 4
        message.sign()
        return message

    def _send_state(self, state_ns: int) -> None:
        """Send the due state, after delayed earlier states; or delay it."""
        config, chance = self.config, self._random.random
        if self._held_ns == 0 and chance() < config.late:
            self._held_ns = state_ns + round(1e9 * config.late_s)
        self._waiting.append((self.state(state_ns), state_ns))
        if state_ns < self._held_ns:
            return
        self._held_ns = 0
        while self._waiting:
            state, sent_ns = self._waiting.popleft()
            if chance() < config.corrupt:
                state.record["crc"] ^= 1
            lost = chance() < config.reply_loss
            if not lost and self._send is not None:
                self._send(state)
            sampled_ns = sent_ns - round(1e9 * config.sensing_latency_s)
            self.truth.write(Kind.LOSS if lost else Kind.SAMPLE, 0, sent_ns, sampled_ns, state_ns, state_ns - sent_ns)

    def _apply(self, effect_ns: int, t_ns: int, modes: np.ndarray, law: np.ndarray) -> None:
        """Apply a command. A motor that is off has no torque; `POS_STOP` and `VEL_STOP` switch a controller off."""
        q, dq, kp, kd = (law[:, COLUMNS.index(name)] for name in ("q", "dq", "kp", "kd"))
        kp[np.abs(q) >= 0.99 * NO_POSITION], kd[np.abs(dq) >= 0.99 * NO_VELOCITY] = 0.0, 0.0
        q[kp == 0.0], dq[kd == 0.0] = 0.0, 0.0
        law[modes != SERVO] = 0.0
        law[~np.isfinite(law).all(axis=1)] = 0.0
        changed = modes != self._modes
        self._modes = modes
        driven = law.copy()
        if self.has(self.config.lets_go_after_s, self._now_ns()):
            driven[self.config.lets_go] = 0.0
        self._body.drive(driven)
        # Log mode, goal and position gain: of the first motor for each command, of others if their mode changes.
        acts_ns, changed[0] = self._now_ns() - self._step_ns // 2, True
        for i in np.flatnonzero(changed).tolist():
            values = float(modes[i]), float(q[i]), float(kp[i])
            self.truth.write(Kind.EFFECT, i, t_ns, acts_ns, acts_ns, acts_ns - effect_ns, values)

    def _now_ns(self) -> int:
        return self._index * self._step_ns

    def _remember(self) -> None:
        self._history.append(self._body.measure().reshape(1).view(np.float64))
        if self._index % self._stride == 0:
            now_ns = self._now_ns()
            self.truth.write(Kind.STATE, 0, 0, now_ns, now_ns, 0, tuple(self._body.state().values()))


def _tilted(quaternion: np.ndarray, angles_rad: np.ndarray) -> np.ndarray:
    """Return an orientation ``(4,)``, turned by small angles ``(3,)`` about the body's axes."""
    w, v = quaternion[0], quaternion[1:]
    half = 0.5 * angles_rad
    turned = np.concatenate([[w - v @ half], v + w * half + np.cross(v, half)])
    return turned / np.linalg.norm(turned)


class VirtualLegs(VirtualTime):
    """An emulated robot at `port`, from construction until `stop`.

    Attributes:
        port: The address, which `connect` knows.
        links: The open connections.
    """

    def __init__(self, body: LeggedBody, config: UnitreeEmulation, truth_path: Path | None = None) -> None:
        self.links: list[VirtualLink] = []
        super().__init__(body, config, truth_path, self._publish)
        self.legs: Any = self.planned
        self.address = Address("virtual", next(NUMBERS) % 233)
        self.port = str(self.address)
        EMULATED[self.address] = lambda mark: VirtualLink(self, mark)

    def stop(self) -> None:
        EMULATED.pop(self.address, None)
        super().stop()

    def _publish(self, state: LowState) -> None:
        for link in self.links:
            link.states.append(state)


class VirtualLink(DdsLink):
    """A connection of the host, or of the guardian.

    Attributes:
        states: States that wait for `next_state`.
    """

    def __init__(self, robot: VirtualLegs, mark: str, is_guardian: bool = False) -> None:
        self.address, self.clock, self._robot, self._mark = robot.address, robot, robot, mark.encode()
        self._is_guardian = is_guardian
        self.states: deque[LowState] = deque(maxlen=QUEUE)
        robot.links.append(self)

    def write(self, command: LowCmd) -> None:
        self._require_open()
        if not self._robot.legs.is_silent(self._robot.now_ns()):
            self._robot.legs.receive(command, self._robot.now_ns())

    def next_state(self, timeout_s: float) -> LowState | None:
        self._require_open()
        if timeout_s > 0.0:
            self._robot._pass(self._robot.now_ns() + max(1, round(1e9 * timeout_s)), lambda: self.states)
        return self.states.popleft() if self.states else None

    def other_writers(self) -> list[str]:
        self._require_open()
        return [link._mark.decode() for link in self._robot.links if link._mark != self._mark]

    def guardian(self, drive: LegDrive, silence_s: float, settle_s: float) -> Guardian:
        motors = motors_of(VirtualLink(self._robot, self._mark.decode(), is_guardian=True), drive)
        return Guardian(lambda longest_s: VirtualChannel(self._robot, motors, longest_s), silence_s, settle_s)

    def close(self) -> None:
        if self in self._robot.links:
            self._robot.links.remove(self)

    def _require_open(self) -> None:
        if self not in self._robot.links or not (self._is_guardian or self._robot.host_lives):
            raise HardwareLost(f"the robot on {self.address} is not open", hint="call open first")
