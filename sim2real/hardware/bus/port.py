"""The port of a bus of servos, and its time limits."""

import os
import select
import termios
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, Protocol, Self, TypeAlias, cast

from sim2real.errors import HardwareLost, UsageError
from sim2real.hardware.clock import SYSTEM_CLOCK, Clock
from sim2real.hardware.safety import guardian
from sim2real.hardware.safety.guardian import Guardian, Motors, Process


@dataclass(frozen=True)
class BusConfig:
    """Port and time limits of a bus.

    Args:
        port: Device file, e.g. /dev/ttyUSB0.
        reply_timeout_s: Longest wait for an answer, beyond the time of its bytes on the wire [s]. It must exceed the
            latency timer of the USB adapter, which is 16 ms by default; set that timer to 1 ms.
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
        """Return limits with one time for both sides: a silent bus is lost, and a silent host dead, after it."""
        return cls(port, baud_rate, max_silence_s=max(cls.max_silence_s, silence_s), silence_s=silence_s)

    def __post_init__(self) -> None:
        for name in ("reply_timeout_s", "max_silence_s", "late_after_s", "silence_s"):
            if not getattr(self, name) >= 0.0:
                raise UsageError(f"{name} = {getattr(self, name)} is not a time")


Queries: TypeAlias = Sequence[tuple[bytes, Sequence[bytes]]]
"""For each servo, the packet that reads its torque register, and the answers that mean "torque is off"."""
CUT: Final = "cut the servos' power"
_QUIET_NS, _LONGEST_ANSWER_NS = 2_000_000, 20_000_000


class Line(Protocol):
    """Bytes from and to a device, on the device's clock. Every method may be called from any thread.

    `write` sends bytes without waiting. `read` returns the bytes that have arrived, and waits for the first one until a
    time [ns]. Both raise OSError if the port is gone.
    """

    @property
    def clock(self) -> Clock: ...
    def write(self, data: bytes) -> None: ...
    def read(self, until_ns: int) -> bytes: ...


class Port(Line, Protocol):
    """A line with exclusive access; `flush` drops the bytes that have arrived.

    Attributes:
        advice: End of a hint: what to look at if answers are missing or late.
    """

    advice: str

    def flush(self) -> None: ...
    def close(self) -> None: ...

    def guardian(self, off: bytes, servos: Queries, silence_s: float, answer_s: float) -> Guardian:
        """Return a guardian of the servos on this port, which has started.

        Args:
            off: The packet that takes the torque of all servos off.
            silence_s: As in `Guardian` [s].
            answer_s: Longest wait for a servo's answer [s].
        """
        ...


class FdPort:
    """An open serial port, by its file descriptor, which the guardian's process shares."""

    def __init__(self, fd: int) -> None:
        self.clock: Clock = SYSTEM_CLOCK
        self._fd = fd

    def write(self, data: bytes) -> None:
        os.write(self._fd, data)

    def read(self, until_ns: int) -> bytes:
        # Bytes that have arrived count, even if this thread did not run until after the time.
        left_s = max(0.0, (until_ns - self.clock.now_ns()) * 1e-9)
        if not select.select([self._fd], [], [], left_s)[0]:
            return b""
        try:
            data = os.read(self._fd, 4096)
        except BlockingIOError:  # the other process has read the bytes
            return b""
        if not data:
            raise OSError("the port is ready to be read, but has no data: was it unplugged?")
        return data


class SerialPort(FdPort):
    """A serial port of this computer, which no other process can open meanwhile; a `Port`.

    Raises:
        HardwareLost: It cannot be opened, or another process uses it.
    """

    advice = "; set a USB adapter's latency timer to 1 ms"

    def __init__(self, address: str, baud_rate: int) -> None:
        # Imported late: neither training nor an emulated robot needs pyserial.
        import serial
        from serial.tools import list_ports

        try:
            self._serial = serial.Serial(address, baud_rate, timeout=0, exclusive=True)
        except (OSError, ValueError) as error:  # serial.SerialException is an OSError
            ports = ", ".join(f"{p.device} ({p.description})" for p in list_ports.comports()) or "none"
            raise HardwareLost(
                f"serial port {address} cannot be opened: {error}",
                hint=f"serial ports here: {ports}; if the port is listed, add your user to the group 'dialout'",
            ) from error
        super().__init__(cast(int, self._serial.fileno()))

    def flush(self) -> None:
        try:
            self._serial.reset_input_buffer()
        except termios.error as error:  # raised by pyserial when the adapter is unplugged
            raise OSError(str(error)) from error

    def close(self) -> None:
        self._fd = -1  # the operating system reuses the number for the next opened file
        self._serial.close()

    def guardian(self, off: bytes, servos: Queries, silence_s: float, answer_s: float) -> Guardian:
        """Start a guardian in a separate process that shares the open port, so that no other process gets the port."""
        packets = [f"{query.hex()}:{','.join(answer.hex() for answer in answers)}" for query, answers in servos]
        arguments = [str(self._fd), repr(answer_s), off.hex(), *packets]
        place = f"{__name__}:guarded"
        return Guardian(lambda longest_s: Process(place, arguments, longest_s, (self._fd,)), silence_s)


def guarded(fd: str, answer_s: str, off: str, *servos: str) -> Motors:
    """Return the servos for a guardian's process; packets are hexadecimal, see `SerialPort.guardian`."""
    packets = [text.partition(":") for text in servos]
    queries = [(bytes.fromhex(q), [bytes.fromhex(a) for a in answers.split(",")]) for q, _, answers in packets]
    port = FdPort(int(fd))
    return Motors(lambda: take_torque_off(port, bytes.fromhex(off), queries, float(answer_s)), cut=CUT)


def take_torque_off(port: Line, off: bytes, servos: Queries, answer_s: float) -> str:
    """Switch all servos off, repeatedly until each has confirmed it; return why one did not, else "".

    Once is not enough: the first packet is lost if the control process died while it was writing, and a control process
    that resumes may read an answer before this process does. Arguments as in `Port.guardian`.
    """
    clock, unconfirmed = port.clock, list(servos)
    begin_ns = clock.now_ns()
    try:
        # Wait until no more bytes arrive: on a half-duplex line, sending now would collide with an answer.
        while clock.now_ns() - begin_ns < _LONGEST_ANSWER_NS and port.read(clock.now_ns() + _QUIET_NS):
            pass
        while unconfirmed and clock.now_ns() - begin_ns < 1e9 * guardian.GIVE_UP_S:
            _write(port, off)
            unconfirmed = [servo for servo in unconfirmed if not _confirms(port, *servo, answer_s)]
    except OSError as error:
        return f"the port failed: {error}"
    if not unconfirmed:
        return ""
    return f"{len(unconfirmed)} of {len(servos)} servos did not answer for {guardian.GIVE_UP_S:g} s"


def _write(port: Line, packet: bytes) -> None:
    try:
        port.write(packet)
    except BlockingIOError:  # the buffer is full, and the packet lost
        port.clock.sleep(1e-9 * _QUIET_NS)


def _confirms(port: Line, query: bytes, answers: Sequence[bytes], answer_s: float) -> bool:
    _write(port, query)
    end_ns, heard = port.clock.now_ns() + round(1e9 * answer_s), b""
    while port.clock.now_ns() < end_ns:
        heard += port.read(end_ns)
        if any(answer in heard for answer in answers):
            return True
    return False


EMULATED: Final[dict[str, Callable[[int], Port]]] = {}
"""Address -> function that opens the port of an emulated robot in this process at a baud rate."""


def open_port(address: str, baud_rate: int) -> Port:
    """Return the open port of an address; raise HardwareLost if it cannot be opened, or another process uses it."""
    emulated = EMULATED.get(address)
    return SerialPort(address, baud_rate) if emulated is None else emulated(baud_rate)
