"""The registers of a servo's memory, for all families: their addresses, and the encoding of their numbers."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import partial
from typing import Final

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
        sign: Number of the sign bit beside a magnitude; or `TWOS_COMPLEMENT`; None: never negative.
        eeprom: Whether its value survives a loss of power.
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

    @property
    def end(self) -> int:
        """The address after the register's last byte."""
        return self.address + self.size

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
class MemoryTable:
    """The memory of a servo, with the registers that drivers of all families use.

    Args:
        named: The values of a module of registers; values of other types are ignored.
        torque: The register that holds 0 while torque is off.
        goals: The registers that can move the motor while torque is on.
        return_delay: The register of the time between instruction and answer, in units of 2 us.
        firmware: The registers of the firmware's version, major number first.
        voltage: The register of the supply voltage, in units of 0.1 V.
        temperature: The register of the motor's temperature [deg C].
    """

    named: Iterable[object]
    size: int
    torque: Register
    goals: tuple[Register, ...]
    model_number: Register
    servo_id: Register
    return_delay: Register
    position: Register
    firmware: tuple[Register, ...]
    voltage: Register
    temperature: Register
    registers: dict[int, Register] = field(init=False)
    """Address -> register."""

    def __post_init__(self) -> None:
        """Keep the registers alone."""
        registers = sorted((r for r in self.named if isinstance(r, Register)), key=lambda r: r.address)
        object.__setattr__(self, "registers", {r.address: r for r in registers})
