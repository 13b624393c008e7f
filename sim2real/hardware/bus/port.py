"""The serial port of a bus of servos, and the time limits that hold on it."""

import math
from dataclasses import dataclass
from typing import ClassVar

import serial
from serial.tools import list_ports

from sim2real.errors import HardwareLost, UsageError


@dataclass(frozen=True)
class LinkConfig:
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

    family: ClassVar[str]
    """Name of the servos in messages."""
    baud_rates: ClassVar[tuple[int, ...]]
    """Bits per second that the servos support."""
    longest_silence_s: ClassVar[float] = math.inf
    """The longest time that the servos' own watchdogs can be set to [s]."""

    def __post_init__(self) -> None:
        if self.baud_rate not in self.baud_rates:
            raise UsageError(
                f"baud rate {self.baud_rate} is none of a {self.family} servo's. Available: {list(self.baud_rates)}"
            )
        for name in ("reply_timeout_s", "max_silence_s", "late_after_s", "silence_s"):
            if not getattr(self, name) >= 0.0:
                raise UsageError(f"{name} = {getattr(self, name)} is no time")
        if self.silence_s > self.longest_silence_s:
            raise UsageError(f"silence_s = {self.silence_s} is outside [0, {self.longest_silence_s}]")


def open_port(config: LinkConfig) -> serial.Serial:
    """Return the open port, exclusively; raise HardwareLost if it cannot be opened, or another process uses it."""
    try:
        return serial.Serial(config.port, config.baud_rate, timeout=0, exclusive=True)
    except (OSError, ValueError) as error:  # serial.SerialException is an OSError
        ports = ", ".join(f"{p.device} ({p.description})" for p in list_ports.comports()) or "none"
        raise HardwareLost(
            f"serial port {config.port} cannot be opened: {error}",
            hint=f"serial ports here: {ports}; a port that is there but refused needs group 'dialout'",
        ) from error
