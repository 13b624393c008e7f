"""The connection to a robot over DDS: address, writer of commands, reader of states, and stream of states."""

from __future__ import annotations

import ipaddress
import threading
import time
from array import array
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Self
from xml.sax.saxutils import quoteattr

import numpy as np

from sim2real.errors import HardwareLost, UsageError
from sim2real.hardware.clock import SYSTEM_CLOCK, Clock
from sim2real.hardware.device import Counters, Transaction
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
"""Most states that wait for `next_state`: 32 ms at 500 Hz."""
LEASE_S: Final = 2
"""Time after which a program that has died no longer counts as a writer [s]; the default of DDS is 10 s."""

PERIOD_S: Final = 0.002
"""Time between two states of a Go2 [s]."""
_LATE_S: Final = 0.005
"""A state that arrives this long after the call is late [s]."""
_TICKS: Final = 2
"""Ticks [ms] from one state to the next."""


@dataclass(frozen=True)
class Address:
    """A robot's address: ``INTERFACE:DOMAIN``, such as ``eth0:0``.

    Args:
        interface: Name or IP address of the network interface; "": chosen by Cyclone DDS, or by `CYCLONEDDS_URI`.
        domain: Number of the DDS domain; a Go2 has domain 0.
    """

    interface: str
    domain: int

    @classmethod
    def parse(cls, port: str) -> Self:
        """Parse an address; without ``:DOMAIN`` the domain is 0."""
        interface, colon, number = port.rpartition(":")
        if not colon:
            interface, number = port, "0"
        if not (number.isdecimal() and int(number) <= _HIGHEST_DOMAIN):
            raise UsageError(
                f"port {port!r}: {number!r} is not a DDS domain, a number from 0 to {_HIGHEST_DOMAIN}",
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


_DOMAINS: Final[dict[int, tuple[Address, Domain]]] = {}
"""Number of a domain that this process has opened -> address and domain: one configuration for each domain."""


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
        other = _DOMAINS.get(address.domain, (address,))[0]
        if other != address:
            raise UsageError(f"domain {address.domain} is open in this process already, as {other}")
        try:
            if address.domain not in _DOMAINS:
                _DOMAINS[address.domain] = address, Domain(address.domain, address.config)
            self._entities = _Entities(address.domain, self._mark)
        except DDSException as error:
            raise self._lost("cannot be opened", error) from error

    def now_s(self) -> float:
        """Return the time [s]."""
        return 1e-9 * self.clock.now_ns()

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
        """Return the oldest state that was not returned yet, perhaps a damaged one; None after the timeout."""
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
                except ValueError:  # bytes of another message: return an empty state, whose CRC is wrong
                    return LowState()

    def other_writers(self) -> list[str]:
        """Return the marks (or numbers) of other programs that publish commands."""
        entities = self._entities
        if entities is None:
            raise self._closed()
        # Read only changes since the last call: a robot has about a hundred writers.
        for sample in entities.publications.take(1000):
            if not sample.sample_info.valid_data:
                self._writers.pop(sample.key, None)
            elif sample.topic_name == COMMAND_TOPIC:
                data = b"".join(policy.data for policy in sample.qos if isinstance(policy, Policy.Userdata))
                if data != self._mark:
                    self._writers[sample.key] = data.decode(errors="replace") or f"program {sample.participant_key}"
        return list(self._writers.values())

    def guardian(self, drive: LegDrive, silence_s: float, settle_s: float) -> Guardian:
        """Start a guardian in a separate process with its own writer; arguments as in `Guardian`."""
        arguments = [str(self.address), self._mark.decode(), repr(drive.damping), repr(drive.lie_s)]
        place = "sim2real.hardware.unitree.device:guarded"
        return Guardian(lambda longest_s: Process(place, arguments, longest_s), silence_s, settle_s)

    def close(self) -> None:
        """Close the connection. May be called twice."""
        with self._reading:
            self._entities = None  # CPython deletes the entities now, or when a running write has ended

    def _closed(self) -> HardwareLost:
        return HardwareLost(f"the robot on {self.address} is not open", hint="call open first")

    def _lost(self, what: str, error: DDSException) -> HardwareLost:
        return HardwareLost(
            f"the robot on {self.address} {what}: {error.msg}", hint="does the network interface exist, and is it up?"
        )


class StateStream:
    """Reads states in order; drops states with a wrong CRC, and counts missing, late and overtaken states.

    A missing or damaged state leaves a gap in the ticks.

    Args:
        max_silence_s: Time without a state after which the robot is lost [s].
    """

    def __init__(self, robot: DdsLink, max_silence_s: float) -> None:
        self.robot, self._max_silence_s = robot, max_silence_s
        self._clock = robot.clock
        self._lock = threading.Lock()
        self._tick: int | None = None
        self._taken_s = 0.0
        self._lost = self._late = self._answered = self._retries = 0
        self._late_s = array("d")

    def begin(self, timeout_s: float) -> LowState:
        """Wait for the first state that is intact, and return it."""
        with self._lock:
            state = self._await(timeout_s, lambda state: state.intact)
            self._tick, self._taken_s = int(state.record["tick"]), self.robot.now_s()
            return state

    def next(self) -> tuple[LowState, Transaction]:
        """Return the first state that arrives after the call, and its times; raise HardwareLost if none does."""
        called_ns = self._clock.now_ns()
        with self._lock:
            # Drop states that came before the call: they are older than the step that reads them.
            begin_ns = self._clock.now_ns()
            while (old := self.robot.next_state(0.0)) is not None:
                self._is_next(old)
            lost = self._lost
            state = self._await(self._max_silence_s, self._is_next)
            # Count the state.
            arrived_ns = self._clock.now_ns()
            retries, waited_s = self._lost - lost, 1e-9 * (arrived_ns - begin_ns)
            late_s = max(0.0, waited_s - PERIOD_S * (1 + retries))
            self._late += retries == 0 and waited_s > _LATE_S
            self._retries += retries
            self._answered += 1
            self._late_s.append(late_s)
        times = begin_ns - called_ns, arrived_ns - begin_ns, retries, int(1e9 * late_s)
        return state, Transaction(arrived_ns, *times)

    def counters(self, commands: int) -> Counters:
        """Return the counts of states and of commands."""
        done = self._answered + commands
        return Counters(done, self._lost, self._retries, self._late, np.array(self._late_s))

    def _await(self, longest_s: float, accepts: Callable[[LowState], bool]) -> LowState:
        damaged, end_s = 0, self.robot.now_s() + longest_s
        while True:
            left_s = end_s - self.robot.now_s()
            state = self.robot.next_state(left_s) if left_s > 0.0 else None
            if state is None:
                raise self._silent(longest_s, damaged)
            if accepts(state):
                return state
            damaged += not state.intact

    def _is_next(self, state: LowState) -> bool:
        """Note a state; return whether it is intact and newer than the one before."""
        if not state.intact:
            return False
        tick, now_s = int(state.record["tick"]), self.robot.now_s()
        # The 32-bit counter starts again at 0.
        ahead = (tick - (self._tick or 0) + 2**31) % 2**32 - 2**31
        if ahead <= 0:
            self._late += 1
            return False
        # After a pause, the queue itself has dropped states.
        if now_s - self._taken_s < (QUEUE - 2) * PERIOD_S:
            self._lost += max(0, round(ahead / _TICKS) - 1)
        self._tick, self._taken_s = tick, now_s
        return True

    def _silent(self, time_s: float, damaged: int) -> HardwareLost:
        if damaged:
            return HardwareLost(
                f"the robot on {self.robot.address} has sent {damaged} states in {time_s:g} s, all with a wrong CRC",
                hint="is it a Go2, and does its firmware fill in the CRC of its states?",
            )
        return HardwareLost(
            f"the robot on {self.robot.address} has sent no state for {time_s:g} s",
            hint="is it on, is the cable in, and are interface and domain the robot's?",
        )


EMULATED: Final[dict[Address, Callable[[str], DdsLink]]] = {}
"""Address -> function that connects, with a mark, to an emulated robot in this process."""


def connect(address: Address, mark: str) -> DdsLink:
    """Return an open connection; see `DdsLink`."""
    emulated = EMULATED.get(address)
    return DdsLink(address, mark) if emulated is None else emulated(mark)


class _Entities:
    """The entities of a connection."""

    def __init__(self, domain: int, mark: bytes) -> None:
        participant = DomainParticipant(domain)
        # Reliable, like Unitree's own client: both kinds of readers accept it. A write never blocks.
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
