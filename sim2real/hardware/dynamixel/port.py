"""The serial port of ROBOTIS' SDK, with waiting that uses no CPU and a configurable timeout."""

from __future__ import annotations

import os
import select
import termios
import time
from typing import Any, Final

import serial
from dynamixel_sdk.port_handler import PortHandler
from serial.tools import list_ports

from sim2real.errors import HardwareLost, UsageError

BAUD_RATES: Final = (9600, 57600, 115200, 1_000_000, 2_000_000, 3_000_000, 4_000_000)


class WaitingPort(PortHandler):
    """The SDK's port with three changes.

    - A read sleeps in `select`, which releases the GIL; the SDK polls in a busy loop.
    - A reply may take `reply_timeout_s` longer than its bytes need on the wire; with the SDK it is 34 ms.
    - Timeouts use the monotonic clock; the SDK uses the wall clock, which may jump.

    Args:
        path: Device file of the port.
        baud_rate: One of `BAUD_RATES`.
        reply_timeout_s: How long to wait for a status packet, beyond the time that its bytes need [s].

    Attributes:
        t_sent_ns: When the last packet was sent, CLOCK_MONOTONIC [ns].
        wire_ns: Time that this packet and its answer need on the wire [ns].
        fd: The port's file descriptor.

    Raises:
        UsageError: Servos do not support the baud rate.
        HardwareLost: The port cannot be opened, or another process uses it.
    """

    def __init__(self, path: str, baud_rate: int, reply_timeout_s: float) -> None:
        super().__init__(path)
        if baud_rate not in BAUD_RATES:
            raise UsageError(f"baud rate {baud_rate} is none of a DYNAMIXEL servo's. Available: {list(BAUD_RATES)}")
        self._reply_timeout_ms = 1e3 * reply_timeout_s
        self.t_sent_ns = self.wire_ns = 0
        self.baudrate = baud_rate
        try:
            self.openPort()
            self._serial.exclusive = True
        except (OSError, ValueError) as error:  # serial.SerialException is an OSError
            raise HardwareLost(f"serial port {path} cannot be opened: {error}", hint=_ports_hint()) from error
        self.fd: int = self._serial.fileno()

    @property
    def _serial(self) -> Any:
        """The pyserial object that the SDK made."""
        return self.ser

    def setPacketTimeout(self, packet_length: int) -> None:
        """Start the timeout for status packets of `packet_length` bytes in total."""
        wire_ms = self.tx_time_per_byte * packet_length
        self.wire_ns += round(1e6 * wire_ms)
        self.setPacketTimeoutMillis(wire_ms + self._reply_timeout_ms)

    def getCurrentTime(self) -> float:
        """Return the time of the monotonic clock [ms]."""
        return time.monotonic_ns() * 1e-6

    def clearPort(self) -> None:
        """Drop bytes that have arrived and were not read: late answers to earlier instructions."""
        try:
            super().clearPort()
        except termios.error as error:  # raised by pyserial when the adapter is unplugged
            raise OSError(str(error)) from error

    def writePort(self, packet: list[int]) -> int:
        """Send an instruction and note the time; return the number of bytes sent."""
        self.t_sent_ns = time.monotonic_ns()
        self.wire_ns = round(1e6 * self.tx_time_per_byte * len(packet))
        return os.write(self.fd, bytes(packet))

    def readPort(self, length: int) -> bytes:
        """Return up to `length` bytes; waits for the first one until the timeout."""
        remaining_s = 1e-3 * max(0.0, self.packet_timeout - self.getTimeSinceStart())
        if length <= 0 or not select.select([self.fd], [], [], remaining_s)[0]:
            return b""
        data = os.read(self.fd, length)
        if not data:
            raise serial.SerialException("the port is ready to be read, but has no data: was it unplugged?")
        return data


def _ports_hint() -> str:
    ports = [f"{port.device} ({port.description})" for port in list_ports.comports()]
    return f"serial ports here: {', '.join(ports) or 'none'}; a port that is there but refused needs group 'dialout'"
