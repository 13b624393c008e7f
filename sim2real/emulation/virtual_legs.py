"""An emulated robot of Unitree in this process and in virtual time, without DDS; see `emulation.virtual`."""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from pathlib import Path
from typing import Any

from sim2real.emulation.body import Body
from sim2real.emulation.faults import truth_header
from sim2real.emulation.legs import STATE_HZ, EmulatedLegs, Sender, UnitreeEmulation
from sim2real.emulation.truth import TruthLog
from sim2real.emulation.virtual import NUMBERS, VirtualChannel, VirtualTime
from sim2real.errors import HardwareLost
from sim2real.hardware.safety.guardian import Guardian
from sim2real.hardware.unitree.dds import EMULATED, QUEUE, Address, DdsLink
from sim2real.hardware.unitree.device import motors_of
from sim2real.hardware.unitree.legs import LegDrive
from sim2real.hardware.unitree.messages import LowCmd, LowState


class VirtualLegs(VirtualTime):
    """An emulated robot at `port`, from construction until `stop`.

    Attributes:
        port: The address, which `connect` knows.
        links: The open connections.
    """

    def __init__(self, body: Body, config: UnitreeEmulation, truth_path: Path | None = None) -> None:
        super().__init__(truth_path)
        self._log = TruthLog(self.truth_path, truth_header(body, config, 0))
        self._config, self._period_ns = config, 1_000_000_000 // STATE_HZ
        self._due_ns = self._period_ns
        self.legs = EmulatedLegs(body, config, self._log, 0)
        self.links: list[VirtualLink] = []
        self._sender = Sender(self._publish, config, self._log, self.now_ns)
        self.address = Address("virtual", next(NUMBERS) % 233)
        self.port = str(self.address)
        EMULATED[self.address] = lambda mark: VirtualLink(self, mark)

    @property
    def silent(self) -> bool:
        """Whether the cable is unplugged."""
        return self.legs.has(self._config.silent_after_s, self._now_ns)

    def strike(self, **faults: Any) -> None:
        """Let faults begin, or end, now; named as the fields of `UnitreeEmulation`."""
        self._config = self.legs._config = self._sender._config = replace(self._config, **faults)
        self.legs.faulty_ns = self._now_ns

    def stop(self) -> None:
        """End the robot, after which its truth is complete. May be called twice."""
        EMULATED.pop(self.address, None)
        super().stop()

    def _publish(self, state: LowState) -> None:
        for link in self.links:
            link.states.append(state)

    def _next_ns(self) -> int:
        return self._due_ns

    def _advance(self, t_ns: int) -> None:
        self.legs.advance(t_ns)
        if t_ns >= self._due_ns:
            if not self.silent:
                self._sender.send(self.legs.state(t_ns), t_ns)
            self._due_ns += self._period_ns


class VirtualLink(DdsLink):
    """A connection of the host, or of the guardian.

    Attributes:
        states: States that wait for `next_state`.
    """

    def __init__(self, robot: VirtualLegs, mark: str, is_guardian: bool = False) -> None:
        self.address, self.clock, self._robot, self._mark = robot.address, robot, robot, mark.encode()
        self._is_guardian = is_guardian
        self.states: deque[LowState] = deque(maxlen=QUEUE)
        robot.links.append(self)

    def write(self, command: LowCmd) -> None:
        """Publish a command; HardwareLost if the connection is closed."""
        self._require_open()
        if not self._robot.silent:
            self._robot.legs.receive(command, self._robot.now_ns())

    def next_state(self, timeout_s: float) -> LowState | None:
        """Return the oldest state that was not returned yet, which may be damaged; None after the timeout."""
        self._require_open()
        if timeout_s > 0.0:
            self._robot._pass(self._robot.now_ns() + max(1, round(1e9 * timeout_s)), lambda: self.states)
        return self.states.popleft() if self.states else None

    def other_writers(self) -> list[str]:
        """Return the other programs that publish commands: the mark of each."""
        self._require_open()
        return [link._mark.decode() for link in self._robot.links if link._mark != self._mark]

    def guardian(self, drive: LegDrive, silence_s: float, settle_s: float) -> Guardian:
        """Return a guardian that acts in virtual time."""
        motors = motors_of(VirtualLink(self._robot, self._mark.decode(), is_guardian=True), drive)
        return Guardian(lambda longest_s: VirtualChannel(self._robot, motors, longest_s), silence_s, settle_s)

    def close(self) -> None:
        """Leave the domain. May be called twice."""
        if self in self._robot.links:
            self._robot.links.remove(self)

    def _require_open(self) -> None:
        if self not in self._robot.links or not (self._is_guardian or self._robot.host_lives):
            raise HardwareLost(f"the robot on {self.address} is not open", hint="call open first")
