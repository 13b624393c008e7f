"""The guardian process of a robot on legs: it damps and lays down the robot whose control process has died.

    python -P -m sim2real.hardware.unitree.guardian_process LINK_FD SILENCE_S ADDRESS MARK DAMPING LIE_S

Its writer of commands exists before torque goes on, and publishes only when the control process no longer does.
"""

import sys

from sim2real.errors import HardwareLost
from sim2real.hardware.safety.guardian_process import GIVE_UP_S, Guard, begin
from sim2real.hardware.unitree.dds import Address, DdsLink
from sim2real.hardware.unitree.legs import LegDrive
from sim2real.hardware.unitree.sit_down import sit_down

_FIRST_STATE_S = 5.0


class LegGuard(Guard):
    """Lays a robot down; after its torque was off, another program may have it."""

    cut = "switch the robot off"
    at_rest = False

    def __init__(self, robot: DdsLink, drive: LegDrive) -> None:
        self._robot, self._drive = robot, drive

    def now_s(self) -> float:
        """Return the time of the robot [s]."""
        return 1e-9 * self._robot.clock.now_ns()

    def take_torque_off(self) -> str:
        """Let the motors damp until the robot lies, then take their torque off."""
        try:
            return sit_down(self._robot, self._drive, GIVE_UP_S)
        except HardwareLost as error:
            return str(error)


def main(arguments: list[str]) -> None:
    """Run until the control process ends."""
    link, silence_s, address, mark, damping, lie_s = arguments
    robot = DdsLink(Address.parse(address), mark)
    if robot.next_state(_FIRST_STATE_S) is None:
        sys.exit(f"sim2real guardian: the robot on {address} sends no state")
    begin()  # later, so that the threads of the connection do not get the priority
    drive = LegDrive(damping=float(damping), lie_s=float(lie_s), kd_max=float(damping))
    LegGuard(robot, drive).watch(int(link), float(silence_s))
    robot.close()


if __name__ == "__main__":
    main(sys.argv[1:])
