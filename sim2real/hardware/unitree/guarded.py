"""Legs on an open connection: the guardian that watches them, and every way in which their torque goes off."""

import atexit
import logging
import os
import threading
import uuid
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Final

from sim2real.errors import HardwareLost, SafetyStop, UsageError
from sim2real.hardware.clock import SYSTEM_CLOCK, Clock
from sim2real.hardware.device import Counters
from sim2real.hardware.safety.guardian import Guardian
from sim2real.hardware.unitree.dds import LEASE_S, Address, DdsLink, connect
from sim2real.hardware.unitree.legs import NAMES, LegDrive
from sim2real.hardware.unitree.messages import COMMAND_TOPIC, LowCmd
from sim2real.hardware.unitree.sit_down import motors_on, sit_down
from sim2real.hardware.unitree.stream import StateStream

_LOGGER = logging.getLogger(__name__)
_OPEN_S: Final = 3.0
_DISCOVERY_S: Final = 1.0
"""Time in which DDS finds the writers of a robot's domain [s]."""
_CONFIRM_S: Final = 1.0
"""Longest time in which motors confirm that they are on, or off [s]."""
_SETTLE_S: Final = 1.5
"""Longest time in which the guardian takes the torque off once the legs have damped [s]."""


@dataclass(frozen=True)
class _Session:
    """What is there from `open` to `close`."""

    mark: str
    robot: DdsLink
    stream: StateStream


class GuardedLegs:
    """Legs whose torque is taken off by `close`, when the interpreter exits, and by the guardian.

    The guardian is a process with a writer of its own, which starts before torque goes on: if this process dies or is
    silent, it damps the legs and takes their torque off when the robot lies. Every thread may call every method.

    Attributes:
        armed: Whether commands are published.
        halted: Whether torque stays off because `make_safe` or `close` was called.
    """

    def __init__(self, address: Address, drive: LegDrive, silence_s: float, max_silence_s: float) -> None:
        self.address, self.drive = address, drive
        self._clock: Clock = SYSTEM_CLOCK
        self.armed = self.halted = False
        self._silence_s, self._max_silence_s = silence_s, max_silence_s
        self._damp = drive.damp()  # built here, as make_safe must not need any time
        self._session: _Session | None = None
        self._guardian: Guardian | None = None
        self._on = self._leaving = False
        self._published = 0
        self._commanding = threading.Lock()

    @property
    def clock(self) -> Clock:
        """The clock of the connection; before it is open, the machine's."""
        return self._clock

    @property
    def session(self) -> _Session:
        """The open connection; raise HardwareLost if it is not open."""
        if self._session is None:
            raise HardwareLost(f"the robot on {self.address} is not open", hint="call open first")
        return self._session

    @property
    def guardian_pid(self) -> int | None:
        """Process id of the guardian; None before it is started."""
        return None if self._guardian is None else self._guardian.pid

    @property
    def counters(self) -> Counters:
        """Counts of states and commands since `open`."""
        return Counters() if self._session is None else self._session.stream.counters(self._published)

    def open(self) -> None:
        """Connect, wait for states, and lay the robot down if its motors are on.

        Raises:
            HardwareLost: The interface does not exist, the robot is silent, or another program publishes commands.
        """
        if self._session is not None:
            raise UsageError("the robot is open already", hint="close it first")
        self.armed = self.halted = self._on = self._leaving = False
        self._published = 0
        mark = f"sim2real {uuid.uuid4().hex[:8]} of process {os.getpid()}"
        robot = connect(self.address, mark)
        self._clock = robot.clock
        try:
            # States must come, and no other writer may command the motors.
            stream = StateStream(robot, self._max_silence_s)
            state = stream.begin(_OPEN_S)
            # Motors that are on have a program, perhaps one that is not discovered yet: to damp would lay it down.
            end_s = self._now_s() + (_DISCOVERY_S if motors_on(state) else 0.0)
            while not robot.other_writers() and self._now_s() < end_s:
                self.clock.sleep(0.05)
            # A program that was killed is a writer until its lease is over.
            end_s = self._now_s() + LEASE_S + 1.0
            while robot.other_writers() and self._now_s() < end_s:
                self.clock.sleep(0.05)
            _require_alone(robot, HardwareLost)
            # A program that was killed without a guardian may have left the motors on.
            if motors_on(state) and (failure := sit_down(robot, self.drive, _CONFIRM_S)):
                raise HardwareLost(failure, hint="switch the robot off")
        except BaseException:
            robot.close()
            raise
        self._session = _Session(mark, robot, stream)
        atexit.register(self.close)

    def switch_on(self, message: LowCmd) -> None:
        """Start the guardian, and publish a command until a state shows every motor on.

        Raises:
            SafetyStop: `make_safe` was called before, the guardian has taken over, or another program publishes.
            HardwareLost: The guardian does not start, or a motor stays off.
        """
        session = self.session
        if self.halted:
            raise SafetyStop("torque stays off: the legs have been made safe", hint="open the robot again")
        # The guardian watches before the first command.
        if self._guardian is None:
            self._guardian = session.robot.guardian(self.drive, self._silence_s, self.drive.lie_s + _SETTLE_S)
        _require_alone(session.robot, SafetyStop)
        self._guardian.arm()
        # Commands may be lost, so each state is answered with one until all motors are on.
        with self._commanding:
            self._on, end_s = True, self._now_s() + _CONFIRM_S
            try:
                while not self.halted:
                    session.robot.write(message)
                    off = set(NAMES) - set(motors_on(session.stream.next()[0]))
                    if not off:
                        self.armed = True
                        break
                    if self._now_s() > end_s:
                        raise HardwareLost(
                            f"{', '.join(sorted(off))} did not switch on for {_CONFIRM_S:g} s",
                            hint="look at the robot's temperatures and battery",
                        )
                    self._guardian.beat()
            finally:
                self._stop_if_halted()

    def publish(self, message: LowCmd) -> tuple[int, int]:
        """Publish a command; return the time at which that began and its duration [ns].

        Raises:
            SafetyStop: Torque is off, or the guardian has taken over.
        """
        with self._commanding:
            begin_ns = self.clock.now_ns()
            if self.halted or not self.armed:
                raise SafetyStop("no command is sent: the torque is off", hint="enable it, or open the robot again")
            self.beat()
            self.session.robot.write(message)
            self._stop_if_halted()
            self._published += 1
            return begin_ns, self.clock.now_ns() - begin_ns

    def beat(self) -> None:
        """Give the guardian a sign of life; raise SafetyStop if it has taken over, or has died."""
        if self.armed and self._guardian is not None:
            self._guardian.beat()

    def require_watching(self) -> None:
        """Raise SafetyStop as `beat` does, also when no sign of life is due."""
        if self.armed and self._guardian is not None:
            self._guardian.require_watching()

    def check(self) -> None:
        """Raise SafetyStop if another program publishes commands too."""
        if self.armed:
            _require_alone(self.session.robot, SafetyStop)

    def disable(self) -> None:
        """Let the legs damp until they are still, at most `LegDrive.lie_s`; then torque off, confirmed."""
        robot, guardian = self.session.robot, self._guardian
        with self._commanding:  # a command that is being published comes first
            self.armed = False
        if self._on and guardian is not None:
            if failure := self._lie_down(robot, guardian):
                raise HardwareLost(failure, hint="switch the robot off")
            guardian.disarm()

    def make_safe(self) -> None:
        """Let all motors damp now; the guardian takes their torque off when the robot lies. Never raises."""
        self.halted, self.armed = True, False
        session, guardian = self._session, self._guardian
        if session is None or guardian is None or not self._on or self._leaving:
            return
        with suppress(Exception):
            session.robot.write(self._damp)
        guardian.trip()

    def close(self) -> None:
        """Lay the robot down and disconnect. Never raises; if the motors do not confirm, the guardian goes on."""
        session, guardian = self._session, self._guardian
        if session is None:
            return
        self.halted, self.armed = True, False
        # A command that is being published comes first; a signal handler may have interrupted it, so do not wait long.
        if self._commanding.acquire(timeout=_CONFIRM_S):
            self._commanding.release()
        self._leaving = True
        if guardian is not None:
            failure = self._lie_down(session.robot, guardian) if self._on else ""
            if failure:
                _LOGGER.error("the torque may be on: %s", failure)
            guardian.end(confirmed=not failure)
        session.robot.close()
        self._session = self._guardian = None
        self._on = False
        atexit.unregister(self.close)

    def _lie_down(self, robot: DdsLink, guardian: Guardian) -> str:
        """Lay the robot down, and return the failure or "". A guardian that has taken over lets it damp before."""

        def live() -> None:
            with suppress(SafetyStop):  # it takes over, or has died: go on all the same
                guardian.beat()

        guardian.settle()
        drive = replace(self.drive, lie_s=0.0) if guardian.took_over else self.drive
        try:
            failure = sit_down(robot, drive, _CONFIRM_S, live)
        except Exception as error:  # whatever it is, the guardian goes on
            failure = f"{type(error).__name__}: {error}"
        self._on = bool(failure)
        return failure

    def _now_s(self) -> float:
        return 1e-9 * self.clock.now_ns()

    def _stop_if_halted(self) -> None:
        """Damp again after `make_safe`, as a command may have followed it."""
        if self.halted:
            self.make_safe()


def _require_alone(robot: DdsLink, kind: type[HardwareLost] | type[SafetyStop]) -> None:
    if others := robot.other_writers():
        raise kind(
            f"another program publishes {COMMAND_TOPIC}: {', '.join(others)}. The motors would follow both",
            hint="end that program, or switch the robot's motion service off: in the app, or with MotionSwitcher",
        )
