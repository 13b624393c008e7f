"""Transactions on a half-duplex bus of servos, one at a time: port, lock, retries, late answers.

The makers' packages are not used because they do not time their reads. They poll for an answer, report a missing one
after a fixed 34 ms, drop the error bytes of a synchronised read, and confuse a late answer with the next one.
"""

import threading
from array import array
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Final

import numpy as np

from sim2real.errors import HardwareLost, SafetyStop
from sim2real.hardware.bus.packets import Answer, Instruction, Packet, Parser
from sim2real.hardware.bus.port import BusConfig, open_port
from sim2real.hardware.bus.registers import Family, Register
from sim2real.hardware.device import Counters, Transaction
from sim2real.hardware.safety.guardian import Guardian

_LOCK_TIMEOUT_S: Final = 0.5
_SAFE_REPEATS: Final = 5
_SAFE_PAUSE_S: Final = 0.002
_FORCED_ATTEMPTS: Final = 5
_MIN_LOSSES: Final = 3  # fewer missing answers in a long silence mean that this process did not run
_BUSY_SHARE: Final = 0.3  # share of a silence: if this thread did not run for longer, the computer is to blame
_SCANNED: Final = 20
_CONFIRMING_BYTES: Final = 17  # no other read is as long, so no late answer to another read counts as this one
_BARRIER_BYTES: Final = 18  # the shortest read that only `_drain` makes; it makes longer ones, too


@dataclass
class _Silence:
    """A time without answers: begin, end, number of missing answers, and for how long this thread did not run."""

    begin_ns: int
    end_ns: int
    missed: int = 0
    held_up_ns: int = 0


class ServoLink:
    """A port with its lock. Every method may be called from any thread.

    While `at_rest` is set, no instruction that could move a motor is sent, neither "torque on" nor a goal: it raises
    SafetyStop, even if `at_rest` is set while it waits for the lock or for the answer to its first attempt.

    Args:
        failure: Returns the error to raise for an answer with an error byte: SafetyStop if the servo has stopped
            itself.

    Attributes:
        at_rest: Whether the torque was taken off, and not switched on since.
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
        # Counts since the port was opened; the lock serialises transactions.
        self._transactions = self._retries = self._lost = self._late = 0
        self._late_us = array("i")
        self._lock = threading.Lock()
        self._parser = Parser(self.form)
        self._waiting: list[Packet] = []
        self._unsettled = False  # whether the answer to a read is missing, and may still come
        self._drains = 0
        self._silence = _Silence(0, 0)
        self._is_silent = False
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
        counts, _ = self.read_counts((servo_id,), (register,), f"read of {register.name}", despite_error)
        return int(counts[0, 0])

    def read_counts(
        self, servo_ids: Sequence[int], registers: Sequence[Register], what: str, despite_error: bool = False
    ) -> tuple[np.ndarray, Transaction]:
        """Read neighbouring registers, sorted by address, of several servos with one instruction.

        Returns:
            Their values ``(servos, registers)`` [counts].
        """
        begin = registers[0].address
        length = registers[-1].end - begin
        packet = self.form.read(servo_ids, begin, length)
        answers, transaction = self._exchange(packet, length, servo_ids, what, despite_error)
        counts = [[r.decode(a.data[r.address - begin : r.end - begin]) for r in registers] for a in answers]
        return np.array(counts), transaction

    def write(self, servo_id: int, register: Register, value: int) -> Transaction:
        """Write a register, and wait for the answer. Some servos confirm values that they refuse: `set` reads back."""
        moves = self.family.moves(register, (value,))
        packet, what = self.form.write(servo_id, register, value), f"write of {value} to {register.name}"
        return self._exchange(packet, 0, (servo_id,), what, moves=moves)[1]

    def set(self, servo_id: int, register: Register, value: int) -> None:
        """Write a register if it holds another value; raise HardwareLost if the servo does not keep it."""
        if self.read(servo_id, register) == value:
            return
        self.write(servo_id, register, value)
        if (current := self.read(servo_id, register)) != value:
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
        packet = self.form.build(servo_id, Instruction.PING)
        self._exchange(packet, self.form.ping_bytes, (servo_id,), "ping", despite_error=True)

    def scan(self) -> list[int]:
        """Ping each id below 20, and return those that answer; a scan of all ids would take 2 s."""
        ping, length = Instruction.PING, self.form.ping_bytes
        with self.hold():
            return [i for i in range(_SCANNED) if self._attempt(self.form.build(i, ping), (i,), length) is not None]

    def answering(self, packet: bytes, wait_s: float) -> list[int]:
        """Send an instruction once; return the ids of all answers within ``wait_s``, in the order of arrival."""
        ids = []
        with self.hold():
            self._send(packet)
            while (answer := self._next_answer(self._sent_ns + round(1e9 * wait_s))) is not None:
                ids.append(answer.servo_id)
        return ids

    def force(self, servo_id: int, register: Register, value: int) -> bool:
        """Write a register despite lock, missing answers and errors; return whether it reads back. Never raises."""
        write = self.form.write(servo_id, register, value)
        query = self.form.read((servo_id,), register.address, _CONFIRMING_BYTES)
        with self._grabbed():
            for _ in range(_FORCED_ATTEMPTS):
                with suppress(Exception):
                    self._attempt(write, (servo_id,), 0)
                    answers = self._attempt(query, (servo_id,), _CONFIRMING_BYTES)
                    if answers and answers[0].data and register.decode(answers[0].data[: register.size]) == value:
                        return True
        return False

    def send_off(self) -> None:
        """Take the torque of all servos off with one instruction, after a running transaction. Never raises."""
        with self._grabbed(), suppress(Exception):
            self._send(self.off_packet)

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
        """Give the block exclusive use of the bus; raise HardwareLost if the bus is closed."""
        with self._lock:
            if self.closed:
                raise HardwareLost(f"the bus on {self.config.port} is closed")
            yield

    @contextmanager
    def _grabbed(self) -> Iterator[None]:
        """Give the block the bus, after a while even without the lock: "off" matters more than a whole packet."""
        held = self._lock.acquire(timeout=_LOCK_TIMEOUT_S)
        try:
            yield
        finally:
            if held:
                self._lock.release()

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
            moves: Whether the instruction could move a motor, or switch torque on.

        Raises:
            HardwareLost: There was no answer within the configured limits.
            SafetyStop: A servo has stopped itself; the guardian has taken over, or has died; or the instruction moves,
                and the torque was taken off.
        """
        requested_ns, losses = self.clock.now_ns(), 0
        request = what
        if servo_ids:
            request += f" of servo {servo_ids[0]}" if len(servo_ids) == 1 else f" of servos {tuple(servo_ids)}"
        with self.hold():
            began_ns = self.clock.now_ns()
            # If the bus was just lost, a single missing answer to the next instruction suffices.
            if not self._is_silent or began_ns - self._silence.end_ns > 1e9 * self.config.max_silence_s:
                self._silence = _Silence(began_ns, began_ns)
            while (answers := self._try(packet, length, servo_ids, request, moves)) is None:
                losses += 1
                self._lost += 1
                self._is_silent = True
                self._silence.missed += 1
                self._silence.end_ns = self.clock.now_ns()
                self._require_heard(request)
                self._retries += 1
            now_ns = self.clock.now_ns()
            self._is_silent &= not servo_ids
            # Count the transaction, and how much later its answer was than its bytes on the wire.
            self._transactions += 1
            late_ns = max(0, now_ns - self._sent_ns - self._wire_ns(packet, servo_ids, length))
            self._late_us.append(min(late_ns // 1000, 1 << 30))
            self._late += late_ns > 1e9 * self.config.late_after_s
            transaction = Transaction(self._sent_ns, began_ns - requested_ns, now_ns - began_ns, losses, late_ns)
        # Outside of the lock, because the cause of the error is read from the servo.
        for answer in answers:
            if answer.error and not despite_error:
                raise self._failure(answer, what)
        return answers, transaction

    def _try(
        self, packet: bytes, length: int, servo_ids: Sequence[int], request: str, moves: bool
    ) -> list[Answer] | None:
        """Send an instruction once; return its answers, or None if one is missing."""
        # Each use of the bus shows the guardian that this process lives.
        if self.guardian is not None:
            self.guardian.beat()
        # Check while holding the lock: a thread that takes the torque off gets the lock only afterwards.
        if moves and self.at_rest:
            raise SafetyStop(f"no {request} is sent: the torque was taken off", hint="enable the device again")
        try:
            # A write does not wait until the line is quiet, because it may take the torque off.
            if length and self._unsettled and not self._drain(servo_ids[-1]):
                return None
            answers = self._attempt(packet, servo_ids, length)
            self._unsettled |= length > 0 and answers is None
            return answers
        except OSError as failure:
            self._require_watching()
            raise HardwareLost(f"{self.config.port} failed during {request}: {failure}") from failure
        finally:
            # `make_safe` takes no lock: if this instruction came after it, it may have switched a servo on again.
            if moves and self.at_rest:
                self._repeat_off(0.0)  # the line is quiet, and other threads wait for it

    def _repeat_off(self, pause_s: float) -> None:
        if not self.off_packet or self.closed:
            return
        with suppress(Exception):
            for repeat in range(_SAFE_REPEATS):
                if repeat and pause_s:
                    self.clock.sleep(pause_s)
                self.port.write(self.off_packet)

    def _drain(self, servo_id: int) -> bool:
        """Discard late answers: send a read whose length no other read has; late answers arrive before its answer.

        A late answer that counts as the answer to a repeated read would make the sample's time stamp 8 ms too late. To
        wait until the line is quiet is not enough: an answer may be later than any such wait.
        """
        # Ask the last servo of a synchronised read: the others have answered by then. Each of these reads has another
        # # length: with two alternating lengths, answers that were 50 ms late counted as later ones.
        self._drains += 1
        begin = self.family.torque.address
        length = _BARRIER_BYTES + self._drains % (self.family.size - begin - _BARRIER_BYTES + 1)
        self._unsettled = self._attempt(self.form.read((servo_id,), begin, length), (servo_id,), length) is None
        return not self._unsettled

    def _wire_ns(self, packet: bytes, servo_ids: Sequence[int], length: int) -> int:
        """Return the time of an instruction and its answers on the wire [ns]."""
        count = len(packet) + len(servo_ids) * (self.form.answer_bytes + length)
        return round(1e10 * count / self.config.baud_rate)

    def _attempt(self, packet: bytes, servo_ids: Sequence[int], length: int) -> list[Answer] | None:
        """Send an instruction; return the answers of the servos, or None if one is missing."""
        self._send(packet)
        end_ns = self._sent_ns + round(1e9 * self.config.reply_timeout_s) + self._wire_ns(packet, servo_ids, length)
        answers = []
        for i, servo_id in enumerate(servo_ids):
            # An answer that refuses the instruction has no data.
            while (answer := self._next_answer(end_ns)) is not None:
                fits = len(answer.data) == length or (not answer.data and answer.error & self.form.refusals)
                if fits and answer.servo_id == servo_id:
                    break
                # If a later servo answers, the answer of this servo is lost; any other answer is a late one.
                self._late += not (fits and answer.servo_id in servo_ids[i + 1 :])
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

    def _next_answer(self, end_ns: int) -> Answer | None:
        """Return the next status packet with a correct checksum; None if there is none until `end_ns`."""
        while True:
            while self._waiting:
                packet = self._waiting.pop(0)
                if packet.intact and (answer := self.form.answer(packet)) is not None:
                    return answer
            if not (data := self.port.read(end_ns)):
                # If this thread wakes up late, it did not get the processor.
                self._silence.held_up_ns += max(0, self.clock.now_ns() - end_ns)
                return None
            self._waiting += [packet for packet, _ in self._parser.feed(data)]

    def _require_heard(self, request: str) -> None:
        """Raise HardwareLost if the bus has been silent for too long."""
        silence = self._silence
        silent_s, held_up_s = 1e-9 * (silence.end_ns - silence.begin_ns), 1e-9 * silence.held_up_ns
        if silence.missed < _MIN_LOSSES or silent_s <= self.config.max_silence_s:
            return
        self._require_watching()
        missed = f"no answer to {request} on {self.config.port}: {silence.missed} missed in a row"
        missed += f", {1e3 * silent_s:.0f} ms"
        if held_up_s > _BUSY_SHARE * silent_s:
            raise HardwareLost(
                f"this computer is too busy: its control thread did not run for {1e3 * held_up_s:.0f} ms; {missed}",
                hint="close what else runs on it, or raise servo_watchdog_s, which is also the longest silence",
            )
        raise HardwareLost(missed, hint=f"check power, cable, ids and baud rate{self.port.advice}")

    def _require_watching(self) -> None:
        """Raise SafetyStop if the guardian has taken over: it then reads the answers that are missing here."""
        if self.guardian is not None:
            self.guardian.require_watching()
