"""The firmware of one emulated servo: what does not depend on its family."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

from sim2real.hardware.bus.registers import RETURN_DELAY_UNIT_S, MemoryTable, Register
from sim2real.hardware.emulation.emulated_bus import Firmware


class ServoFirmware(Firmware, ABC):
    """Registers of one servo, and the rules of its firmware, without time, bus and physics.

    Args:
        return_delay_us: Return Delay Time at power-up, rounded to the register's unit of 2 us [us].
        encoder_counts: Resolution of the encoder [counts per revolution].

    Attributes:
        table: Its memory.
    """

    table: ClassVar[MemoryTable]
    watchdog_stops: bool = False

    def __init__(
        self, servo_id: int, model_number: int, return_delay_us: int = 500, encoder_counts: int = 4096
    ) -> None:
        self.servo_id = servo_id
        self.heard_ns = 0
        self._encoder_counts = encoder_counts
        self._memory = bytearray(self.table.size)
        self._registered: tuple[int, bytes] | None = None
        for register in self.table.registers.values():
            self.put(register, register.default)
        self.put(self.table.model_number, model_number)
        self.put(self.table.servo_id, servo_id)
        self.put(self.table.return_delay, round(return_delay_us * 1e-6 / RETURN_DELAY_UNIT_S))

    def get(self, register: Register) -> int:
        """Return a register's value in counts."""
        return register.decode(self._memory[register.address : register.end])

    def put(self, register: Register, value: int) -> None:
        """Set a register, without the checks of a write from the bus."""
        self._memory[register.address : register.end] = register.encode(value)

    @property
    def return_delay_s(self) -> float:
        """How long it waits before it answers [s]."""
        return self.get(self.table.return_delay) * RETURN_DELAY_UNIT_S

    @property
    def answers_reads(self) -> bool:
        """Whether it answers when it is read."""
        return True

    @property
    @abstractmethod
    def confirms(self) -> bool:
        """Whether it answers when it is written."""

    @property
    @abstractmethod
    def alert(self) -> int:
        """Bits that are set in the error byte of every answer: those of an error that is present."""

    @property
    def identity(self) -> bytes:
        """The data of its answer to a ping."""
        return b""

    @abstractmethod
    def read(self, address: int, length: int) -> tuple[int, bytes]:
        """Return the error and the bytes that a READ is answered with."""

    @abstractmethod
    def write(self, address: int, data: bytes) -> tuple[int, bool]:
        """Write registers; return the error, and whether `command` may have changed."""

    def register_write(self, address: int, data: bytes) -> None:
        """Store a REG_WRITE until the next ACTION."""
        self._registered = (address, data)

    def action(self) -> tuple[int, bool]:
        """Carry out the stored write, if there is one; return what `write` does."""
        if self._registered is None:
            return 0, False
        stored, self._registered = self._registered, None
        return self.write(*stored)

    def reboot(self) -> None:
        """Begin again as after a loss of power: torque off, and whatever is not in the EEPROM at its default."""
        self._registered = None
        for register in self.table.registers.values():
            if not register.eeprom:
                self.put(register, register.default)

    def watchdog_deadline_ns(self) -> int | None:
        """Return when its watchdog trips if no instruction comes before; None if it has none, or it is not armed."""
        return None

    def trip_watchdog(self) -> None:
        """Trip the watchdog."""
