"""Unitree's own client reads an emulated Go2 and lets it stand up: ``unitree_client.py DOMAIN``, run by a test.

The released package lacks its folder ``b2`` and its compiled CRC, so an empty module stands in for the first, and the
package's own CRC in Python is used.
"""

import json
import platform
import sys
import time
from types import ModuleType

import cyclonedds.domain  # noqa: F401 - before the name of the system changes
import numpy as np

sys.modules["unitree_sdk2py.b2"] = ModuleType("unitree_sdk2py.b2")
system, platform.system = platform.system, lambda: "another than Linux"

from unitree_sdk2py.core.channel import (  # noqa: E402
    ChannelFactoryInitialize,
    ChannelPublisher,
    ChannelSubscriber,
)
from unitree_sdk2py.idl.default import unitree_go_msg_dds__LowCmd_  # noqa: E402
from unitree_sdk2py.idl.unitree_go.msg.dds_ import LowCmd_, LowState_  # noqa: E402
from unitree_sdk2py.utils.crc import CRC  # noqa: E402

FOLDED, STANDING = np.array([0.0, 1.36, -2.65] * 4), np.array([0.0, 0.8, -1.5] * 4)
PERIOD_S = 0.005


def off():
    """Return how far a joint is from standing at most [rad]."""
    return np.abs([motor.q for motor in states[-1].motor_state[:12]] - STANDING).max()


ChannelFactoryInitialize(int(sys.argv[1]), "lo")
crc, states = CRC(), []
platform.system = system
subscriber, publisher = ChannelSubscriber("rt/lowstate", LowState_), ChannelPublisher("rt/lowcmd", LowCmd_)
subscriber.Init(states.append, 10)
publisher.Init()
while not states:
    time.sleep(0.01)

command = unitree_go_msg_dds__LowCmd_()
command.head, command.level_flag = [0xFE, 0xEF], 0xFF
start = np.array([motor.q for motor in states[-1].motor_state[:12]])
begin = time.monotonic()
# On a busy machine it stands later.
while (t_s := time.monotonic() - begin) < 2.0 or (t_s < 10.0 and off() > 0.15):
    to_fold, to_stand = min(1.0, t_s / 0.4), np.clip((t_s - 0.4) / 0.8, 0.0, 1.0)
    goal = start + to_fold * (FOLDED - start) + to_stand * (STANDING - FOLDED)
    for motor, q in zip(command.motor_cmd, goal, strict=False):
        motor.mode, motor.q, motor.kp, motor.kd = 0x01, float(q), 60.0, 4.0
    command.crc = crc.Crc(command)
    publisher.Write(command)
    time.sleep(PERIOD_S)

last = states[-1]
print(
    json.dumps(
        {
            "states": len(states),
            "ticks_ms": [state.tick for state in states],
            "intact": all(crc.Crc(state) == state.crc for state in states[-5:]),
            "q": [motor.q for motor in last.motor_state[:12]],
            "quaternion": list(last.imu_state.quaternion),
            "foot_force": list(last.foot_force),
        }
    )
)
