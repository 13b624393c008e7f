"""The connection to a robot over DDS: its address, one writer of commands and one reader of states."""

from __future__ import annotations

import ipaddress
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Self
from xml.sax.saxutils import quoteattr

from sim2real.errors import HardwareLost, UsageError
from sim2real.hardware.clock import SYSTEM_CLOCK, Clock
from sim2real.hardware.safety.guardian import Guardian, Process
from sim2real.hardware.unitree.legs import LegDrive
from sim2real.hardware.unitree.messages import COMMAND_TOPIC, STATE_TOPIC, LowCmd, LowState
from sim2real.installation import with_extra

try:
    from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication
    from cyclonedds.core import DDSException, InstanceState, ReadCondition, SampleState, ViewState, WaitSet
    from cyclonedds.domain import Domain, DomainParticipant
    from cyclonedds.pub import DataWriter
    from cyclonedds.qos import Policy, Qos
    from cyclonedds.sub import DataReader
    from cyclonedds.topic import Topic
except ImportError as error:
    raise UsageError("Unitree's robots need cyclonedds, which is not installed", hint=with_extra("unitree")) from error

_HIGHEST_DOMAIN: Final = 232
QUEUE: Final = 16
"""States that wait for `next_state`: 32 ms of them at 500 Hz."""
LEASE_S: Final = 2
"""Time after which a program that has died no longer counts as a writer [s]; by default it is 10 s."""


@dataclass(frozen=True)
class Address:
    """A robot's address: ``INTERFACE:DOMAIN``, such as ``eth0:0``.

    Args:
        interface: Network interface, its name or its IP address; "": Cyclone DDS chooses, or `CYCLONEDDS_URI` does.
        domain: Number of the DDS domain; that of a Go2 is 0.
    """

    interface: str
    domain: int

    @classmethod
    def parse(cls, port: str) -> Self:
        """Return the address of a text; without ``:DOMAIN`` the domain is 0."""
        interface, colon, number = port.rpartition(":")
        if not colon:
            interface, number = port, "0"
        if not (number.isdecimal() and int(number) <= _HIGHEST_DOMAIN):
            raise UsageError(
                f"port {port!r}: {number!r} is no DDS domain, a number from 0 to {_HIGHEST_DOMAIN}",
                hint="a port is INTERFACE:DOMAIN, such as eth0:0",
            )
        return cls(interface, int(number))

    def __str__(self) -> str:
        return f"{self.interface}:{self.domain}"

    @property
    def config(self) -> str | None:
        """The configuration of Cyclone DDS, or None for its own."""
        if not self.interface:
            return None
        try:
            key = f"address={quoteattr(str(ipaddress.ip_address(self.interface)))}"
        except ValueError:
            key = f"name={quoteattr(self.interface)}"
        return (
            f"<CycloneDDS><Domain Id='any'><General><Interfaces><NetworkInterface {key}/></Interfaces></General>"
            f"<Discovery><LeaseDuration>{LEASE_S}s</LeaseDuration></Discovery></Domain></CycloneDDS>"
        )


class _Domains:
    """The open domains of this process: Cyclone DDS has one configuration for each, so connections share it."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._open: dict[int, tuple[Address, Domain, int]] = {}

    def use(self, address: Address) -> None:
        with self._lock:
            other, domain, users = self._open.get(address.domain, (address, None, 0))
            if other != address:
                raise UsageError(f"domain {address.domain} is open in this process already, as {other}")
            if domain is None:
                domain = Domain(address.domain, address.config)
            self._open[address.domain] = address, domain, users + 1

    def leave(self, address: Address) -> None:
        with self._lock:
            other, domain, users = self._open.pop(address.domain)
            if users > 1:
                self._open[address.domain] = other, domain, users - 1


_DOMAINS: Final = _Domains()


class DdsLink:
    """A writer of commands and a reader of states; every method may be called from any thread.

    Args:
        mark: Name of the session. A writer of commands with another mark belongs to another program.

    Raises:
        HardwareLost: The interface does not exist, or the domain cannot be opened.
    """

    def __init__(self, address: Address, mark: str) -> None:
        self.address, self._mark = address, mark.encode()
        self.clock: Clock = SYSTEM_CLOCK
        self._reading = threading.Lock()
        self._writers: dict[object, str] = {}
        self._entities: _Entities | None = None
        # Open the domain, or share the one that is open.
        try:
            _DOMAINS.use(address)
        except DDSException as error:
            raise self._lost("cannot be opened", error) from error
        # Make the writer and the readers; without them the domain closes again.
        try:
            self._entities = _Entities(address.domain, self._mark)
        except DDSException as error:
            _DOMAINS.leave(address)
            raise self._lost("cannot be opened", error) from error

    def write(self, command: LowCmd) -> None:
        """Publish a command, without waiting and without a lock; HardwareLost if the connection is closed."""
        entities = self._entities
        if entities is None:
            raise self._closed()
        try:
            entities.writer.write(command)
        except DDSException as error:
            raise self._lost("takes no command", error) from error

    def next_state(self, timeout_s: float) -> LowState | None:
        """Return the oldest state that was not returned yet, which may be damaged; None after the timeout."""
        with self._reading:
            entities = self._entities
            if entities is None:
                raise self._closed()
            end_s = time.monotonic() + timeout_s
            while True:
                try:
                    states = entities.reader.take(1)
                    if states and isinstance(states[0], LowState):
                        return states[0]
                    left_s = end_s - time.monotonic()
                    if not states and (left_s <= 0.0 or not entities.waiting.wait(int(1e9 * left_s))):
                        return None
                except DDSException as error:
                    raise self._lost("sends no state", error) from error
                except ValueError:  # bytes of another message; an empty state is not intact
                    return LowState()

    def other_writers(self) -> list[str]:
        """Return the other programs that publish commands: the mark of each, or its number."""
        entities = self._entities
        if entities is None:
            raise self._closed()
        # Only what changed since the last call: a robot has about a hundred writers.
        for sample in entities.publications.take(1000):
            if not sample.sample_info.valid_data:
                self._writers.pop(sample.key, None)
            elif sample.topic_name == COMMAND_TOPIC:
                data = b"".join(policy.data for policy in sample.qos if isinstance(policy, Policy.Userdata))
                if data != self._mark:
                    self._writers[sample.key] = data.decode(errors="replace") or f"program {sample.participant_key}"
        return list(self._writers.values())

    def guardian(self, drive: LegDrive, silence_s: float, settle_s: float) -> Guardian:
        """Return a guardian in a process of its own, with a writer of its own; arguments as in `Guardian`."""
        program = ("-P", "-m", "sim2real.hardware.unitree.guardian_process")
        arguments = [str(self.address), self._mark.decode(), repr(drive.damping), repr(drive.lie_s)]
        return Guardian(lambda longest_s: Process(program, longest_s, arguments), silence_s, settle_s)

    def close(self) -> None:
        """Leave the domain. May be called twice."""
        with self._reading:
            if self._entities is not None:
                self._entities = None  # CPython deletes them now, or when a thread's write has ended
                _DOMAINS.leave(self.address)

    def _closed(self) -> HardwareLost:
        return HardwareLost(f"the robot on {self.address} is not open", hint="call open first")

    def _lost(self, what: str, error: DDSException) -> HardwareLost:
        return HardwareLost(
            f"the robot on {self.address} {what}: {error.msg}", hint="does the network interface exist, and is it up?"
        )


EMULATED: Final[dict[Address, Callable[[str], DdsLink]]] = {}
"""Address -> connects, with a mark, to an emulated robot in this process: `unitree.virtual`."""


def connect(address: Address, mark: str) -> DdsLink:
    """Return an open connection; see `DdsLink`."""
    emulated = EMULATED.get(address)
    return DdsLink(address, mark) if emulated is None else emulated(mark)


class _Entities:
    """The entities of a connection."""

    def __init__(self, domain: int, mark: bytes) -> None:
        participant = DomainParticipant(domain)
        # Reliable, as Unitree's own client: a robot's reader of either kind accepts it. A write never blocks.
        xcdr1 = Policy.DataRepresentation(use_cdrv0_representation=True)
        reliable = Policy.Reliability.Reliable(max_blocking_time=0)
        qos = Qos(reliable, Policy.History.KeepLast(1), Policy.Userdata(mark), xcdr1)
        self.writer = DataWriter(participant, Topic(participant, COMMAND_TOPIC, LowCmd), qos)
        # Best effort: a state that was lost is not sent again, as a newer one is on its way.
        qos = Qos(Policy.History.KeepLast(QUEUE), xcdr1)
        self.reader = DataReader(participant, Topic(participant, STATE_TOPIC, LowState), qos)
        self.publications = BuiltinDataReader(participant, BuiltinTopicDcpsPublication)
        self.waiting = WaitSet(participant)
        self.waiting.attach(ReadCondition(self.reader, SampleState.NotRead | ViewState.Any | InstanceState.Any))
