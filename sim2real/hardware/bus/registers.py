"""A family of servos as a table: registers, models, and settings that are written at the start."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Final

from sim2real.hardware.bus.packets import PacketFormat
from sim2real.hardware.device import POSITION, CommandKind

TWOS_COMPLEMENT: Final = -1
RETURN_DELAY_UNIT_S: Final = 2e-6


@dataclass(frozen=True)
class Register:
    """One entry of a servo's memory table.

    Args:
        name: The manual's name, in lower case.
        size: Number of bytes, little endian: 1, 2 or 4.
        minimum: Smallest value that may be written [counts].
        maximum: Largest value that may be written [counts].
        default: Value after power-up [counts].
        sign: Number of the sign bit, if the other bits are a magnitude; or `TWOS_COMPLEMENT`; None: never negative.
        eeprom: Whether its value survives a loss of power.
        unit: Value of one count, in SI units.
    """

    name: str
    address: int
    size: int
    minimum: int = 0
    maximum: int = 0
    default: int = 0
    sign: int | None = None
    writable: bool = False
    eeprom: bool = False
    unit: float = 1.0

    @property
    def end(self) -> int:
        """The address after the register's last byte."""
        return self.address + self.size

    def count(self, value: float) -> int:
        """Return the count nearest to a value in SI units."""
        return round(value / self.unit)

    def decode(self, data: bytes | bytearray) -> int:
        """Return the value of `size` bytes [counts]."""
        value = int.from_bytes(data, "little", signed=self.sign == TWOS_COMPLEMENT)
        if self.sign is None or self.sign == TWOS_COMPLEMENT or not value >> self.sign & 1:
            return value
        return -(value & ~(1 << self.sign))

    def encode(self, value: int) -> bytes:
        """Return the bytes of a value [counts], wrapped to the register's size; a magnitude is cut to what fits."""
        if self.sign is not None and self.sign != TWOS_COMPLEMENT:
            value = min(abs(value), (1 << self.sign) - 1) | (value < 0) << self.sign
        return (value & ((1 << (8 * self.size)) - 1)).to_bytes(self.size, "little")


ram = partial(Register, writable=True)
eeprom = partial(Register, writable=True, eeprom=True)


@dataclass(frozen=True)
class ServoModel:
    """A servo model, and its reaction to the death of the computer that controls it.

    Args:
        stops_alone: Whether it stops when its own bus watchdog trips; None: it has no watchdog.
        source: Who documents or measured this.
    """

    name: str
    stops_alone: bool | None
    source: str

    def without_host(self, watchdog_s: float) -> str:
        """Return the reaction as a phrase; a ``watchdog_s`` of 0 switches the servo's bus watchdog off."""
        if self.stops_alone is None or not watchdog_s:
            why = "it has no bus watchdog" if self.stops_alone is None else "its bus watchdog is off"
            return f"goes on as commanded last ({why})"
        if self.stops_alone:
            return f"stops after {watchdog_s:g} s, torque stays on"
        return f"notices after {watchdog_s:g} s, but goes on as commanded last"


@dataclass(frozen=True)
class Family:
    """Servos with one packet format and one memory table, for driver and emulator.

    Args:
        name: Their name in messages.
        named: The registers, e.g. a module's namespace; values of other types are ignored.
        size: Number of bytes of the memory.
        baud_rates: Supported baud rates [bit/s].
        torque: Holds 0 while torque is off.
        modes: Kind of command -> the value of the register `mode`, and the register of the command.
        goals: All registers that can move the motor while torque is on.
        limits: Registers of the lowest and the highest position; both 0: no limit.
        mode: The operating mode.
        return_delay: Time between instruction and answer, in units of 2 us.
        controller: P gain, D gain, and speed of the setpoint.
        firmware: The firmware's version, major number first.
        voltage: The supply voltage, in units of 0.1 V.
        temperature: The motor's temperature [deg C].
        begin: Values that are written at `open`, such as "answer every instruction".
        fixed: Values that are written before torque goes on, in addition to those of the controller.
        watched: Groups of neighbouring registers that `check` reads, and compares with the values that were written.
        full_rad: Position error times P gain at which the controller gives full torque [rad].
        models: Model number -> model.
        watchdog: Register with the longest silence of the host, after which the servo's own watchdog trips and the
            register is below 0; 0: off; None: there is no watchdog.
    """

    name: str
    form: PacketFormat
    named: Iterable[object]
    size: int
    baud_rates: tuple[int, ...]
    torque: Register
    modes: Mapping[CommandKind, tuple[int, Register]]
    goals: tuple[Register, ...]
    limits: tuple[Register, Register]
    mode: Register
    model_number: Register
    servo_id: Register
    return_delay: Register
    position: Register
    velocity: Register
    load: Register
    controller: tuple[Register, Register, Register]
    firmware: tuple[Register, ...]
    voltage: Register
    temperature: Register
    begin: Mapping[Register, int]
    fixed: Mapping[Register, int]
    watched: tuple[tuple[Register, ...], ...]
    full_rad: float
    models: Mapping[int, ServoModel]
    watchdog: Register | None = None
    registers: dict[int, Register] = field(init=False)
    """Address -> register."""

    def __post_init__(self) -> None:
        registers = sorted((r for r in self.named if isinstance(r, Register)), key=lambda r: r.address)
        object.__setattr__(self, "registers", {r.address: r for r in registers})

    @property
    def goal(self) -> Register:
        """The goal of the position controller."""
        return self.modes[POSITION][1]

    @property
    def longest_silence_s(self) -> float:
        """The longest time that the watchdog can be set to [s]."""
        return math.inf if self.watchdog is None else self.watchdog.maximum * self.watchdog.unit

    def moves(self, register: Register, values: Iterable[int]) -> bool:
        """Return whether a write could move a motor, or switch its torque on."""
        return register in self.goals or (register == self.torque and any(values))
