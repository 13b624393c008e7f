"""DYNAMIXEL X servos on a bus, as a device."""

from collections.abc import Sequence

import numpy as np

from sim2real.hardware.device import CommandKind, Device, Reading, Transaction
from sim2real.hardware.dynamixel.bus import BusConfig, ServoBus
from sim2real.hardware.dynamixel.drive import Drive
from sim2real.hardware.safety.following import Following


class DynamixelServos(ServoBus, Device):
    """DYNAMIXEL X servos on one port, commanded in the unit of their drive."""

    def __init__(self, config: BusConfig, ids: Sequence[int], drive: Drive) -> None:
        drive.check(len(ids))
        super().__init__(config, ids)
        self.drive = drive

    @property
    def commanded(self) -> CommandKind:
        """The quantity of the drive's commands."""
        return self.drive.kind

    def open(self) -> None:
        """Open the port, find the servos, and write their settings, with torque off."""
        super().open()
        try:
            self.handshake(dict.fromkeys(self.ids))
            self.setup(self.drive.mode)
            self.drive.prepare(self)
        except BaseException:
            self.close()
            raise

    def reach(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the lowest and the highest command that the servos follow, each ``(n,)``."""
        return self.drive.reach(self)

    def following(self) -> Following | None:
        """Return how joints follow their goals, by the position controller's gain; None for voltages."""
        return self.drive.following

    def enable(self) -> None:
        """Write the settings, which a servo loses at a reboot, and switch the torque on, at rest."""
        self.drive.prepare(self)
        self.torque(True)

    def rest(self) -> np.ndarray:
        """Return the command that the servos follow right after `enable`, ``(n,)``."""
        return self.drive.rest(self)

    def measure(self) -> Reading:
        """Read all servos in one transaction; positions are the drive's angles."""
        return self.drive.reading(self.read_state(self.ids))

    def command(self, values: np.ndarray) -> Transaction:
        """Write the goals of all servos in one transaction, ``(n,)`` [V or rad]."""
        return self.drive.send(self, values)


def servos(port: str, ids: Sequence[int], drive: Drive, *, baud_rate: int, silence_s: float) -> DynamixelServos:
    """Return servos on a port, not opened yet: the device of the name ``dynamixel``; see ``DeviceFactory``."""
    return DynamixelServos(BusConfig.patient(port, baud_rate, silence_s), ids, drive)
