"""Emulated servos of any family: the firmware of a servo, made of the family's table, and the bus.

The base class is a position servo that confirms writes, drops invalid values without an error, and has no watchdog. A
family overrides what its firmware does differently.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, Final

from sim2real.emulation.bus import BusEmulation, PlannedBus, Request, Sample
from sim2real.emulation.plant import Plant
from sim2real.emulation.truth import TruthLog
from sim2real.hardware.bus.packets import BROADCAST_ID, Instruction, Parser
from sim2real.hardware.bus.registers import RETURN_DELAY_UNIT_S, Family, Register
from sim2real.hardware.device import OperatingMode

_DAMAGED: Final = 1  # result of `refusal` for an error that the family does not report


class ServoFirmware:
    """Registers and firmware of one servo, without time, bus and physics.

    Args:
        return_delay_us: Return Delay Time at power-up, rounded to the register's unit of 2 us [us].

    Attributes:
        heard_ns: Time of the last instruction that it received [ns].
        watchdog_stops: Whether a tripped watchdog stops the motor.
        atomic: Whether a write with one refused value is refused as a whole, with an error.
        offset_sign: Sign of the homing offset in the position that is read.
        wild_counts: Range of impossible positions [counts].
        answers_together: Whether several servos answer a broadcast ping, one after the other.
        misunderstandings: Errors for a wrong checksum, an unknown instruction, and a READ of a wrong length; none: it
            does not answer them.
    """

    family: ClassVar[Family]
    fixed: ClassVar[tuple[Register, ...]] = ()
    homing: ClassVar[Register | None] = None
    offset_sign: ClassVar[int] = 1
    atomic: ClassVar[bool] = False
    watchdog_stops: bool = False
    wild_counts: ClassVar[tuple[int, int]] = (8192, 32768)
    answers_together: ClassVar[bool] = False
    misunderstandings: ClassVar[tuple[int, ...]] = ()

    def __init__(self, servo_id: int, model_number: int, return_delay_us: int = 500) -> None:
        self.servo_id, self.heard_ns = servo_id, 0
        self._memory = bytearray(self.family.size)
        for register in self.family.registers.values():
            self.put(register, register.default)
        self.put(self.family.model_number, model_number)
        self.put(self.family.servo_id, servo_id)
        self.put(self.family.return_delay, round(return_delay_us * 1e-6 / RETURN_DELAY_UNIT_S))

    def get(self, register: Register) -> int:
        """Return a register's value in counts."""
        return register.decode(self._memory[register.address : register.end])

    def put(self, register: Register, value: int) -> None:
        """Set a register, without the checks of a write from the bus."""
        self._memory[register.address : register.end] = register.encode(value)
        self._watchdog_ns = None

    # -- called by the bus

    @property
    def return_delay_s(self) -> float:
        """Time between an instruction and its answer [s]."""
        return self.get(self.family.return_delay) * RETURN_DELAY_UNIT_S

    @property
    def answers_reads(self) -> bool:
        """Whether it answers reads."""
        return True

    @property
    def confirms(self) -> bool:
        """Whether it answers writes."""
        return True

    @property
    def alert(self) -> int:
        """Bits of the present error, which are set in the error byte of every answer."""
        return 0

    @property
    def identity(self) -> bytes:
        """The data of its answer to a ping."""
        return b""

    def read(self, address: int, length: int) -> tuple[int, bytes]:
        """Return the error and the bytes of the answer to a READ; beyond the table, zeros."""
        return 0, bytes(self._memory[address : address + length]).ljust(length, b"\0")

    def write(self, address: int, data: bytes) -> tuple[int, bool]:
        """Write the registers that lie wholly within the data; return the error, and whether `command` may change.

        A refused value is dropped; an `atomic` family then writes no value, and reports the error.
        """
        registers = self.family.registers.values()
        whole = [r for r in registers if address <= r.address and r.end <= address + len(data)]
        pairs = [(r, r.decode(data[r.address - address : r.end - address])) for r in whole]
        refused = [self.refusal(register, value) for register, value in pairs]
        if self.atomic and (error := self.misfit(address, data, whole) or next(filter(None, refused), 0)):
            return error, False
        was_on, moved = self.get(self.family.torque), False
        for (register, value), error in zip(pairs, refused, strict=True):
            if not error:
                self.put(register, value)
                self.written(register, value)
                moved |= self.family.moves(register, (1,)) or register == self.family.mode
        is_on = self.get(self.family.torque)
        if is_on and not was_on:
            self.switched_on()
        return 0, moved and bool(was_on or is_on)

    def reboot(self) -> None:
        """Restart as after a loss of power: torque off, and all registers outside the EEPROM at their defaults."""
        for register in self.family.registers.values():
            if not register.eeprom:
                self.put(register, register.default)

    # -- the motor

    def command(self) -> tuple[int, float]:
        """Return mode and goal of the motor, as ``Plant.command`` takes them, according to the registers."""
        return self.driven() if self.get(self.family.torque) else (OperatingMode.OFF, 0.0)

    def driven(self) -> tuple[int, float]:
        """Return mode and goal while torque is on: the position [rad from the encoder's zero]."""
        return OperatingMode.POSITION, (self.get(self.family.goal) - self.offset) * self.family.goal.unit

    @property
    def offset(self) -> int:
        """Offset that the firmware adds to the encoder's count [counts]."""
        return 0 if self.homing is None else self.offset_sign * self.get(self.homing)

    def controller(self) -> tuple[int, int, float]:
        """Return P gain and D gain of the position controller [counts], and its setpoint's speed [rad/s]."""
        p_gain, d_gain, speed = self.family.controller
        count = self.get(speed)
        return self.get(p_gain), self.get(d_gain), count * speed.unit if count else math.inf

    def refresh(self, position_rad: float, velocity_rad_s: float, load: float, tick_ms: int = 0) -> None:
        """Set the registers of present values.

        Args:
            position_rad: Angle from the encoder's zero [rad].
            load: Fraction of the largest load, in [-1, 1].
            tick_ms: Time since power-up [ms].
        """
        del tick_ms
        family = self.family
        self.put(family.position, family.position.count(position_rad) + self.offset)
        self.put(family.velocity, family.velocity.count(velocity_rad_s))
        self.put(family.load, family.load.count(max(-1.0, min(1.0, load))))

    def watchdog_deadline_ns(self) -> int | None:
        """Return the time at which its watchdog trips without an instruction; None if it has none, or it is off."""
        if self._watchdog_ns is None:  # written out for speed: the bus calls this at every event
            watchdog, armed = self.family.watchdog, self.get(self.family.torque)
            limit = self.get(watchdog) * watchdog.unit if watchdog is not None and armed else 0.0
            self._watchdog_ns = max(round(1e9 * limit), 0)
        return self.heard_ns + self._watchdog_ns if self._watchdog_ns else None

    def trip_watchdog(self) -> None:
        """Trip the watchdog."""

    # -- overridden by families

    def refusal(self, register: Register, value: int) -> int:
        """Return the firmware's error for a value, 0 if the value is valid."""
        taken = register.writable and register not in self.fixed and register.minimum <= value <= register.maximum
        return 0 if taken else _DAMAGED

    def misfit(self, address: int, data: bytes, whole: list[Register]) -> int:
        """Return the error for data that are not whole registers."""
        del address, data, whole
        return 0

    def written(self, register: Register, value: int) -> None:
        """React to a value that was written."""

    def switched_on(self) -> None:
        """React to torque that was switched on."""


class ServoBus(PlannedBus["ServoEmulation"]):
    """Emulated servos of one family on a bus, driving a plant; arguments as in `PlannedBus`."""

    def __init__(self, plant: Plant, config: ServoEmulation, truth: TruthLog, send: Callable[[bytes], bool]) -> None:
        self.servos = {i: config.servo(i) for i in sorted(plant.servo_ids)}
        self.form = next(iter(self.servos.values())).family.form
        self._handlers: dict[int, Callable[[Request, list[ServoFirmware]], None]] = {
            Instruction.PING: self._ping,
            Instruction.READ: self._read,
            Instruction.WRITE: self._write,
            Instruction.REBOOT: self._reboot,
            Instruction.SYNC_READ: self._sync_read,
            Instruction.SYNC_WRITE: self._sync_write,
        }
        super().__init__(plant, config, truth, send, Parser(self.form), self.servos)

    def execute(self, request: Request) -> None:
        packet = request.packet
        if packet.code == Instruction.STATUS:
            return
        # Every servo that receives the instruction resets its watchdog.
        broadcast = packet.servo_id == BROADCAST_ID
        targets = [s for i, s in self.servos.items() if broadcast or i == packet.servo_id]
        if packet.intact:
            for servo in targets:
                servo.heard_ns = request.t_ns
        handler = self._handlers.get(packet.code)
        if targets and packet.intact and handler is not None:
            handler(request, targets)
        elif targets and not broadcast:
            self._refuse(targets[0], request, 1 if packet.intact else 0)

    def _ping(self, request: Request, targets: list[ServoFirmware]) -> None:
        for servo in targets if len(targets) == 1 or targets[0].answers_together else ():
            self._answer(servo, request, 0, servo.identity)

    def _refuse(self, servo: ServoFirmware, request: Request, kind: int) -> None:
        """Let a servo answer an instruction that it does not understand, if its protocol has errors for that."""
        if servo.misunderstandings:
            self._answer(servo, request, servo.misunderstandings[kind])

    def _answer(
        self, servo: ServoFirmware, request: Request, error: int, data: bytes = b"", sample: Sample | None = None
    ) -> None:
        """Let a servo answer, with the line's faults; ``sample``: the measurement in the answer."""
        sender = servo.servo_id ^ 0x40 if self.happens(self.config.wrong_id) else servo.servo_id
        status = self.form.build_status(sender, error | servo.alert, data)
        status = status[:4] if self.happens(self.config.cut) else status
        self.reply(servo.servo_id, request, status, servo.return_delay_s, sample)

    def _confirm(self, servo: ServoFirmware, request: Request, error: int) -> None:
        """Let a servo answer an instruction that writes."""
        if request.packet.servo_id != BROADCAST_ID and servo.confirms:
            self._answer(servo, request, error)

    def _read_by(self, servo: ServoFirmware, request: Request) -> None:
        """Let a servo answer a read."""
        address, length = self.form.word(request.packet.parameters, 0), self._second_word(request)
        sample = self.measure(servo, request.t_ns)
        if self.happens(self.config.wild):
            servo.put(servo.family.position, self.random.randrange(*servo.wild_counts))
        error, data = servo.read(address, length)
        if servo.answers_reads:
            present = servo.family.position, servo.family.velocity, servo.family.load
            measured = any(address < r.end and address + length > r.address for r in present)
            self._answer(servo, request, error, data, sample if measured else None)

    def _read(self, request: Request, targets: list[ServoFirmware]) -> None:
        if request.packet.servo_id == BROADCAST_ID:
            return
        if len(request.packet.parameters) != 2 * self.form.address_bytes:
            self._refuse(targets[0], request, 2)
        else:
            self._read_by(targets[0], request)

    def _sync_read(self, request: Request, targets: list[ServoFirmware]) -> None:
        del targets
        for servo_id in request.packet.parameters[2 * self.form.address_bytes :]:
            if servo_id in self.servos:
                self._read_by(self.servos[servo_id], request)

    def _write(self, request: Request, targets: list[ServoFirmware]) -> None:
        parameters = request.packet.parameters
        address, data = self.form.word(parameters, 0), parameters[self.form.address_bytes :]
        for servo in targets:
            self._confirm(servo, request, self._write_to(servo, request, address, data))

    def _sync_write(self, request: Request, targets: list[ServoFirmware]) -> None:
        del targets
        parameters, begin = request.packet.parameters, 2 * self.form.address_bytes
        address, length = self.form.word(parameters, 0), self._second_word(request)
        for i in range(begin, len(parameters) - length, length + 1):
            if parameters[i] in self.servos:
                self._write_to(self.servos[parameters[i]], request, address, parameters[i + 1 : i + 1 + length])

    def _reboot(self, request: Request, targets: list[ServoFirmware]) -> None:
        for servo in targets:
            self._confirm(servo, request, 0)
            servo.reboot()
            self.configure(servo)
            self.actuate(servo, request)

    def _write_to(self, servo: ServoFirmware, request: Request, address: int, data: bytes) -> int:
        """Let a servo change its registers, and the motor follow; return the error."""
        self.measure(servo, request.t_ns)
        error, moves = servo.write(address, data)
        self.configure(servo)
        if moves:
            self.actuate(servo, request)
        return error

    def _second_word(self, request: Request) -> int:
        return self.form.word(request.packet.parameters, self.form.address_bytes)


@dataclass(frozen=True)
class ServoEmulation(BusEmulation, ABC):
    """Settings of emulated servos on their bus; see `Emulation` and `BusEmulation` for further settings.

    Args:
        wrong_id: Probability that an answer has the id of another servo.
        cut: Probability that an answer ends after its fourth byte.
    """

    wrong_id: float = 0.0
    cut: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require({"wrong_id": (0.0, 1.0), "cut": (0.0, 1.0)})

    def planned(self, physics: Plant, truth: TruthLog, send: Callable[[bytes], bool]) -> ServoBus:
        return ServoBus(physics, self, truth, send)

    @abstractmethod
    def servo(self, servo_id: int) -> ServoFirmware:
        """Return a servo with these settings."""
