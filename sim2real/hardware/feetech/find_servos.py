"""The search for the servos of a robot on a port, before anything else is read from them."""

from collections.abc import Mapping
from typing import Final

from sim2real.errors import HardwareLost
from sim2real.hardware.feetech import registers as reg
from sim2real.hardware.feetech.calibration import CalibratedJoint
from sim2real.hardware.feetech.device import StsConfig, StsLink

_SCANS: Final = 3
_PATIENT_S: Final = 0.02  # answers of a USB adapter with a latency timer of 16 ms


def find_servos(port: str, joints: Mapping[int, str], baud_rate: int) -> tuple[CalibratedJoint, ...]:
    """Return the robot's joints, with the homing offsets and limits that their servos hold. Writes nothing.

    Args:
        joints: Id -> joint, of all servos that the robot has.

    Raises:
        HardwareLost: No servo answers, they answer at another baud rate, or one is missing.
    """
    # Search the robot's own baud rate first.
    for rate in sorted(reg.BAUD_RATES, key=lambda rate: rate != baud_rate):
        link = StsLink(StsConfig(port, rate, reply_timeout_s=_PATIENT_S, max_silence_s=1.0, guardian=False))
        try:
            # At the expected rate a servo that is missing is searched again, as answers may be lost.
            answering: list[int] = []
            for _ in range(_SCANS if rate == baud_rate else 1):
                answering = sorted({*answering, *(i for i in link.scan() if i in joints or rate == baud_rate)})
                if set(joints) <= set(answering):
                    break
            if answering and rate != baud_rate:
                raise HardwareLost(
                    f"the servos {answering} on {port} answer at {rate} baud, not at {baud_rate}",
                    hint="lerobot-setup-motors gives each servo its id and its baud rate",
                )
            if missing := [f"{name!r} (id {i})" for i, name in joints.items() if answering and i not in answering]:
                raise HardwareLost(
                    f"no servo answers on {port} for the joint {' and '.join(missing)}. Ids that answer: {answering}",
                    hint="check the cables between the servos; two servos of one id garble each other's answers: "
                    "connect one at a time, and give it its id with lerobot-setup-motors",
                )
            if answering:
                return tuple(_joint(link, i, name) for i, name in joints.items())
        finally:
            link.close()
    raise HardwareLost(
        f"no servo answers on {port}, at any baud rate of {list(reg.BAUD_RATES)}",
        hint="check that the servos have power, and that the port is that of the arm",
    )


def _joint(link: StsLink, servo_id: int, name: str) -> CalibratedJoint:
    registers = (reg.MIN_POSITION, reg.MAX_POSITION, reg.HOMING_OFFSET)
    low, high, offset = (link.read(servo_id, register, despite_error=True) for register in registers)
    # A servo with the limits 0 and 0 turns without end.
    low, high = (low, high) if low < high else (0, reg.COUNTS_PER_REVOLUTION - 1)
    return CalibratedJoint(name, servo_id, low_count=low, high_count=high, homing_offset=offset)
