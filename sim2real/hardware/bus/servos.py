"""Servos of any family on one bus, as a device."""

import atexit
import logging
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, Final

import numpy as np

from sim2real.errors import HardwareLost, SafetyStop, UsageError
from sim2real.hardware.bus.link import ServoLink
from sim2real.hardware.bus.packets import BROADCAST_ID, Answer, Instruction
from sim2real.hardware.bus.port import BusConfig
from sim2real.hardware.bus.registers import Family, Register, ServoModel
from sim2real.hardware.device import (
    POSITION,
    RESPONSE_S,
    VOLTAGE,
    CommandKind,
    Counters,
    Device,
    Following,
    Reading,
    Transaction,
)

_LOGGER = logging.getLogger(__name__)
_SHARED_PINGS: Final = 3
_SLOW_RAD_S: Final = 0.5
"""Speed that every servo reaches on a long way, even under load [rad/s]."""
_MOST_SHARE: Final = 0.9
"""A servo that pushes with more than this share of its torque, and does not reach its goal, is stopped. With 0.7, 6 of
45 faultless motions of an emulated SO-101 with payloads were stopped.
"""
_BEYOND_RAD: Final = 0.1
"""Largest distance of a joint from its range when torque goes on [rad]; torque pulls the joint back into the range."""


@dataclass(frozen=True)
class ServoJoint:
    """A joint that a servo moves: angle = direction * (count - zero_count) * 2 pi / counts.

    Args:
        zero_count: The servo's count at the joint's zero [counts].
        direction: 1, or -1 if the joint's angle falls as the count rises.
        low_count: Lowest count of the joint's range; the servo's own limits may narrow it.
        high_count: Highest count.
        homing_offset: Homing offset that the servo had at the calibration; `open` compares it, and the limits, with the
            servo; None: there is no calibration.
        counts: Counts of a revolution.
    """

    name: str
    servo_id: int
    zero_count: float = 2048.0
    direction: int = 1
    low_count: int = 0
    high_count: int = 4095
    homing_offset: int | None = None
    counts: int = 4096

    def __post_init__(self) -> None:
        if self.direction not in (1, -1):
            raise UsageError(f"joint {self.name!r}: direction = {self.direction} is neither 1 nor -1")
        if not 0 <= self.low_count < self.high_count < self.counts:
            raise UsageError(
                f"joint {self.name!r}: {self.low_count} to {self.high_count} counts is not a range within 0 to "
                f"{self.counts - 1}"
            )

    @property
    def rad_per_count(self) -> float:
        """Change of the joint's angle from one count to the next [rad]."""
        return self.direction * 2.0 * math.pi / self.counts

    def angle(self, count: float) -> float:
        """Return the joint's angle [rad] at a count of its servo."""
        return (count - self.zero_count) * self.rad_per_count


@dataclass(frozen=True)
class PositionDrive:
    """Servos that follow goals of their joints [rad]; at the start they hold their positions.

    Args:
        p_gain: P gain of every servo's position controller [counts].
        speed_rad_s: Speed at which a servo's setpoint moves to its goal, at least one count; inf: the setpoint jumps to
            the goal.
        d_gain: D gain [counts]. I gains are 0.
        joints: The joints, e.g. from `read_calibration`; other servos get a joint whose zero is half a turn.
    """

    p_gain: int
    speed_rad_s: float = math.inf
    d_gain: int = 0
    joints: tuple[ServoJoint, ...] = ()
    kind: ClassVar[CommandKind] = POSITION

    def __post_init__(self) -> None:
        if not self.speed_rad_s > 0.0:
            raise UsageError(f"speed_rad_s = {self.speed_rad_s} must be larger than 0", hint="inf: no limit")


@dataclass(frozen=True)
class VoltageDrive:
    """Servos that are commanded in volts, at the start 0 V. Angles are measured from each encoder's zero [rad].

    Args:
        supply_v: Voltage of a motor at full PWM [V].
    """

    supply_v: float
    kind: ClassVar[CommandKind] = VOLTAGE

    def __post_init__(self) -> None:
        if not 0.0 < self.supply_v < math.inf:
            raise UsageError(f"supply_v = {self.supply_v} must be larger than 0")


class Servos(Device):
    """Servos of one family on one port, each moving one joint, commanded in the unit of their drive.

    The torque is taken off by `close`, when the context is left, and when the interpreter exits; on a signal only if
    its handler calls `make_safe`. If this process is killed or hangs, the guardian takes the torque off: a separate
    process that is started before torque goes on.

    A subclass is a family: its table, and where the family differs, `failure`, `model`, `prepare`, `speed_unit` and
    `speed_count`. Some servos refuse a value without an error, so every setting is read back. EEPROM registers are
    written only if their value differs, because writing wears them out.

    Args:
        joints: The joints, or the ids of servos without a calibration.

    Attributes:
        models: Id -> model of the servos that answered; `close` takes their torque off.
        armed: Whether torque was switched on.
        halted: Whether torque stays off because `make_safe` or `close` was called.

    Raises:
        UsageError: There are no joints, two have the same servo, or the family lacks this baud rate or watchdog time.
    """

    family: ClassVar[Family]

    def __init__(
        self, config: BusConfig, joints: Sequence[ServoJoint | int], drive: PositionDrive | VoltageDrive
    ) -> None:
        family, rates = self.family, self.family.baud_rates
        if config.baud_rate not in rates:
            raise UsageError(
                f"{family.name} servos do not have the baud rate {config.baud_rate}. Available: {sorted(rates)}"
            )
        if config.silence_s > family.longest_silence_s:
            raise UsageError(f"silence_s = {config.silence_s} is outside [0, {family.longest_silence_s}]")
        if drive.kind not in family.modes:
            raise UsageError(f"{family.name} servos take no {drive.kind.name}")
        self.config, self.drive = config, drive
        self.commanded, self.silence_s = drive.kind, config.silence_s
        self._mode, self.goal = family.modes[drive.kind]
        follows = isinstance(drive, PositionDrive)
        plain = {joint.servo_id: joint for joint in (drive.joints if follows else ())}
        middle = ServoJoint.zero_count if follows else 0.0
        self.joints = tuple(
            plain.get(j) or ServoJoint(f"servo {j}", j, middle) if isinstance(j, int) else j for j in joints
        )
        self.ids = tuple(joint.servo_id for joint in self.joints)
        self.motors = tuple(f"servo {i}" for i in self.ids)
        if not self.ids or len(set(self.ids)) < len(self.ids) or not all(0 <= i < BROADCAST_ID for i in self.ids):
            raise UsageError(
                f"servos {list(self.ids)}: there must be at least one, and each needs another id, from 0 to "
                f"{BROADCAST_ID - 1}"
            )
        for register, value in self.settings(self.ids[0]).items():
            if not register.minimum <= value <= register.maximum:
                raise UsageError(f"{register.name} = {value} is outside [{register.minimum}, {register.maximum}]")
        # Build the packet now, because make_safe must not take any time.
        self._off_packet = family.form.write_each(family.torque, dict.fromkeys(self.ids, 0))
        self.models: dict[int, ServoModel] = {}
        self.armed = self.halted = False
        self._link: ServoLink | None = None
        # For goals in counts: zero, unit of the command, and range, which `open` narrows to the servos' limits.
        self._at_zero = np.array([joint.zero_count for joint in self.joints])
        self._rad = np.array([joint.rad_per_count for joint in self.joints])
        self._zero, self._unit = self._at_zero, self._rad
        self._low, self._high = np.array([(joint.low_count, joint.high_count) for joint in self.joints]).T
        if isinstance(drive, VoltageDrive):
            self._zero = np.zeros(len(self.ids))
            self._unit = np.full(len(self.ids), drive.supply_v * self.goal.unit)
            self._low, self._high = self._zero + self.goal.minimum, self._zero + self.goal.maximum
        # The registers of the state, in one block, and units of speed and load; `open` corrects the units of speed.
        state = (family.position, family.velocity, family.load)
        self._state = sorted(state, key=lambda register: register.address)
        self._of_state = [self._state.index(register) for register in state]
        self._sign = np.array([joint.direction for joint in self.joints])
        self._load, self._speed = self._sign * family.load.unit, self._sign * family.velocity.unit

    # -- what differs between families

    def failure(self, answer: Answer, what: str) -> Exception:
        """Return the error to raise for an answer with an error: SafetyStop if the servo has stopped itself."""
        return SafetyStop(f"servo {answer.servo_id} reports the error {answer.error:#x} at the {what}")

    def model(self, servo_id: int, number: int) -> ServoModel:
        """Return the model of a servo; raise HardwareLost if the family's table does not describe it."""
        if number not in self.family.models:
            names = ", ".join(f"{model.name} ({n})" for n, model in self.family.models.items())
            raise HardwareLost(f"servo {servo_id} is model {number}, which is not supported. Available: {names}")
        return self.family.models[number]

    def prepare(self, joint: ServoJoint) -> None:
        """Read or write registers on which the settings depend, with torque off."""
        del joint

    def speed_unit(self, servo_id: int) -> float:
        """Return a count of a servo's measured speed [rad/s]."""
        del servo_id
        return self.family.velocity.unit

    def speed_count(self, servo_id: int, speed_rad_s: float) -> int:
        """Return the count for the speed of a servo's setpoint: 0 means unlimited, so no speed is rounded to 0."""
        del servo_id
        return 0 if math.isinf(speed_rad_s) else max(1, self.family.controller[2].count(speed_rad_s))

    # -- properties

    @property
    def link(self) -> ServoLink:
        """The link, once it is open."""
        if self._link is None:
            raise HardwareLost(f"the servos on {self.config.port} are not open", hint="call open first")
        return self._link

    @property
    def counters(self) -> Counters:
        return Counters() if self._link is None else self._link.counters

    @property
    def _watchdog_count(self) -> int:
        """Value of the watchdog's register: `silence_s` in its unit, at least 1 unless it is 0 (off)."""
        watchdog = self.family.watchdog
        return max(1, watchdog.count(self.silence_s)) if watchdog is not None and self.silence_s > 0.0 else 0

    def settings(self, servo_id: int) -> dict[Register, int]:
        """Return the registers of a servo's drive, and their values [counts]."""
        if isinstance(self.drive, VoltageDrive):
            return {}
        p_gain, d_gain, speed = self.family.controller
        speed_count = self.speed_count(servo_id, self.drive.speed_rad_s)
        return {**self.family.fixed, p_gain: self.drive.p_gain, d_gain: self.drive.d_gain, speed: speed_count}

    # -- from open to close

    def open(self) -> None:
        """Open the port, find the servos, take their torque off and write their settings."""
        if self._link is not None and not self._link.closed:
            raise UsageError("the servos are open already", hint="close them first")
        self.armed = self.halted = False
        self.models = {}
        self._link = ServoLink(self.config, self.family, self.failure)
        self._link.off_packet = self._off_packet
        self.clock = self._link.clock
        atexit.register(self.close)
        try:
            for joint in self.joints:
                self._find(joint)
                if not self.release(joint.servo_id):
                    raise HardwareLost(f"servo {joint.servo_id} does not confirm that its torque is off")
                for register, value in {**self.family.begin, self.family.mode: self._mode}.items():
                    self._link.set(joint.servo_id, register, value)
                self.prepare(joint)
                self._write(joint.servo_id, self.settings(joint.servo_id))
                self._narrow(joint)
            self._speed = self._sign * np.array([self.speed_unit(i) for i in self.ids])
        except BaseException:
            self.close()
            raise

    def without_host(self) -> tuple[str, ...]:
        kinds: dict[ServoModel, list[str]] = {}
        for servo_id, model in self.models.items():
            kinds.setdefault(model, []).append(f"servo {servo_id}")
        return tuple(f"{m.name} ({', '.join(ids)}) {m.without_host(self.silence_s)}" for m, ids in kinds.items())

    def facts(self) -> dict[str, dict[str, str]]:
        link, family = self.link, self.family
        facts: dict[str, dict[str, str]] = {"firmware": {}, "voltage": {}, "temperature": {}}
        # Read the facts for the log even from a servo that reports an error, such as an alarm.
        for servo_id, motor in zip(self.ids, self.motors, strict=True):
            numbers = [link.read(servo_id, r, despite_error=True) for r in (*family.firmware, family.voltage)]
            facts["firmware"][motor] = ".".join(map(str, numbers[:-1]))
            facts["voltage"][motor] = f"{0.1 * numbers[-1]:.1f} V"
            facts["temperature"][motor] = f"{link.read(servo_id, family.temperature, despite_error=True)} °C"
        return facts

    def reach(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the lowest and the highest command, each ``(n,)``: half a count beyond the range, as goals round."""
        ends = (self._low - 0.5 - self._zero) * self._unit, (self._high + 0.5 - self._zero) * self._unit
        return np.minimum(*ends), np.maximum(*ends)  # a direction of -1 swaps them

    def following(self) -> Following | None:
        """Return how joints follow their goals: at the limit, a servo pushes with nearly all of its torque."""
        if isinstance(self.drive, VoltageDrive) or not self.drive.p_gain:
            return None
        speed_rad_s = min(_SLOW_RAD_S, 0.5 * self.drive.speed_rad_s)
        return Following(_MOST_SHARE * self.family.full_rad / self.drive.p_gain, RESPONSE_S, speed_rad_s)

    def enable(self) -> np.ndarray:
        """Write the settings again, set goals at the present positions, and switch the torque on."""
        self.armed = False
        self._guard()
        link, family, goals = self.link, self.family, np.zeros(len(self.ids), np.int64)
        for i, joint in enumerate(self.joints):
            servo_id = joint.servo_id
            # A tripped watchdog refuses goals, so clear it first and arm it last. Goals come before torque: some
            # firmware         # switches torque on at the goal's write, and holds the position.
            if family.watchdog is not None:
                link.write(servo_id, family.watchdog, 0)
            self._write(servo_id, self.settings(servo_id))
            goals[i] = self._goal_at_rest(i)
            link.set(servo_id, self.goal, int(goals[i]))
            link.write(servo_id, family.torque, 1)
            if family.watchdog is not None:
                # Some servos set their goals to the present positions when torque goes on.
                link.write(servo_id, family.watchdog, self._watchdog_count)
        self.armed = True
        if link.at_rest:
            self.armed = False
            raise _made_safe()
        return (goals - self._zero) * self._unit

    def measure(self) -> Reading:
        counts, transaction = self.link.read_counts(self.ids, self._state, "read of the state")
        position, speed, load = (counts[:, i] for i in self._of_state)
        return Reading(
            position_rad=(position - self._at_zero) * self._rad,
            velocity_rad_s=speed * self._speed,
            load=load * self._load,
            transaction=transaction,
        )

    def command(self, values: np.ndarray) -> Transaction:
        """Send goals ``(n,)`` [the unit of `commanded`]; a single servo confirms, several get one instruction.

        Raises:
            SafetyStop: A goal is not finite or out of range, a servo has stopped itself, or torque is off.
        """
        # Refuse every goal before any is sent.
        counts = self._zero + np.asarray(values, np.float64) / self._unit
        possible = (counts >= self._low - 0.5 - 1e-6) & (counts <= self._high + 0.5 + 1e-6)
        for i in np.flatnonzero(~possible).tolist():
            (low, high), unit = (ends[i] for ends in self.reach()), self.drive.kind.unit
            raise SafetyStop(
                f"joint {self.joints[i].name!r}: {values[i]:.6g} {unit} is outside [{low:.6g}, {high:.6g}]"
            )
        goals = np.clip(np.rint(counts), self._low, self._high).astype(int).tolist()
        if len(goals) == 1:
            return self.link.write(self.ids[0], self.goal, goals[0])
        return self.link.write_each(self.goal, dict(zip(self.ids, goals, strict=True)))

    def check(self) -> None:
        """Raise SafetyStop if a servo's watchdog has tripped, or a servo has lost its settings in a restart.

        Goals for several servos are not confirmed, and a restarted servo accepts goals although its torque is off.
        """
        if not self.armed:
            return
        family = self.family
        for registers in family.watched:
            counts, _ = self.link.read_counts(self.ids, registers, "read of the settings")
            for servo_id, row in zip(self.ids, counts.tolist(), strict=True):
                expected = {family.torque: 1, family.watchdog: self._watchdog_count, **self.settings(servo_id)}
                for register, current in zip(registers, row, strict=True):
                    if register is family.watchdog and current < 0:
                        raise self.tripped(servo_id)
                    # Another thread may have taken the torque off meanwhile.
                    if current != expected[register] and self.armed:
                        raise SafetyStop(
                            f"servo {servo_id} has lost its settings: {register.name} is {current}, not "
                            f"{expected[register]}",
                            hint="did its supply fail for a moment, or does another program use the bus?",
                        )

    def tripped(self, servo_id: int) -> SafetyStop:
        """Return the error for a servo whose bus watchdog has tripped."""
        return SafetyStop(
            f"the bus watchdog of servo {servo_id} has tripped: no instruction came for longer than silence_s",
            hint="is this computer too busy, or does a loop stall? switching torque on again clears it",
        )

    def require_watching(self) -> None:
        if self._link is not None and self._link.guardian is not None:
            self._link.guardian.require_watching()

    # -- the ways out

    def disable(self) -> None:
        """Switch the torque off: of all servos at once, then of each one until it confirms.

        The guardian watches until all have confirmed: if one does not, the guardian goes on trying.

        Raises:
            HardwareLost: A servo does not confirm; the others were switched off.
        """
        link = self.link
        self.armed, link.at_rest = False, True
        guardian = link.guardian
        if guardian is not None and not guardian.settle():
            guardian.disarm()  # the guardian has taken over or died: take the torque off all the same
        if unconfirmed := self._release(self.ids):
            raise HardwareLost(
                f"servos {unconfirmed} on {self.config.port} do not confirm that their torque is off",
                hint="cut their power",
            )
        if guardian is not None:
            guardian.disarm()

    def make_safe(self) -> None:
        """Take the torque off without a lock and without waiting for answers: for signal handlers and watchdog threads.

        No lock, because the code that a signal interrupts may hold it. Torque cannot be switched on again afterwards.
        """
        # The order matters: `_guard`, in another thread, allows motion and then reads `halted`; `enable` sets `armed`
        # # and then reads `at_rest`.
        self.halted = True
        if self._link is not None:
            self._link.at_rest = True
        self.armed = False
        if self._link is not None:
            self._link.make_safe()

    def close(self) -> None:
        """Take the torque off, and close the port. Never raises; may be called twice, and before `open`.

        If a servo does not confirm, the guardian tries for another 10 s.
        """
        link = self._link
        if link is None or link.closed:
            return
        self.halted = True
        link.at_rest, self.armed = True, False
        guardian = link.guardian
        # If the guardian is taking the torque off, let it finish: both use the same line.
        if guardian is not None:
            guardian.settle()
        # Release every servo; the guardian continues with those that do not confirm.
        if unconfirmed := self._release(self.models):
            _LOGGER.error("servos %s did not confirm that their torque is off", unconfirmed)
        link.close()
        if guardian is not None:
            guardian.end(confirmed=not unconfirmed)
        atexit.unregister(self.close)

    def release(self, servo_id: int) -> bool:
        """Switch a servo's torque off, then its watchdog; return whether it has confirmed. Never raises."""
        family = self.family
        confirmed = self.link.force(servo_id, family.torque, 0)
        if confirmed and family.watchdog is not None:
            self.link.force(servo_id, family.watchdog, 0)
        return confirmed

    def _release(self, servo_ids: Iterable[int]) -> list[int]:
        """Take the torque of all servos off at once; return the servos that do not confirm. Never raises."""
        self.link.send_off()
        return [servo_id for servo_id in servo_ids if not self.release(servo_id)]

    def _guard(self) -> None:
        """Arm the guardian before torque goes on; start it at the first call."""
        if self.halted:
            raise _made_safe()
        link = self.link
        if self.config.guardian:
            if link.guardian is None:
                queries = link.form.torque_queries(self.family.torque, self.ids)
                times_s = self.config.silence_s, self.config.reply_timeout_s
                link.guardian = link.port.guardian(self._off_packet, queries, *times_s)
            link.guardian.arm()
        link.at_rest = False
        if self.halted:  # in another thread, or by a signal
            link.at_rest = True
            raise _made_safe()

    # -- one servo

    def _find(self, joint: ServoJoint) -> None:
        """Find a joint's servo and its model; raise HardwareLost if it does not answer, or two have its id."""
        servo_id, link = joint.servo_id, self.link
        whose = "" if joint.name == f"servo {servo_id}" else f" (joint {joint.name!r})"
        try:
            link.ping(servo_id)
        except HardwareLost as error:
            raise HardwareLost(
                f"servo {servo_id}{whose} does not answer on {self.config.port} at {self.config.baud_rate} baud. "
                f"Available: {sorted(link.scan())}",
                hint=f"check power, cable, id and baud rate{link.port.advice}; two servos of one id garble each "
                "other's answers: connect one at a time",
            ) from error
        # Two servos of one id answer every ping twice; a late answer to an earlier ping comes only once.
        ping, wait_s = link.form.build(servo_id, Instruction.PING), 2.0 * self.config.reply_timeout_s
        if all(link.answering(ping, wait_s).count(servo_id) > 1 for _ in range(_SHARED_PINGS)):
            raise HardwareLost(
                f"two servos on {self.config.port} have the id {servo_id}{whose}: both answer, and both would obey",
                hint="connect one of them at a time, and give each another id",
            )
        self.models[servo_id] = self.model(servo_id, link.read(servo_id, self.family.model_number, True))

    def _narrow(self, joint: ServoJoint) -> None:
        """Narrow goals to the servo's own limits, which must contain the whole range of a calibrated joint."""
        low, high = (self.link.read(joint.servo_id, register) for register in self.family.limits)
        if isinstance(self.drive, VoltageDrive) or (low, high) == (0, 0):
            return
        if joint.homing_offset is not None and not low <= joint.low_count < joint.high_count <= high:
            raise HardwareLost(
                f"servo {joint.servo_id} (joint {joint.name!r}) accepts {low} to {high} counts only, its joint needs "
                f"{joint.low_count} to {joint.high_count}",
                hint="calibrate again, or narrow the joint's range",
            )
        i = self.ids.index(joint.servo_id)
        self._low[i], self._high[i] = max(joint.low_count, low), min(joint.high_count, high)

    def _write(self, servo_id: int, values: Mapping[Register, int]) -> None:
        for register, value in values.items():
            self.link.set(servo_id, register, value)

    def _goal_at_rest(self, i: int) -> int:
        """Return the goal that holds a joint where it is; raise SafetyStop if it is far outside its range."""
        if isinstance(self.drive, VoltageDrive):
            return 0
        joint, low, high = self.joints[i], int(self._low[i]), int(self._high[i])
        count = self.link.read(joint.servo_id, self.family.position)
        goal = min(max(count, low), high)
        if abs(goal - count) * abs(joint.rad_per_count) > _BEYOND_RAD:
            ends = sorted((joint.angle(low), joint.angle(high)))
            raise SafetyStop(
                f"joint {joint.name!r} is at {joint.angle(count):.4g} rad, outside [{ends[0]:.4g}, {ends[1]:.4g}]",
                hint="move it by hand, or calibrate again",
            )
        return goal


def _made_safe() -> SafetyStop:
    return SafetyStop("torque stays off: the servos have been made safe", hint="open them again")
