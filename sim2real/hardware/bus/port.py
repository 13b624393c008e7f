"""The port of a bus of servos, and the time limits that hold on it."""

import os
import select
import termios
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, Protocol, Self, cast

from sim2real.errors import HardwareLost, UsageError
from sim2real.hardware.clock import SYSTEM_CLOCK, Clock
from sim2real.hardware.safety.guardian import BusGuardian, Guardian


@dataclass(frozen=True)
class BusConfig:
    """Port and time limits of a bus.

    Args:
        port: Device file, e.g. /dev/ttyUSB0.
        reply_timeout_s: Longest wait for an answer, beyond the time of its bytes on the wire [s]. It must exceed the
            latency timer of a USB adapter: 16 ms by default, better set it to 1 ms.
        max_silence_s: Time without any answer after which the bus counts as lost [s].
        late_after_s: Delay of an answer, beyond the time of its bytes on the wire, from which it counts as late: the
            time of its sample is then uncertain [s].
        silence_s: Longest time without an instruction while torque is on, after which the guardian takes it off, and
            the servos' own watchdogs trip if they have any [s]; 0: unlimited, only the death of this process counts.
        guardian: Whether to start a guardian; False only to test what the servos do without one.
    """

    port: str
    baud_rate: int = 1_000_000
    reply_timeout_s: float = 0.008
    max_silence_s: float = 0.1
    late_after_s: float = 0.004
    silence_s: float = 0.1
    guardian: bool = True

    @classmethod
    def patient(cls, port: str, baud_rate: int, silence_s: float) -> Self:
        """Return limits with one time for both directions: a bus counts as lost when its host would count as dead."""
        return cls(port, baud_rate, max_silence_s=max(cls.max_silence_s, silence_s), silence_s=silence_s)

    def __post_init__(self) -> None:
        for name in ("reply_timeout_s", "max_silence_s", "late_after_s", "silence_s"):
            if not getattr(self, name) >= 0.0:
                raise UsageError(f"{name} = {getattr(self, name)} is not a time")


class Port(Protocol):
    """Bytes from and to a device, on the device's clock. Every method may be called from any thread.

    Attributes:
        clock: The time of the device.
    """

    clock: Clock

    def write(self, data: bytes) -> None:
        """Send bytes without waiting; OSError if that cannot be done."""
        ...

    def read(self, until_ns: int) -> bytes:
        """Return the bytes that have arrived; none if there are none until a time [ns]; OSError if the port is gone."""
        ...

    def flush(self) -> None:
        """Drop the bytes that have arrived; OSError if the port is gone."""
        ...

    def close(self) -> None:
        """Close the port; OSError if that cannot be done."""
        ...

    def guardian(
        self, off: bytes, servos: Sequence[tuple[bytes, Sequence[bytes]]], silence_s: float, answer_s: float
    ) -> Guardian:
        """Return a guardian of the servos on this port, which has started; see `BusGuardian`."""
        ...


class SerialPort:
    """A serial port of this computer, which no other process can open meanwhile.

    Raises:
        HardwareLost: It cannot be opened, or another process uses it.
    """

    def __init__(self, address: str, baud_rate: int) -> None:
        # Imported here: neither training nor an emulated robot in this process needs it.
        import serial
        from serial.tools import list_ports

        self.clock: Clock = SYSTEM_CLOCK
        try:
            self._serial = serial.Serial(address, baud_rate, timeout=0, exclusive=True)
        except (OSError, ValueError) as error:  # serial.SerialException is an OSError
            ports = ", ".join(f"{p.device} ({p.description})" for p in list_ports.comports()) or "none"
            raise HardwareLost(
                f"serial port {address} cannot be opened: {error}",
                hint=f"serial ports here: {ports}; a port that is there but refused needs group 'dialout'",
            ) from error
        self._fd = cast(int, self._serial.fileno())

    def write(self, data: bytes) -> None:
        """Send bytes without waiting; OSError if that cannot be done."""
        os.write(self._fd, data)

    def read(self, until_ns: int) -> bytes:
        """Return the bytes that have arrived; none if there are none until a time [ns]; OSError if the port is gone."""
        # What has arrived counts, also if this thread did not run until after that time.
        left_s = max(0.0, (until_ns - self.clock.now_ns()) * 1e-9)
        if not select.select([self._fd], [], [], left_s)[0]:
            return b""
        data = os.read(self._fd, 4096)
        if not data:
            raise OSError("the port is ready to be read, but has no data: was it unplugged?")
        return data

    def flush(self) -> None:
        """Drop the bytes that have arrived; OSError if the port is gone."""
        try:
            self._serial.reset_input_buffer()
        except termios.error as error:  # raised by pyserial when the adapter is unplugged
            raise OSError(str(error)) from error

    def close(self) -> None:
        """Close the port; OSError if that cannot be done."""
        self._fd = -1  # the operating system gives the number to the next file that is opened
        self._serial.close()

    def guardian(
        self, off: bytes, servos: Sequence[tuple[bytes, Sequence[bytes]]], silence_s: float, answer_s: float
    ) -> Guardian:
        """Return a guardian in a process of its own, which shares the open port and its lock."""
        return BusGuardian(self._fd, off, servos, silence_s, answer_s)


EMULATED: Final[dict[str, Callable[[int], Port]]] = {}
"""Address -> opens, at a baud rate, the port of an emulated robot in this process: `emulation.virtual`."""


def open_port(address: str, baud_rate: int) -> Port:
    """Return the open port of an address; raise HardwareLost if it cannot be opened, or another process uses it."""
    emulated = EMULATED.get(address)
    return SerialPort(address, baud_rate) if emulated is None else emulated(baud_rate)
