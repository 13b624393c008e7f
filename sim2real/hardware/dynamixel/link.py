"""Transactions on the bus, one at a time: a lock around ROBOTIS' SDK, retries, and errors that servos report."""

from __future__ import annotations

import threading
import time
from array import array
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Final, NoReturn, TypeVar

from dynamixel_sdk.group_sync_write import GroupSyncWrite
from dynamixel_sdk.protocol2_packet_handler import Protocol2PacketHandler
from dynamixel_sdk.robotis_def import COMM_SUCCESS

from sim2real.errors import HardwareLost, SafetyStop, Sim2RealError, UsageError
from sim2real.hardware.device import Transaction
from sim2real.hardware.dynamixel import registers as reg
from sim2real.hardware.dynamixel.port import WaitingPort
from sim2real.hardware.dynamixel.protocol import ALERT_BIT, StatusError
from sim2real.hardware.dynamixel.registers import Register
from sim2real.hardware.guardian import Guardian

_REASONS: Final[dict[int, str]] = {
    StatusError.RESULT_FAIL: "it failed to carry it out",
    StatusError.INSTRUCTION: "it does not know the instruction",
    StatusError.CRC: "the instruction arrived with a wrong checksum",
    StatusError.DATA_RANGE: "the value is out of the register's range",
    StatusError.DATA_LENGTH: "the data are shorter than the register",
    StatusError.DATA_LIMIT: "the value is beyond a limit set in the servo",
    StatusError.ACCESS: "the register cannot be written or read now (EEPROM registers: not while torque is on)",
}
_LOCK_TIMEOUT_S: Final = 0.5
_FORCED_ATTEMPTS: Final = 5
_LEAST_LOSSES: Final = 3  # fewer missing answers in a long time mean that this process was not scheduled
_PADS: Final = 4
# Positions of id and error byte in a status packet, and sizes of what comes before and after its parameters.
_ID_AT, _ERROR_AT, _HEAD_BYTES, _CRC_BYTES = 4, 8, 9, 2

_T = TypeVar("_T")


@dataclass(frozen=True)
class BusConfig:
    """Port and time limits of the bus.

    Args:
        port: Device file, e.g. /dev/ttyUSB0.
        baud_rate: Bits per second.
        reply_timeout_s: How long to wait for an answer, beyond the time that its bytes need on the wire [s]. With a USB
            adapter whose latency timer is 16 ms this must be longer than 16 ms; better set the timer to 1 ms.
        max_silence_s: Time without any answer after which the bus counts as lost [s].
        late_after_s: An answer that takes this much longer than its bytes need is late: the time at which its sample
            was taken is then uncertain [s].
        watchdog_s: Longest time without an instruction while torque is on [s]; after it the guardian takes the torque
            off and the servos' bus watchdogs, set to a multiple of 20 ms and at most 2.54 s, trip. 0: neither. What a
            servo does then depends on its model: `sim2real.hardware.dynamixel.models`.
        guardian: Whether to start a guardian; False only to test the servos' own watchdogs.
    """

    port: str
    baud_rate: int = 1_000_000
    reply_timeout_s: float = 0.008
    max_silence_s: float = 0.1
    late_after_s: float = 0.004
    watchdog_s: float = 0.1
    guardian: bool = True

    def __post_init__(self) -> None:
        """Check that the watchdog's time fits the register."""
        longest_s = reg.WATCHDOG_MAX_COUNT * reg.WATCHDOG_UNIT_S
        if not 0.0 <= self.watchdog_s <= longest_s:
            raise UsageError(f"watchdog_s = {self.watchdog_s} is outside [0, {longest_s}]")

    @property
    def watchdog_count(self) -> int:
        """Value of the register Bus Watchdog: `watchdog_s` in units of 20 ms, at least 1 unless it is 0 (off)."""
        return max(1, round(self.watchdog_s / reg.WATCHDOG_UNIT_S)) if self.watchdog_s > 0.0 else 0


class BusLink:
    """Owner of port and lock. Every method may be called from any thread.

    Once `torque_withheld` is set, nothing that could move a motor leaves through here: neither "torque on" nor a goal.

    Args:
        config: Port and limits.

    Raises:
        HardwareLost: The port cannot be opened.
    """

    def __init__(self, config: BusConfig) -> None:
        self.config = config
        self.port = WaitingPort(config.port, config.baud_rate, config.reply_timeout_s)
        self.packets = Protocol2PacketHandler()
        self.transactions = 0
        self.retries = 0
        self.lost_replies = 0
        self.late_replies = 0
        self.late_us = array("i")
        self.guardian: Guardian | None = None
        self.closed = False
        self.torque_withheld = False
        self.withheld = 0
        self._withheld_goals: dict[tuple[int, Register], int] = {}
        self._lock = threading.Lock()
        self._pad = 0

    def read(self, servo_id: int, register: Register) -> int:
        """Return a register's value in counts; of a goal that was withheld, that goal."""
        what = f"read of {register.name}"
        found = register.decode(self.read_bytes(servo_id, register.address, register.size, what)[0])
        return self._withheld_goals.get((servo_id, register), found)

    def read_bytes(self, servo_id: int, address: int, length: int, what: str) -> tuple[bytes, Transaction]:
        """Read bytes of a servo's control table.

        Args:
            servo_id: The servo.
            address: Address of the first byte.
            length: Number of bytes.
            what: Description of the instruction, for errors.
        """
        return self.read_bytes_of((servo_id,), address, length, what)

    def read_bytes_of(
        self, servo_ids: Sequence[int], address: int, length: int, what: str
    ) -> tuple[bytes, Transaction]:
        """Read the same bytes of several servos' control tables with one instruction.

        Args:
            servo_ids: The servos.
            address: Address of the first byte.
            length: Number of bytes of each servo.
            what: Description of the instruction, for errors.

        Returns:
            The bytes of all servos, concatenated; and the transaction.
        """

        def attempt() -> tuple[tuple[bytes, int], int, int]:
            # After a missing answer, more bytes are requested: if it still comes, it is recognised by its length. Taken
            # for the answer to the repeated instruction, its sample would get a time stamp that is 8 ms too late.
            asked = length + (self._pad if address + length + _PADS <= reg.TABLE_BYTES else 0)
            # Not the SDK's GroupSyncRead: it drops the error byte, by which a servo reports that it has stopped itself.
            if len(servo_ids) == 1:
                result = self.packets.readTx(self.port, servo_ids[0], address, asked)
            else:
                result = self.packets.syncReadTx(self.port, address, asked, list(servo_ids), len(servo_ids), False)
            blocks, failed_id, failure = b"", 0, 0
            for servo_id in servo_ids:
                if result != COMM_SUCCESS:
                    break
                block, result, error = self._receive(servo_id, asked)
                blocks += block[:length]
                failed_id, failure = (servo_id, error) if error and not failure else (failed_id, failure)
            return (blocks, failed_id), result, failure

        who = f"servo {servo_ids[0]}" if len(servo_ids) == 1 else f"servos {tuple(servo_ids)}"
        (blocks, failed_id), error, transaction = self.exchange(attempt, f"{what} of {who}")
        if error:
            self._refused(error, failed_id, what)
        return blocks, transaction

    def write(self, servo_id: int, register: Register, value: int) -> Transaction:
        """Write a register, and wait for the servo to confirm it.

        Args:
            servo_id: The servo.
            register: The register.
            value: In counts.
        """
        if self._withholds(register, (value,)):
            return self._withhold(register, {servo_id: value})
        data = list(register.encode(value))
        what = f"write of {value} to {register.name}"

        def attempt() -> tuple[bytes, int, int]:
            result = self.packets.writeTxOnly(self.port, servo_id, register.address, register.size, data)
            if result != COMM_SUCCESS:
                return b"", result, 0
            self.port.setPacketTimeout(_HEAD_BYTES + _CRC_BYTES)
            return self._receive(servo_id, 0)

        _, error, transaction = self.exchange(attempt, f"{what} of servo {servo_id}")
        if error:
            self._refused(error, servo_id, what)
        return transaction

    def write_each(self, register: Register, values: Mapping[int, int]) -> Transaction:
        """Write a register of several servos, each a value in counts by id, in one instruction that none confirms."""
        if self._withholds(register, values.values()):
            return self._withhold(register, values)
        group = GroupSyncWrite(self.port, self.packets, register.address, register.size)
        for servo_id, value in values.items():
            group.addParam(servo_id, list(register.encode(value)))
        return self.exchange(lambda: ((), group.txPacket(), 0), f"write of {register.name}")[2]

    def force(self, servo_id: int, register: Register, value: int) -> bool:
        """Write a register despite a held lock, missing answers or errors. Never raises.

        Args:
            servo_id: The servo.
            register: The register.
            value: In counts.

        Returns:
            Whether the servo confirmed.
        """
        data = list(register.encode(value))
        held = self._lock.acquire(timeout=_LOCK_TIMEOUT_S)
        try:
            for _ in range(_FORCED_ATTEMPTS):
                self.port.is_using = False
                with suppress(Exception):
                    result, error = self.packets.writeTxRx(self.port, servo_id, register.address, register.size, data)
                    if result == COMM_SUCCESS and not error & ~ALERT_BIT:
                        return True
        finally:
            if held:
                self._lock.release()
        return False

    def close(self) -> None:
        """Close the port; later instructions raise HardwareLost. Never raises itself."""
        self.closed = True
        with suppress(OSError):
            self.port.closePort()

    @contextmanager
    def hold(self) -> Iterator[None]:
        """Have exclusive use of the bus in the block; raise HardwareLost if it is closed."""
        with self._lock:
            if self.closed:
                raise HardwareLost(f"the bus on {self.config.port} is closed")
            # The SDK's own flag may still be set if an exception such as Ctrl-C interrupted a transaction.
            self.port.is_using = False
            yield

    def exchange(self, attempt: Callable[[], tuple[_T, int, int]], what: str) -> tuple[_T, int, Transaction]:
        """Repeat an instruction until it is answered, or the bus counts as lost.

        Args:
            attempt: Sends and receives once; returns the data, the SDK's result, and the status packet's error byte.
            what: Description of the instruction, for errors.

        Returns:
            The data, the error byte, and the transaction.

        Raises:
            HardwareLost: There was no answer within the configured limits.
            SafetyStop: The guardian has taken over, or has died.
        """
        asked_ns = time.monotonic_ns()
        losses = 0
        with self.hold():
            began_ns = time.monotonic_ns()
            while True:
                if self.guardian is not None:
                    self.guardian.beat()
                try:
                    data, result, error = attempt()
                except OSError as failure:
                    raise HardwareLost(f"{self.config.port} failed during {what}: {failure}") from failure
                now_ns = time.monotonic_ns()
                if result == COMM_SUCCESS:
                    late_ns = self._count_answer(now_ns)
                    waited_ns, transfer_ns = began_ns - asked_ns, now_ns - began_ns
                    return data, error, Transaction(self.port.t_sent_ns, waited_ns, transfer_ns, losses, late_ns)
                losses += 1
                self.lost_replies += 1
                self._pad = (self._pad + 1) % _PADS
                self._judge(losses, (now_ns - began_ns) * 1e-9, what)
                self.retries += 1

    def _withholds(self, register: Register, values: Iterable[int]) -> bool:
        """Whether a write could move a motor, and nothing may."""
        moves = register in reg.GOALS or (register == reg.TORQUE_ENABLE and any(values))
        return self.torque_withheld and moves

    def _withhold(self, register: Register, values: Mapping[int, int]) -> Transaction:
        """Keep a write to oneself, and read the register in its place: the bus is as busy, and its loss is noticed."""
        self.withheld += 1
        if register in reg.GOALS:
            self._withheld_goals |= {(servo_id, register): value for servo_id, value in values.items()}
        first = next(iter(values))
        return self.read_bytes(first, register.address, register.size, f"read of {register.name}")[1]

    def _receive(self, servo_id: int, length: int) -> tuple[bytes, int, int]:
        """Wait for a servo's status packet with `length` bytes of data, or with an error and no data.

        Other packets are late answers to earlier instructions, and are dropped.

        Returns:
            The data, the SDK's result, and the error byte.
        """
        while True:
            packet, result = self.packets.rxPacket(self.port, False)
            if result != COMM_SUCCESS:
                return b"", result, 0
            data, error = bytes(packet[_HEAD_BYTES:-_CRC_BYTES]), packet[_ERROR_AT]
            if packet[_ID_AT] == servo_id and (len(data) == length or (not data and error & ~ALERT_BIT)):
                return data, result, error
            self.late_replies += 1

    def _count_answer(self, now_ns: int) -> int:
        """Count an answer that has arrived; return how much longer it took than its bytes need on the wire [ns]."""
        self.transactions += 1
        late_ns = max(0, now_ns - self.port.t_sent_ns - self.port.wire_ns)
        self.late_us.append(min(late_ns // 1000, 1 << 30))
        self.late_replies += late_ns > 1e9 * self.config.late_after_s
        return late_ns

    def _judge(self, losses: int, silent_s: float, what: str) -> None:
        if losses >= _LEAST_LOSSES and silent_s > self.config.max_silence_s:
            raise HardwareLost(
                f"no answer to {what} on {self.config.port}: {losses} missed in a row, {1e3 * silent_s:.0f} ms",
                hint="check power and cable; is the adapter's latency timer longer than reply_timeout_s?",
            )

    def _refused(self, error: int, servo_id: int, what: str) -> NoReturn:
        """Raise the error that a status packet reports: SafetyStop if the servo has stopped itself."""
        address = reg.HARDWARE_ERROR_STATUS.address
        if error & ALERT_BIT:
            bits, _, _ = self.exchange(
                lambda: self.packets.readTxRx(self.port, servo_id, address, 1), f"hardware error of {servo_id}"
            )
            raise SafetyStop(
                f"servo {servo_id} has stopped itself: {reg.describe_hardware_errors(bits[0] if bits else 0)}",
                hint="remove the cause, then reboot the servo",
            )
        watchdog, _, _ = self.exchange(
            lambda: self.packets.readTxRx(self.port, servo_id, reg.BUS_WATCHDOG.address, 1), "bus watchdog"
        )
        if watchdog and reg.BUS_WATCHDOG.decode(bytes(watchdog)) == reg.WATCHDOG_TRIPPED:
            raise SafetyStop(*watchdog_message(servo_id))
        raise Sim2RealError(f"servo {servo_id} refused {what}: {_REASONS.get(error, f'error {error}')}")


def watchdog_message(servo_id: int) -> tuple[str, str]:
    """Return the message and the hint for a servo whose bus watchdog has tripped."""
    return (
        f"the bus watchdog of servo {servo_id} has tripped: it heard nothing for longer than watchdog_s",
        "look for a loop that stalls; switching torque on again clears it",
    )
