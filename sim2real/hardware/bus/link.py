"""Transactions on a half-duplex bus of servos, one at a time: port, lock, retries, late answers.

The makers' packages are not used because they do not time their reads. They poll for an answer, report a missing one
after a fixed 34 ms, drop the error bytes of a synchronised read, and confuse a late answer with the next one.
"""

import threading
from array import array
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from typing import Final

import numpy as np

from sim2real.errors import HardwareLost, SafetyStop
from sim2real.hardware.bus.packets import Answer, Instruction, Packet, Parser, of_servos
from sim2real.hardware.bus.port import BusConfig, open_port
from sim2real.hardware.bus.registers import Family, Register
from sim2real.hardware.device import Counters, Transaction
from sim2real.hardware.safety.guardian import Guardian

_LOCK_TIMEOUT_S: Final = 0.5
_SAFE_REPEATS: Final = 5
_SAFE_PAUSE_S: Final = 0.002
_FORCED_ATTEMPTS: Final = 5
_MIN_LOSSES: Final = 3  # fewer missing answers in a long time mean that this process was not scheduled
_BUSY_SHARE: Final = 0.3  # of a silence: if this thread was held up for longer, the computer is to blame
_SCANNED: Final = 20
_CONFIRMING_BYTES: Final = 17  # no other read is as long, so a late answer to another read cannot confirm
_BARRIER_BYTES: Final = 18  # and more: the shortest read that only `_drain` makes


class ServoLink:
    """Owner of port and lock. Every method may be called from any thread.

    While `at_rest` is set, nothing that could move a motor leaves through here, neither "torque on" nor a goal: such an
    instruction raises SafetyStop, also if it waits for the lock, or for the answer to its first attempt, when `at_rest`
    is set.

    Args:
        failure: Returns the error that an answer to an instruction reports: SafetyStop if the servo has stopped itself.

    Attributes:
        at_rest: Whether the torque was taken off and not switched on again.
        off_packet: The instruction that takes the torque of all servos off; no servo answers it.

    Raises:
        HardwareLost: The port cannot be opened, or another process uses it.
    """

    def __init__(self, config: BusConfig, family: Family, failure: Callable[[Answer, str], Exception]) -> None:
        self.config, self.family, self.form = config, family, family.form
        self.guardian: Guardian | None = None
        self.closed = False
        self.at_rest = False
        self.off_packet = b""
        self._failure = failure
        # Counts of this session; the lock serialises transactions.
        self._transactions = self._retries = self._lost = self._late = 0
        self._late_us = array("i")
        self._lock = threading.Lock()
        self._parser = Parser(self.form)
        self._waiting: list[Packet] = []
        self._unsettled = False  # whether an answer to a read is missing and may still come
        self._drains = 0
        # Begin and end of the present silence, None after an answer; and its missing answers.
        self._silent_ns: tuple[int, int] | None = None
        self._missed = self._held_up_ns = 0
        self._sent_ns = 0
        self.port = open_port(config.port, config.baud_rate)
        self.clock = self.port.clock

    @property
    def counters(self) -> Counters:
        """Counts of the transactions since the port was opened."""
        late_s = np.array(self._late_us, np.float64) * 1e-6
        return Counters(self._transactions, self._lost, self._retries, self._late, late_s)

    def read(self, servo_id: int, register: Register, despite_error: bool = False) -> int:
        """Return a register's value in counts.

        Args:
            despite_error: Whether an error in the answer is ignored.
        """
        what = f"read of {register.name}"
        data = self.read_each((servo_id,), register.address, register.size, what, despite_error)[0][0]
        return register.decode(data)

    def read_each(
        self, servo_ids: Sequence[int], address: int, length: int, what: str, despite_error: bool = False
    ) -> tuple[list[bytes], Transaction]:
        """Read the same bytes of several servos' memory with one instruction; return those of each servo.

        Args:
            despite_error: Whether errors in the answers are ignored.
        """
        packet = self.form.read(servo_ids, address, length)
        answers, transaction = self._exchange(packet, length, servo_ids, what, despite_error)
        return [answer.data for answer in answers], transaction

    def read_counts(
        self, servo_ids: Sequence[int], registers: Sequence[Register], what: str
    ) -> tuple[np.ndarray, Transaction]:
        """Read neighbouring registers, sorted by address, of several servos: ``(servos, registers)`` [counts]."""
        begin = registers[0].address
        blocks, transaction = self.read_each(servo_ids, begin, registers[-1].end - begin, what)
        counts = [[r.decode(block[r.address - begin : r.end - begin]) for r in registers] for block in blocks]
        return np.array(counts), transaction

    def write(self, servo_id: int, register: Register, value: int) -> Transaction:
        """Write a register, and wait for the answer; some servos confirm a value that they refuse, see `set`."""
        moves = self.family.moves(register, (value,))
        packet, what = self.form.write(servo_id, register, value), f"write of {value} to {register.name}"
        return self._exchange(packet, 0, (servo_id,), what, moves=moves)[1]

    def set(self, servo_id: int, register: Register, value: int) -> None:
        """Write a register if it holds another value; raise HardwareLost if the servo does not keep it."""
        if self.read(servo_id, register) == value:
            return
        self.write(servo_id, register, value)
        self.require(servo_id, register, value)

    def require(self, servo_id: int, register: Register, value: int) -> None:
        """Raise HardwareLost if a register does not hold the value that was written."""
        current = self.read(servo_id, register)
        if current != value:
            raise HardwareLost(
                f"servo {servo_id} does not keep its settings: {register.name} is {current} after {value} was written",
                hint="is its supply stable, its firmware another one?",
            )

    def write_each(self, register: Register, values: Mapping[int, int]) -> Transaction:
        """Write a register of several servos, id -> value in counts, with one instruction that no servo answers."""
        moves = self.family.moves(register, values.values())
        packet = self.form.write_each(register, values)
        return self._exchange(packet, 0, (), f"write of {register.name}", moves=moves)[1]

    def ping(self, servo_id: int) -> None:
        """Raise HardwareLost if a servo does not answer a ping; an error in its answer is ignored."""
        self._exchange(self._ping(servo_id), self.form.ping_bytes, (servo_id,), "ping", despite_error=True)

    def scan(self) -> list[int]:
        """Return the ids below 20 that answer a ping of their own; a scan of all ids would take 2 s."""
        with self.hold():
            length = self.form.ping_bytes
            return [i for i in range(_SCANNED) if self._attempt(self._ping(i), (i,), length) is not None]

    def force(self, servo_id: int, register: Register, value: int) -> bool:
        """Write a register despite lock, missing answers and errors; return whether it reads back. Never raises."""
        write = self.form.write(servo_id, register, value)
        query = self.form.read((servo_id,), register.address, _CONFIRMING_BYTES)
        # Go on without the lock after the timeout: taking the torque off matters more than an intact packet.
        held = self._lock.acquire(timeout=_LOCK_TIMEOUT_S)
        try:
            for _ in range(_FORCED_ATTEMPTS):
                with suppress(Exception):
                    self._attempt(write, (servo_id,), 0)
                    answers = self._attempt(query, (servo_id,), _CONFIRMING_BYTES)
                    if answers and answers[0].data and register.decode(answers[0].data[: register.size]) == value:
                        return True
        finally:
            if held:
                self._lock.release()
        return False

    def answering(self, packet: bytes, wait_s: float) -> list[int]:
        """Send an instruction once; return the ids of the answers that come within ``wait_s``, in their order."""
        ids = []
        with self.hold():
            self._send(packet)
            while (answer := self._next_answer(self._sent_ns + round(1e9 * wait_s))) is not None:
                ids.append(answer.servo_id)
        return ids

    def send_off(self) -> None:
        """Take the torque of all servos off with one instruction, after the one that is on the wire. Never raises."""
        held = self._lock.acquire(timeout=_LOCK_TIMEOUT_S)
        try:
            with suppress(Exception):
                self._send(self.off_packet)
        finally:
            if held:
                self._lock.release()

    def make_safe(self) -> None:
        """Take the torque of all servos off, without the lock and without waiting for answers. Never raises.

        The instruction may collide with an answer on the wire and be lost, so it is sent five times within 8 ms.
        """
        self.at_rest = True
        self._repeat_off(_SAFE_PAUSE_S)

    def close(self) -> None:
        """Close the port; later instructions raise HardwareLost. Never raises itself."""
        self.closed = True
        with suppress(Exception):
            self.port.close()

    @contextmanager
    def hold(self) -> Iterator[None]:
        """Have exclusive use of the bus in the block; raise HardwareLost if it is closed."""
        with self._lock:
            if self.closed:
                raise HardwareLost(f"the bus on {self.config.port} is closed")
            yield

    def _exchange(
        self,
        packet: bytes,
        length: int,
        servo_ids: Sequence[int],
        what: str,
        despite_error: bool = False,
        moves: bool = False,
    ) -> tuple[list[Answer], Transaction]:
        """Repeat an instruction until all servos have answered, or the bus counts as lost.

        Args:
            length: Number of data bytes of each answer.
            servo_ids: The servos that answer, in this order.
            despite_error: Whether errors in the answers are ignored.
            moves: Whether it could move a motor, or switch a torque on.

        Raises:
            HardwareLost: There was no answer within the configured limits.
            SafetyStop: A servo has stopped itself; the guardian has taken over, or has died; or the instruction moves,
                and the torque was taken off.
        """
        requested_ns = self.clock.now_ns()
        losses = 0
        request = f"{what}{of_servos(servo_ids)}"
        with self.hold():
            began_ns = self.clock.now_ns()
            # A bus that was lost just now is lost for the next instruction, too, after a single missing answer.
            silent_ns = self._silent_ns
            if silent_ns is None or began_ns - silent_ns[1] > 1e9 * self.config.max_silence_s:
                silent_ns, self._missed, self._held_up_ns = (began_ns, began_ns), 0, 0
            while True:
                # Show the guardian that this process lives, as often as the bus is used.
                if self.guardian is not None:
                    self.guardian.beat()
                # Checked with the lock: whoever takes the torque off gets it afterwards.
                if moves and self.at_rest:
                    raise SafetyStop(f"no {what} is sent: the torque was taken off", hint="enable the device again")
                try:
                    answers = None
                    # A write never waits for an empty line: it may take the torque off.
                    if not length or not self._unsettled or self._drain(servo_ids[-1]):
                        answers = self._attempt(packet, servo_ids, length)
                        self._unsettled |= length > 0 and answers is None
                except OSError as failure:
                    self._require_watching()
                    raise HardwareLost(f"{self.config.port} failed during {request}: {failure}") from failure
                finally:
                    # `make_safe` takes no lock: this instruction may have followed it, and some servos wake up at it.
                    if moves and self.at_rest:
                        self._repeat_off(0.0)  # the line is quiet, and others wait for it
                now_ns = self.clock.now_ns()
                if answers is not None:
                    if servo_ids:
                        self._silent_ns = None
                    late_ns = self._count_answer(now_ns, self._wire_ns(packet, servo_ids, length))
                    break
                # An answer is missing: ask again, and give up after the longest silence.
                losses += 1
                self._lost += 1
                self._missed += 1
                self._silent_ns = silent_ns = (silent_ns[0], now_ns)
                self._require_heard(request, 1e-9 * (silent_ns[1] - silent_ns[0]))
                self._retries += 1
            transaction = Transaction(self._sent_ns, began_ns - requested_ns, now_ns - began_ns, losses, late_ns)
        # Outside of the lock, as the error's cause is read from the servo.
        for answer in answers:
            if answer.error and not despite_error:
                raise self._failure(answer, what)
        return answers, transaction

    def _repeat_off(self, pause_s: float) -> None:
        if not self.off_packet or self.closed:
            return
        with suppress(Exception):
            for repeat in range(_SAFE_REPEATS):
                if repeat and pause_s:
                    self.clock.sleep(pause_s)
                self.port.write(self.off_packet)

    def _drain(self, servo_id: int) -> bool:
        """Let answers that are late pass: read as many bytes as no other read; the line keeps the order.

        Taken for the answer to a repeated read, a late one would give its sample a time stamp that is 8 ms too late.
        """
        # Ask the last servo that is read: those before it have answered by then. Each of these reads has another
        # length: with two lengths in turn, answers that were 50 ms late ended later ones.
        self._drains += 1
        begin = self.family.torque.address
        length = _BARRIER_BYTES + self._drains % (self.family.size - begin - _BARRIER_BYTES + 1)
        self._unsettled = self._attempt(self.form.read((servo_id,), begin, length), (servo_id,), length) is None
        return not self._unsettled

    def _ping(self, servo_id: int) -> bytes:
        return self.form.build(servo_id, Instruction.PING)

    def _wire_ns(self, packet: bytes, servo_ids: Sequence[int], length: int) -> int:
        """Return the time of an instruction and its answers on the wire [ns]."""
        count = len(packet) + len(servo_ids) * (self.form.answer_bytes + length)
        return round(1e10 * count / self.config.baud_rate)

    def _attempt(self, packet: bytes, servo_ids: Sequence[int], length: int) -> list[Answer] | None:
        """Send an instruction; return the answers of the servos, or None if one is missing."""
        self._send(packet)
        end_ns = self._sent_ns + round(1e9 * self.config.reply_timeout_s) + self._wire_ns(packet, servo_ids, length)
        answers = []
        for servo_id in servo_ids:
            answer = self._receive(servo_id, length, end_ns)
            if answer is None:
                return None
            answers.append(answer)
        return answers

    def _send(self, packet: bytes) -> None:
        """Drop late answers to earlier instructions, also incomplete ones, and send an instruction."""
        self._parser.clear()
        self._waiting.clear()
        self.port.flush()
        self._sent_ns = self.clock.now_ns()
        self.port.write(packet)

    def _receive(self, servo_id: int, length: int, end_ns: int) -> Answer | None:
        """Return a servo's answer with `length` bytes of data, or its refusal without data.

        All other answers are late ones to earlier instructions, and are dropped.
        """
        while (answer := self._next_answer(end_ns)) is not None:
            refused = not answer.data and answer.error & self.form.refusals
            if answer.servo_id == servo_id and (len(answer.data) == length or refused):
                return answer
            self._late += 1
        return None

    def _next_answer(self, end_ns: int) -> Answer | None:
        """Return the next status packet with a correct checksum; None if there is none until `end_ns`."""
        while True:
            while self._waiting:
                packet = self._waiting.pop(0)
                if packet.intact and (answer := self.form.answer(packet)) is not None:
                    return answer
            if not (data := self.port.read(end_ns)):
                # A thread that wakes up late did not get the processor.
                self._held_up_ns += max(0, self.clock.now_ns() - end_ns)
                return None
            self._waiting += [packet for packet, _ in self._parser.feed(data)]

    def _count_answer(self, now_ns: int, wire_ns: int) -> int:
        """Count an answer; return its delay beyond the time of its bytes on the wire [ns]."""
        self._transactions += 1
        late_ns = max(0, now_ns - self._sent_ns - wire_ns)
        self._late_us.append(min(late_ns // 1000, 1 << 30))
        self._late += late_ns > 1e9 * self.config.late_after_s
        return late_ns

    def _require_heard(self, what: str, silent_s: float) -> None:
        if self._missed >= _MIN_LOSSES and silent_s > self.config.max_silence_s:
            self._require_watching()
            port, silent_ms = self.config.port, 1e3 * silent_s
            missed = f"no answer to {what} on {port}: {self._missed} missed in a row, {silent_ms:.0f} ms"
            if 1e-9 * self._held_up_ns > _BUSY_SHARE * silent_s:
                raise HardwareLost(
                    f"this computer is too busy: its control thread did not run for {1e-6 * self._held_up_ns:.0f} ms; "
                    f"{missed}",
                    hint="close what else runs on it, or raise servo_watchdog_s, which is also the longest silence",
                )
            raise HardwareLost(
                missed,
                hint="check power, cable, ids and baud rate; is a USB adapter's latency timer longer than "
                "reply_timeout_s?",
            )

    def _require_watching(self) -> None:
        """Raise SafetyStop if the guardian has taken over: it reads answers that are then missing here."""
        if self.guardian is not None:
            self.guardian.require_watching()
