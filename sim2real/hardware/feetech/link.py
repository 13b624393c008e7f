"""Transactions on the bus, one at a time: port, lock, retries, and the alarms that servos report.

Written by hand, as PyPI's feetech-servo-sdk 1.0.0 cannot time its reads: it polls for an answer, 0.61 ms of processor
time a read where this module takes 0.03; it notices a missing one after 34 ms, fixed, by the wall clock; it keeps
neither when an instruction was sent nor the error bytes of a synchronised read; and as it does not drop late answers,
the one to an earlier instruction passes for that to the next.
"""

from __future__ import annotations

import os
import select
import termios
import threading
import time
from array import array
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Final, cast

import serial
from serial.tools import list_ports

from sim2real.errors import HardwareLost, SafetyStop, UsageError
from sim2real.hardware.device import Transaction
from sim2real.hardware.feetech import registers as reg
from sim2real.hardware.feetech.protocol import (
    BROADCAST_ID,
    FRAME_BYTES,
    StsInstruction,
    StsPacket,
    StsParser,
    build,
    describe_alarms,
    sync_write,
)
from sim2real.hardware.feetech.registers import StsRegister
from sim2real.hardware.guardian import Guardian

_LOCK_TIMEOUT_S: Final = 0.5
_FORCED_ATTEMPTS: Final = 5
_LEAST_LOSSES: Final = 3  # fewer missing answers in a long time mean that this process was not scheduled
_PADS: Final = 4
_CONFIRMING_BYTES: Final = 14  # no other read is as long: what confirms cannot be a late answer to something else


@dataclass(frozen=True)
class StsConfig:
    """Port and time limits of the bus.

    Args:
        port: Device file, e.g. /dev/ttyACM0.
        baud_rate: Bits per second.
        reply_timeout_s: How long to wait for an answer, beyond the time that its bytes need on the wire [s].
        max_silence_s: Time without any answer after which the bus counts as lost [s].
        late_after_s: An answer that takes this much longer than its bytes need is late: the time at which its sample
            was taken is then uncertain [s].
        silence_s: Longest time without an instruction while torque is on, after which the guardian takes it off [s];
            0: unlimited, only the death of this process counts.
        guardian: Whether to start a guardian; False only to test what the servos do without one.
    """

    port: str
    baud_rate: int = 1_000_000
    reply_timeout_s: float = 0.008
    max_silence_s: float = 0.1
    late_after_s: float = 0.004
    silence_s: float = 0.1
    guardian: bool = True

    def __post_init__(self) -> None:
        """Check that servos support the baud rate, and that times are none before their beginning."""
        if self.baud_rate not in reg.BAUD_RATES:
            raise UsageError(
                f"baud rate {self.baud_rate} is none of a Feetech servo's. Available: {list(reg.BAUD_RATES)}"
            )
        for name in ("reply_timeout_s", "max_silence_s", "late_after_s", "silence_s"):
            if not getattr(self, name) >= 0.0:
                raise UsageError(f"{name} = {getattr(self, name)} is no time")


class StsLink:
    """Owner of port and lock. Every method may be called from any thread.

    Once `torque_withheld` is set, nothing that could move a motor leaves through here: neither "torque on" nor a goal.

    Args:
        config: Port and limits.

    Raises:
        HardwareLost: The port cannot be opened, or another process uses it.
    """

    def __init__(self, config: StsConfig) -> None:
        self.config = config
        self.transactions = 0
        self.retries = 0
        self.lost_replies = 0
        self.late_replies = 0
        self.late_us = array("i")
        self.guardian: Guardian | None = None
        self.closed = False
        self.torque_withheld = False
        self.withheld = 0
        self._withheld_goals: dict[tuple[int, StsRegister], int] = {}
        self._lock = threading.Lock()
        self._parser = StsParser()
        self._waiting: list[StsPacket] = []
        self._pad = 0
        self._sent_ns = 0
        try:
            self._serial = serial.Serial(config.port, config.baud_rate, timeout=0, exclusive=True)
        except (OSError, ValueError) as error:  # serial.SerialException is an OSError
            ports = ", ".join(f"{p.device} ({p.description})" for p in list_ports.comports()) or "none"
            raise HardwareLost(
                f"serial port {config.port} cannot be opened: {error}",
                hint=f"serial ports here: {ports}; a port that is there but refused needs group 'dialout'",
            ) from error
        self.fd = cast(int, self._serial.fileno())

    def read(self, servo_id: int, register: StsRegister, despite_alarm: bool = False) -> int:
        """Return a register's value in counts; of a goal that was withheld, that goal.

        Args:
            servo_id: The servo.
            register: The register.
            despite_alarm: Whether to return it although the servo reports an alarm.
        """
        what = f"read of {register.name}"
        found = self.read_each((servo_id,), register.address, register.size, what, despite_alarm)[0][0]
        return self._withheld_goals.get((servo_id, register), register.decode(found))

    def read_each(
        self, servo_ids: Sequence[int], address: int, length: int, what: str, despite_alarm: bool = False
    ) -> tuple[list[bytes], Transaction]:
        """Read the same bytes of several servos' memory tables with one instruction.

        Args:
            servo_ids: The servos.
            address: Address of the first byte.
            length: Number of bytes of each servo.
            what: Description of the instruction, for errors.
            despite_alarm: Whether to return them although a servo reports an alarm.

        Returns:
            The bytes of each servo; and the transaction.
        """
        # After a missing answer, more bytes are requested: if it still comes, it is recognised by its length. Taken for
        # the answer to the repeated instruction, its sample would get a time stamp that is 8 ms too late.
        spare = min(_PADS - 1, reg.TABLE_BYTES - address - length)

        def instruction() -> tuple[bytes, int]:
            asked = length + self._pad % (spare + 1)
            head = bytes((address, asked))
            if len(servo_ids) == 1:
                return build(servo_ids[0], StsInstruction.READ, head), asked
            return build(BROADCAST_ID, StsInstruction.SYNC_READ, head + bytes(servo_ids)), asked

        who = f"servo {servo_ids[0]}" if len(servo_ids) == 1 else f"servos {tuple(servo_ids)}"
        packets, transaction = self._exchange(instruction, servo_ids, f"{what} of {who}", despite_alarm)
        return [packet.parameters[:length] for packet in packets], transaction

    def write(self, servo_id: int, register: StsRegister, value: int, despite_alarm: bool = False) -> Transaction:
        """Write a value in counts to a register, and wait for the servo to confirm that the instruction came.

        A servo does not say whether it took the value: `set` reads it back.

        Args:
            servo_id: The servo.
            register: The register.
            value: In counts.
            despite_alarm: Whether it does not matter that the servo reports an alarm.
        """
        if self._withholds(register, (value,)):
            return self._withhold(register, {servo_id: value})
        packet = build(servo_id, StsInstruction.WRITE, bytes((register.address,)) + register.encode(value))
        what = f"write of {value} to {register.name} of servo {servo_id}"
        return self._exchange(lambda: (packet, 0), (servo_id,), what, despite_alarm)[1]

    def set(self, servo_id: int, register: StsRegister, value: int) -> None:
        """Write a register if it holds another value; raise HardwareLost if the servo does not keep it.

        Args:
            servo_id: The servo.
            register: The register.
            value: In counts.
        """
        if self.read(servo_id, register) == value:
            return
        self.write(servo_id, register, value)
        found = self.read(servo_id, register)
        if found != value:
            raise HardwareLost(
                f"servo {servo_id} does not keep its settings: {register.name} is {found} after {value} was written",
                hint="is its supply stable, its firmware another one?",
            )

    def write_each(self, register: StsRegister, values: Mapping[int, int]) -> Transaction:
        """Write a register of several servos, each a value in counts by id, in one instruction that none confirms."""
        if self._withholds(register, values.values()):
            return self._withhold(register, values)
        packet = sync_write(register.address, {i: register.encode(value) for i, value in values.items()})
        return self._exchange(lambda: (packet, 0), (), f"write of {register.name}")[1]

    def ping(self, servo_id: int) -> None:
        """Raise HardwareLost if a servo does not answer."""
        packet = build(servo_id, StsInstruction.PING)
        self._exchange(lambda: (packet, 0), (servo_id,), f"ping of servo {servo_id}", despite_alarm=True)

    def answers(self, servo_id: int) -> bool:
        """Return whether a servo answers a single ping."""
        with self.hold():
            return self._attempt(build(servo_id, StsInstruction.PING), (servo_id,), 0) is not None

    def force(self, servo_id: int, register: StsRegister, value: int) -> bool:
        """Write a register despite a held lock, missing answers or alarms, until it reads back. Never raises.

        Args:
            servo_id: The servo.
            register: The register.
            value: In counts.

        Returns:
            Whether the servo holds the value.
        """
        write = build(servo_id, StsInstruction.WRITE, bytes((register.address,)) + register.encode(value))
        query = build(servo_id, StsInstruction.READ, bytes((register.address, _CONFIRMING_BYTES)))
        held = self._lock.acquire(timeout=_LOCK_TIMEOUT_S)
        try:
            for _ in range(_FORCED_ATTEMPTS):
                with suppress(Exception):
                    self._attempt(write, (servo_id,), 0)
                    answers = self._attempt(query, (servo_id,), _CONFIRMING_BYTES)
                    if answers and register.decode(answers[0].parameters[: register.size]) == value:
                        return True
        finally:
            if held:
                self._lock.release()
        return False

    def close(self) -> None:
        """Close the port; later instructions raise HardwareLost. Never raises itself."""
        self.closed = True
        with suppress(OSError):
            self._serial.close()

    @contextmanager
    def hold(self) -> Iterator[None]:
        """Have exclusive use of the bus in the block; raise HardwareLost if it is closed."""
        with self._lock:
            if self.closed:
                raise HardwareLost(f"the bus on {self.config.port} is closed")
            yield

    def _exchange(
        self,
        instruction: Callable[[], tuple[bytes, int]],
        servo_ids: Sequence[int],
        what: str,
        despite_alarm: bool = False,
    ) -> tuple[list[StsPacket], Transaction]:
        """Repeat an instruction until it is answered, or the bus counts as lost.

        Args:
            instruction: Returns its bytes, and how many bytes of data each answer must have.
            servo_ids: Who answers it, in this order.
            what: Description of the instruction, for errors.
            despite_alarm: Whether alarms in the answers do not matter.

        Returns:
            The answers, and the transaction.

        Raises:
            HardwareLost: There was no answer within the configured limits.
            SafetyStop: A servo reports an alarm; the guardian has taken over, or has died.
        """
        asked_ns = time.monotonic_ns()
        losses = 0
        with self.hold():
            began_ns = time.monotonic_ns()
            while True:
                if self.guardian is not None:
                    self.guardian.beat()
                packet, length = instruction()
                wire_bytes = len(packet) + len(servo_ids) * (FRAME_BYTES + length)
                try:
                    answers = self._attempt(packet, servo_ids, length)
                except OSError as failure:
                    raise HardwareLost(f"{self.config.port} failed during {what}: {failure}") from failure
                now_ns = time.monotonic_ns()
                if answers is not None:
                    late_ns = self._count_answer(now_ns, wire_bytes)
                    break
                losses += 1
                self.lost_replies += 1
                self._pad = (self._pad + 1) % _PADS
                self._judge(losses, (now_ns - began_ns) * 1e-9, what)
                self.retries += 1
        if not despite_alarm:
            _require_no_alarm(answers)
        return answers, Transaction(self._sent_ns, began_ns - asked_ns, now_ns - began_ns, losses, late_ns)

    def _attempt(self, packet: bytes, servo_ids: Sequence[int], length: int) -> list[StsPacket] | None:
        """Send an instruction once; return the answers of the servos, or None if one is missing."""
        self._drop_input()
        self._sent_ns = time.monotonic_ns()
        os.write(self.fd, packet)
        wire_bytes = len(packet) + len(servo_ids) * (FRAME_BYTES + length)
        end_ns = self._sent_ns + round(1e9 * self.config.reply_timeout_s + 1e10 * wire_bytes / self.config.baud_rate)
        answers = []
        for servo_id in servo_ids:
            answer = self._receive(servo_id, length, end_ns)
            if answer is None:
                return None
            answers.append(answer)
        return answers

    def _drop_input(self) -> None:
        """Forget what has come and was not asked for: late answers, and the beginning of one that was cut."""
        self._parser.clear()
        self._waiting.clear()
        try:
            self._serial.reset_input_buffer()
        except termios.error as error:  # raised by pyserial when the adapter is unplugged
            raise OSError(str(error)) from error

    def _receive(self, servo_id: int, length: int, end_ns: int) -> StsPacket | None:
        """Wait for a servo's status packet with `length` bytes of data; drop others, which answer what was earlier."""
        while True:
            while self._waiting:
                packet = self._waiting.pop(0)
                if packet.servo_id == servo_id and len(packet.parameters) == length and packet.checksum_ok:
                    return packet
                self.late_replies += packet.checksum_ok
            left_s = (end_ns - time.monotonic_ns()) * 1e-9
            if left_s <= 0.0 or not select.select([self.fd], [], [], left_s)[0]:
                return None
            data = os.read(self.fd, 4096)
            if not data:
                raise OSError("the port is ready to be read, but has no data: was it unplugged?")
            self._waiting += [found for found, _ in self._parser.feed(data)]

    def _count_answer(self, now_ns: int, wire_bytes: int) -> int:
        """Count an answer that has arrived; return how much longer it took than its bytes need on the wire [ns]."""
        self.transactions += 1
        late_ns = max(0, now_ns - self._sent_ns - round(1e10 * wire_bytes / self.config.baud_rate))
        self.late_us.append(min(late_ns // 1000, 1 << 30))
        self.late_replies += late_ns > 1e9 * self.config.late_after_s
        return late_ns

    def _judge(self, losses: int, silent_s: float, what: str) -> None:
        if losses >= _LEAST_LOSSES and silent_s > self.config.max_silence_s:
            raise HardwareLost(
                f"no answer to {what} on {self.config.port}: {losses} missed in a row, {1e3 * silent_s:.0f} ms",
                hint="check power, cable, ids and baud rate",
            )

    def _withholds(self, register: StsRegister, values: Iterable[int]) -> bool:
        """Whether a write could move a motor, and nothing may."""
        moves = register in reg.GOALS or (register == reg.TORQUE_ENABLE and any(values))
        return self.torque_withheld and moves

    def _withhold(self, register: StsRegister, values: Mapping[int, int]) -> Transaction:
        """Keep a write to oneself, and read the register in its place: the bus is as busy, and its loss is noticed."""
        self.withheld += 1
        if register in reg.GOALS:
            self._withheld_goals |= {(servo_id, register): value for servo_id, value in values.items()}
        what = f"read of {register.name}"
        return self.read_each((next(iter(values)),), register.address, register.size, what)[1]


def _require_no_alarm(answers: Sequence[StsPacket]) -> None:
    for answer in answers:
        if answer.code:
            raise SafetyStop(
                f"servo {answer.servo_id} reports an alarm: {describe_alarms(answer.code)}",
                hint="remove the cause, then switch its power off and on; does the supply's voltage fit the servo?",
            )
