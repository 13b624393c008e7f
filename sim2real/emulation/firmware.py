"""The firmware of one emulated servo, made of its family's table, with hooks where families differ."""

from __future__ import annotations

import math
from typing import ClassVar, Final

from sim2real.hardware.bus.registers import RETURN_DELAY_UNIT_S, Family, Register
from sim2real.hardware.device import OperatingMode

_DAMAGED: Final = 1  # an error of `refusal` that the family does not report


class ServoFirmware:
    """Registers and firmware of one servo, without time, bus and physics.

    As it is: a position servo that confirms what is written, drops what its registers cannot hold without an error, and
    has no watchdog.

    Args:
        return_delay_us: Return Delay Time at power-up, rounded to the register's unit of 2 us [us].
        encoder_counts: Resolution of the encoder [counts per revolution].

    Attributes:
        heard_ns: Time of the last instruction that it received.
        watchdog_stops: Whether a tripped watchdog stops the motor.
        atomic: Whether a write that is refused in part is refused as a whole, with an error.
        offset_sign: Sign of the homing offset in what is read.
    """

    family: ClassVar[Family]
    fixed: ClassVar[tuple[Register, ...]] = ()
    homing: ClassVar[Register | None] = None
    offset_sign: ClassVar[int] = 1
    atomic: ClassVar[bool] = False
    watchdog_stops: bool = False

    def __init__(
        self, servo_id: int, model_number: int, return_delay_us: int = 500, encoder_counts: int = 4096
    ) -> None:
        self.servo_id = servo_id
        self.heard_ns = 0
        self._encoder_counts = encoder_counts
        self._memory = bytearray(self.family.size)
        self._registered: tuple[int, bytes] | None = None
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

    # -- what the bus asks

    @property
    def return_delay_s(self) -> float:
        """Time between an instruction and its answer [s]."""
        return self.get(self.family.return_delay) * RETURN_DELAY_UNIT_S

    @property
    def answers_reads(self) -> bool:
        """Whether it answers when it is read."""
        return True

    @property
    def confirms(self) -> bool:
        """Whether it answers when it is written."""
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

        A value that is refused is dropped; an `atomic` family then writes none, and reports the error.
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

    def register_write(self, address: int, data: bytes) -> None:
        """Store a REG_WRITE until the next ACTION."""
        self._registered = (address, data)

    def action(self) -> tuple[int, bool]:
        """Carry out the stored write, if there is one; return as `write`."""
        if self._registered is None:
            return 0, False
        stored, self._registered = self._registered, None
        return self.write(*stored)

    def reboot(self) -> None:
        """Restart as after a loss of power: torque off, and all registers outside the EEPROM at their defaults."""
        self._registered = None
        for register in self.family.registers.values():
            if not register.eeprom:
                self.put(register, register.default)

    # -- what the motor does

    def command(self) -> tuple[int, float]:
        """Return mode and goal of the motor, as ``Plant.command`` takes them, according to the registers."""
        if not self.get(self.family.torque):
            return OperatingMode.OFF, 0.0
        return self.driven()

    def driven(self) -> tuple[int, float]:
        """Return mode and goal while torque is on: the position [rad from the encoder's zero]."""
        return OperatingMode.POSITION, (self.get(self.family.goal) - self.offset) * self.family.goal.unit

    @property
    def offset(self) -> int:
        """What its firmware adds to the encoder's count [counts]."""
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
        # Round the angle to the encoder's resolution, then to counts of the register.
        del tick_ms
        family, step_rad = self.family, 2.0 * math.pi / self._encoder_counts
        count = family.position.count(round(position_rad / step_rad) * step_rad)
        self.put(family.position, count + self.offset)
        self.put(family.velocity, family.velocity.count(velocity_rad_s))
        self.put(family.load, family.load.count(max(-1.0, min(1.0, load))))

    def watchdog_deadline_ns(self) -> int | None:
        """Return the time at which its watchdog trips without an instruction; None if it has none, or it is off."""
        watchdog = self.family.watchdog
        if watchdog is None or self.get(watchdog) <= 0 or not self.get(self.family.torque):
            return None
        return self.heard_ns + round(self.get(watchdog) * watchdog.unit * 1e9)

    def trip_watchdog(self) -> None:
        """Trip the watchdog."""

    def overload(self) -> None:
        """Shut down as after an overload: torque off, and an error reported from now on."""
        self.put(self.family.torque, 0)

    # -- where families differ

    def refusal(self, register: Register, value: int) -> int:
        """Return the firmware's error for a value, 0 if it takes it."""
        taken = register.writable and register not in self.fixed and register.minimum <= value <= register.maximum
        return 0 if taken else _DAMAGED

    def misfit(self, address: int, data: bytes, whole: list[Register]) -> int:
        """Return the error for data that are not whole registers."""
        del address, data, whole
        return 0

    def written(self, register: Register, value: int) -> None:
        """React to a value that was written."""

    def switched_on(self) -> None:
        """React to the torque, which has gone on."""
