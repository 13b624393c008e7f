"""The firmware of one emulated servo, as far as all families share it."""

from abc import ABC, abstractmethod
from typing import ClassVar, Protocol

from sim2real.hardware.bus.registers import RETURN_DELAY_UNIT_S, MemoryTable, Register


class Firmware(Protocol):
    """Registers and firmware of one servo, without time, bus and physics.

    Attributes:
        heard_ns: Time of the last instruction that it received.
        watchdog_stops: Whether a tripped watchdog stops the motor.
    """

    servo_id: int
    heard_ns: int
    watchdog_stops: bool

    def command(self) -> tuple[int, float]:
        """Return mode and goal of the motor, as ``Plant.command`` takes them, according to the registers."""
        ...

    def controller(self) -> tuple[int, int, float]:
        """Return the position controller's settings, as ``ConfigurablePlant.configure`` takes them."""
        ...

    def refresh(self, position_rad: float, velocity_rad_s: float, load: float, tick_ms: int) -> None:
        """Set the registers of present values.

        Args:
            position_rad: Angle from the encoder's zero [rad].
            velocity_rad_s: Speed [rad/s].
            load: Fraction of the largest load, in [-1, 1].
            tick_ms: Time since power-up [ms].
        """
        ...

    def watchdog_deadline_ns(self) -> int | None:
        """Return the time at which its watchdog trips without an instruction; None if it has none, or it is off."""
        ...

    def trip_watchdog(self) -> None:
        """Trip the watchdog."""
        ...

    def overload(self) -> None:
        """Shut down as after an overload: torque off, and an error reported from now on."""
        ...


class ServoFirmware(Firmware, ABC):
    """Registers of one servo, and the rules of its firmware, without time, bus and physics.

    Args:
        return_delay_us: Return Delay Time at power-up, rounded to the register's unit of 2 us [us].
        encoder_counts: Resolution of the encoder [counts per revolution].
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
        """Time between an instruction and its answer [s]."""
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
        """Bits of the present error, which are set in the error byte of every answer."""

    @property
    def identity(self) -> bytes:
        """The data of its answer to a ping."""
        return b""

    @abstractmethod
    def read(self, address: int, length: int) -> tuple[int, bytes]:
        """Return the error and the bytes of the answer to a READ."""

    @abstractmethod
    def write(self, address: int, data: bytes) -> tuple[int, bool]:
        """Write registers; return the error, and whether `command` may have changed."""

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
        for register in self.table.registers.values():
            if not register.eeprom:
                self.put(register, register.default)

    def watchdog_deadline_ns(self) -> int | None:
        """Return the time at which its watchdog trips without an instruction; None if it has none, or it is off."""
        return None

    def trip_watchdog(self) -> None:
        """Trip the watchdog."""
