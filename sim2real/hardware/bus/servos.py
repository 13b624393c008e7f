"""Servos of any family on one bus: the guardian that watches them, and every way in which their torque goes off."""

import atexit
import logging
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Final, Generic, Self, TypeVar

from sim2real.errors import HardwareLost, SafetyStop, UsageError
from sim2real.hardware.bus.link import ServoLink
from sim2real.hardware.bus.models import ServoModel
from sim2real.hardware.bus.packets import BROADCAST_ID, Instruction
from sim2real.hardware.bus.port import LinkConfig
from sim2real.hardware.clock import SYSTEM_CLOCK, Clock
from sim2real.hardware.device import Counters, WithoutHost

_LOGGER = logging.getLogger(__name__)
_SHARED_PINGS: Final = 3

L = TypeVar("L", bound=ServoLink)


class GuardedServos(Generic[L]):
    """Servos on a bus, and the guardian that watches them. All methods may be called from any thread.

    The torque is taken off by `close`, when the context is left, and when the interpreter exits; on a signal only if
    its handler calls `make_safe`. If this process is killed or hangs, the guardian takes the torque off: a separate
    process that is started before torque goes on.

    Attributes:
        models: Id -> model of the servos that answered; `close` takes their torque off.
        armed: Whether torque was switched on.
        halted: Whether torque stays off because `make_safe` or `close` was called.
    """

    link_type: type[L]
    """Makes the link from a configuration."""

    def __init__(self, config: LinkConfig, ids: Sequence[int] = ()) -> None:
        self.config = config
        self.ids: tuple[int, ...] = ()
        self.models: dict[int, ServoModel] = {}
        self.armed = False
        self.halted = False
        self._link: L | None = None
        self.watch(ids)

    def __enter__(self) -> Self:
        """Return the open servos, with torque off."""
        self.open()
        return self

    def __exit__(self, *exception: object) -> None:
        """Take the torque off and close the port."""
        self.close()

    def open(self) -> None:
        """Open the port; raise HardwareLost if that cannot be done."""
        if self._link is not None and not self._link.closed:
            raise UsageError("the servos are open already", hint="close them first")
        self.armed = self.halted = False
        self.models = {}
        self._link = self.link_type(self.config)
        self._link.off_packet = self._off_packet
        atexit.register(self.close)

    @property
    def link(self) -> L:
        """The link, once it is open."""
        if self._link is None:
            raise HardwareLost(f"the servos on {self.config.port} are not open", hint="call open first")
        return self._link

    @property
    def motors(self) -> tuple[str, ...]:
        """Names of the servos."""
        return tuple(f"servo {i}" for i in self.ids)

    @property
    def clock(self) -> Clock:
        """The clock of the port; before it is open, the machine's."""
        return SYSTEM_CLOCK if self._link is None else self._link.clock

    @property
    def silence_s(self) -> float:
        """Longest time without an instruction while torque is on [s]; 0: unlimited."""
        return self.config.silence_s

    @property
    def counters(self) -> Counters:
        """Counts of the transactions since `open`."""
        return Counters() if self._link is None else self._link.counters

    def require_watching(self) -> None:
        """Raise SafetyStop if the guardian has taken over, or has died."""
        if self._link is not None and self._link.guardian is not None:
            self._link.guardian.require_watching()

    @property
    def guardian_pid(self) -> int | None:
        """Process id of the guardian; None before it is started."""
        guardian = None if self._link is None else self._link.guardian
        return None if guardian is None else guardian.pid

    def watch(self, servo_ids: Sequence[int]) -> None:
        """Let `make_safe` and the guardian act on these servos from now on."""
        if not all(0 <= i < BROADCAST_ID for i in servo_ids):
            raise UsageError(f"servos {list(servo_ids)}: an id is a number from 0 to {BROADCAST_ID - 1}")
        form, torque = self.link_type.form, self.link_type.table.torque
        self.ids = tuple(servo_ids)
        # Built here, as make_safe must not need any time.
        self._off_packet = form.write_each(torque, dict.fromkeys(self.ids, 0)) if self.ids else b""
        if self._link is not None:
            self._link.off_packet = self._off_packet

    def find(self, servo_id: int, whose: str = "") -> bytes:
        """Return the data of a servo's answer to a ping.

        Raises:
            HardwareLost: It does not answer, the message has the ids that do; or two servos have this id.
        """
        # Ping once for the data.
        try:
            data = self.link.ping(servo_id)
        except HardwareLost as error:
            raise HardwareLost(
                f"servo {servo_id}{whose} does not answer on {self.config.port} at {self.config.baud_rate} baud. "
                f"Available: {sorted(self.link.scan())}",
                hint="check power, cable, id and baud rate; set a USB adapter's latency timer to 1 ms; two servos of "
                "one id garble each other's answers: connect one at a time",
            ) from error
        # Ping several times for a second servo of the same id: a late answer to an earlier ping does not repeat.
        ping, wait_s = self.link.form.build(servo_id, Instruction.PING), 2.0 * self.config.reply_timeout_s
        if all(self.link.answering(ping, wait_s).count(servo_id) > 1 for _ in range(_SHARED_PINGS)):
            raise HardwareLost(
                f"two servos on {self.config.port} have the id {servo_id}{whose}: both answer, and both would obey",
                hint="connect one of them at a time, and give each an id of its own",
            )
        return data

    def without_host(self) -> tuple[WithoutHost, ...]:
        """Return the reaction of each model on this bus to the death of this process."""
        kinds: dict[ServoModel, list[str]] = {}
        for servo_id, model in self.models.items():
            kinds.setdefault(model, []).append(f"servo {servo_id}")
        return tuple(m.without_host(self.silence_s, tuple(motors)) for m, motors in kinds.items())

    def facts(self) -> dict[str, dict[str, str]]:
        """Return firmware, supply voltage and temperature of each servo; see `Device.facts`."""
        link, table = self.link, self.link.table
        facts: dict[str, dict[str, str]] = {"firmware": {}, "voltage": {}, "temperature": {}}
        # An error of a servo, such as an alarm, does not keep its facts from the log.
        for servo_id, motor in zip(self.ids, self.motors, strict=True):
            numbers = [link.read(servo_id, r, despite_error=True) for r in (*table.firmware, table.voltage)]
            facts["firmware"][motor] = ".".join(map(str, numbers[:-1]))
            facts["voltage"][motor] = f"{0.1 * numbers[-1]:.1f} V"
            facts["temperature"][motor] = f"{link.read(servo_id, table.temperature, despite_error=True)} °C"
        return facts

    def guard(self) -> None:
        """Arm the guardian before torque goes on; start it at the first call.

        Raises:
            SafetyStop: `make_safe` or `close` was called before, or the guardian has taken over.
            HardwareLost: It does not start.
        """
        if self.halted:
            raise SafetyStop("torque stays off: the servos have been made safe", hint="open them again")
        link = self.link
        if self.config.guardian:
            if link.guardian is None:
                queries = link.form.torque_queries(link.table.torque, self.ids)
                times_s = self.config.silence_s, self.config.reply_timeout_s
                link.guardian = link.port.guardian(self._off_packet, queries, *times_s)
            link.guardian.arm()
        link.at_rest = False
        if self.halted:  # in another thread, or by a signal
            link.at_rest = True
            raise SafetyStop("torque stays off: the servos have been made safe", hint="open them again")

    def disable(self) -> None:
        """Switch the torque off: of all servos at once, then of each one until it confirms.

        The guardian watches until all have confirmed: if one does not, the guardian goes on trying.

        Raises:
            HardwareLost: A servo does not confirm; the others were switched off.
        """
        with self._unguarded():
            if unconfirmed := self._release(self.ids):
                raise HardwareLost(
                    f"servos {unconfirmed} on {self.config.port} do not confirm that their torque is off",
                    hint="cut their power",
                )

    def switched_on(self) -> None:
        """Note that torque is on; raise SafetyStop if it was taken off meanwhile."""
        self.armed = True
        if self.link.at_rest:
            self.armed = False
            raise SafetyStop("torque stays off: the servos have been made safe", hint="open them again")

    @contextmanager
    def _unguarded(self) -> Iterator[None]:
        """Take the torque off in this block: the guardian watches until its end, unless it has acted already."""
        self.armed = False
        self.link.at_rest = True
        guardian = self.link.guardian
        if guardian is not None and not guardian.settle():
            guardian.disarm()  # it has taken over or died: take the torque off all the same
        yield
        if guardian is not None:
            guardian.disarm()

    def make_safe(self) -> None:
        """Take the torque off without a lock and without waiting for answers: for signal handlers and watchdog threads.

        It takes no lock because the code that a signal interrupts may hold it. Torque cannot be switched on again
        afterwards.
        """
        # In this order, as `guard` in another thread allows motion and then looks for `halted`, and `switched_on` sets
        # `armed` and then looks for `at_rest`.
        self.halted = True
        if self._link is not None:
            self._link.at_rest = True
        self.armed = False
        if self._link is not None:
            self._link.make_safe()

    def close(self) -> None:
        """Take the torque off, and close the port. Never raises; may be called twice, and before `open`.

        If a servo does not confirm, the guardian tries for another 10 s.
        """
        link = self._link
        if link is None or link.closed:
            return
        self.halted = True
        link.at_rest, self.armed = True, False
        guardian = link.guardian
        # Let a guardian that takes the torque off finish, as both use the same line.
        if guardian is not None:
            guardian.settle()
        # Release every servo; the guardian continues with those that do not confirm.
        if unconfirmed := self._release(self.models):
            _LOGGER.error("servos %s did not confirm that their torque is off", unconfirmed)
        link.close()
        if guardian is not None:
            guardian.end(confirmed=not unconfirmed)
        atexit.unregister(self.close)

    def _release(self, servo_ids: Iterable[int]) -> list[int]:
        """Take the torque of all servos off at once; return those that do not confirm it. Never raises."""
        self.link.send_off()
        return [servo_id for servo_id in servo_ids if not self.release(servo_id)]

    def release(self, servo_id: int) -> bool:
        """Take a servo's torque off, and return whether it has confirmed; never raises."""
        return self.link.force(servo_id, self.link.table.torque, 0)
