"""Servos on an emulated bus: the effect of each instruction, for all families."""

import time
from abc import abstractmethod
from collections.abc import Callable
from typing import ClassVar, Generic, TypeVar

from sim2real.hardware.bus.packets import BROADCAST_ID, Instruction, PacketFormat, Parser
from sim2real.hardware.bus.registers import Register
from sim2real.hardware.emulation.emulated_bus import BusEmulation, PlannedBus, Request, Sample
from sim2real.hardware.emulation.firmware import ServoFirmware
from sim2real.hardware.emulation.truth import TruthLog
from sim2real.hardware.plant import Plant

S = TypeVar("S", bound=ServoFirmware)
E = TypeVar("E", bound=BusEmulation)


class InstructedBus(PlannedBus, Generic[S, E]):
    """Emulated servos of one family on a bus, driving a plant; see `PlannedBus`.

    Args:
        send: Delivers the bytes of an answer to the host; returns False if the host cannot take them.
        start_ns: Time 0 of the plant.

    Attributes:
        present: The first and the last register of present values.
        wild_counts: Range of positions out of the motors' reach.
    """

    form: ClassVar[PacketFormat]
    present: ClassVar[tuple[Register, Register]]
    wild_counts: ClassVar[tuple[int, int]]

    def __init__(
        self,
        plant: Plant,
        config: E,
        truth: TruthLog,
        send: Callable[[bytes], bool],
        start_ns: int,
        now_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self.config = config
        self.servos = {i: self.make_servo(i) for i in sorted(plant.servo_ids)}
        self._handlers: dict[int, Callable[[Request, list[S]], None]] = {
            Instruction.PING: self._ping,
            Instruction.READ: self._read,
            Instruction.WRITE: self._write,
            Instruction.REG_WRITE: self._reg_write,
            Instruction.ACTION: self._action,
            Instruction.REBOOT: self._reboot,
            Instruction.SYNC_READ: self._sync_read,
            Instruction.SYNC_WRITE: self._sync_write,
        }
        super().__init__(plant, config, truth, send, start_ns, now_ns, Parser(self.form), self.servos)

    @abstractmethod
    def make_servo(self, servo_id: int) -> S:
        """Return a servo with this bus's settings."""

    def execute(self, request: Request) -> None:
        """Carry out an instruction that is complete on the wire, and reply to it."""
        packet = request.packet
        # Every servo that receives the instruction resets its watchdog.
        broadcast = packet.servo_id == BROADCAST_ID
        targets = [s for i, s in self.servos.items() if broadcast or i == packet.servo_id]
        if packet.intact:
            for servo in targets:
                servo.heard_ns = request.t_ns
        handler = self._handlers.get(packet.code)
        if targets and packet.intact and handler is not None:
            handler(request, targets)
        elif targets and not broadcast:
            self._misunderstand(targets[0], request)

    def _misunderstand(self, servo: S, request: Request) -> None:
        """React to an instruction with a wrong checksum, or an unknown one: here without an answer."""

    def _misread(self, servo: S, request: Request) -> None:
        """React to a READ of a wrong length: here without an answer."""

    def _ping(self, request: Request, targets: list[S]) -> None:
        """Answer a ping."""
        for servo in targets:
            self._answer(servo, request, 0, servo.identity)

    def _answer(self, servo: S, request: Request, error: int, data: bytes = b"", sample: Sample | None = None) -> None:
        """Let a servo answer, with its measurement if the answer has present values."""
        status = self._status(servo, error | servo.alert, data)
        self.reply(servo.servo_id, request, status, servo.return_delay_s, sample)

    def _status(self, servo: S, error: int, data: bytes) -> bytes:
        """Return the bytes of an answer."""
        return self.form.build_status(servo.servo_id, error, data)

    def _confirm(self, servo: S, request: Request, error: int) -> None:
        """Let a servo answer an instruction that writes."""
        if request.packet.servo_id != BROADCAST_ID and servo.confirms:
            self._answer(servo, request, error)

    def _answer_read(self, servo: S, request: Request, position: int) -> None:
        """Let a servo answer a read whose address and length begin at a position in the parameters."""
        address = self.form.word(request.packet.parameters, position)
        length = self.form.word(request.packet.parameters, position + self.form.address_bytes)
        sample = self.measure(servo, request.t_ns)
        if self.ill(self._config.wild, request.t_ns):
            servo.put(servo.table.position, self.random.randrange(*self.wild_counts))
        error, data = servo.read(address, length)
        if servo.answers_reads:
            first, last = self.present
            measured = address < last.end and address + length > first.address
            self._answer(servo, request, error, data, sample if measured else None)

    def _read(self, request: Request, targets: list[S]) -> None:
        if request.packet.servo_id == BROADCAST_ID:
            return
        if len(request.packet.parameters) != 2 * self.form.address_bytes:
            self._misread(targets[0], request)
            return
        self._answer_read(targets[0], request, 0)

    def _sync_read(self, request: Request, targets: list[S]) -> None:
        del targets
        for servo_id in request.packet.parameters[2 * self.form.address_bytes :]:
            if servo_id in self.servos:
                self._answer_read(self.servos[servo_id], request, 0)

    def _write(self, request: Request, targets: list[S]) -> None:
        address, data = self._place(request)
        for servo in targets:
            self._confirm(servo, request, self._carry_out(servo, request, lambda s: s.write(address, data)))

    def _sync_write(self, request: Request, targets: list[S]) -> None:
        del targets
        parameters, begin = request.packet.parameters, 2 * self.form.address_bytes
        address, length = self.form.word(parameters, 0), self.form.word(parameters, self.form.address_bytes)
        for i in range(begin, len(parameters) - length, length + 1):
            if parameters[i] in self.servos:
                data = parameters[i + 1 : i + 1 + length]
                self._carry_out(self.servos[parameters[i]], request, lambda s, data=data: s.write(address, data))

    def _reg_write(self, request: Request, targets: list[S]) -> None:
        for servo in targets:
            servo.register_write(*self._place(request))
            self._confirm(servo, request, 0)

    def _action(self, request: Request, targets: list[S]) -> None:
        for servo in targets:
            self._confirm(servo, request, self._carry_out(servo, request, lambda s: s.action()))

    def _reboot(self, request: Request, targets: list[S]) -> None:
        for servo in targets:
            self._confirm(servo, request, 0)
            servo.reboot()
            self.configure(servo)
            self.actuate(servo, request)

    def _carry_out(self, servo: S, request: Request, change: Callable[[S], tuple[int, bool]]) -> int:
        """Let a servo change its registers, and the motor follow; return the error."""
        self.measure(servo, request.t_ns)
        error, moves = change(servo)
        self.configure(servo)
        if moves:
            self.actuate(servo, request)
        return error

    def _place(self, request: Request) -> tuple[int, bytes]:
        """Return the address and the data of an instruction that writes."""
        parameters = request.packet.parameters
        return self.form.word(parameters, 0), parameters[self.form.address_bytes :]
