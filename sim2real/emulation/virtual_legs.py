"""An emulated robot of Unitree in this process and in virtual time, without DDS; see `emulation.virtual`."""

from __future__ import annotations

from collections import deque
from pathlib import Path
from typing import Any

from sim2real.emulation.legs import EmulatedLegs, UnitreeEmulation
from sim2real.emulation.plant import Body
from sim2real.emulation.robot import PlannedRobot
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
        self.links: list[VirtualLink] = []
        super().__init__(body, config, truth_path)
        self.legs: Any = self.planned
        self.address = Address("virtual", next(NUMBERS) % 233)
        self.port = str(self.address)
        EMULATED[self.address] = lambda mark: VirtualLink(self, mark)

    def make(self, physics: Body, config: UnitreeEmulation, log: TruthLog) -> PlannedRobot[Any]:
        return EmulatedLegs(physics, config, log, 0, self._publish, self.now_ns)

    def stop(self) -> None:
        EMULATED.pop(self.address, None)
        super().stop()

    def _publish(self, state: LowState) -> None:
        for link in self.links:
            link.states.append(state)


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
        self._require_open()
        if not self._robot.legs.is_silent(self._robot.now_ns()):
            self._robot.legs.receive(command, self._robot.now_ns())

    def next_state(self, timeout_s: float) -> LowState | None:
        self._require_open()
        if timeout_s > 0.0:
            self._robot._pass(self._robot.now_ns() + max(1, round(1e9 * timeout_s)), lambda: self.states)
        return self.states.popleft() if self.states else None

    def other_writers(self) -> list[str]:
        self._require_open()
        return [link._mark.decode() for link in self._robot.links if link._mark != self._mark]

    def guardian(self, drive: LegDrive, silence_s: float, settle_s: float) -> Guardian:
        motors = motors_of(VirtualLink(self._robot, self._mark.decode(), is_guardian=True), drive)
        return Guardian(lambda longest_s: VirtualChannel(self._robot, motors, longest_s), silence_s, settle_s)

    def close(self) -> None:
        if self in self._robot.links:
            self._robot.links.remove(self)

    def _require_open(self) -> None:
        if self not in self._robot.links or not (self._is_guardian or self._robot.host_lives):
            raise HardwareLost(f"the robot on {self.address} is not open", hint="call open first")
