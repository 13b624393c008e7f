"""SO-101 arms that are assembled wrongly, and moved by a person alone: joints follow the hand up to their stops."""

import math

import numpy as np

ZERO_COUNTS = (2133, 2118, 2154, 2127, 2133, 2098)
STOPS_RAD = (1.92, 1.745, 1.69, 1.658, 2.7, 0.96)
RAD_PER_COUNT = 2 * math.pi / 4096


class WrongArm:
    """An arm with one fault. It refuses every command but "torque off".

    Args:
        hand: The person's motion; see ``SO101Plant``.
        exchanged: Two servos that have each other's id.
        turned: A servo that is mounted turned: its counts fall as the joint's angle rises.
        missing: A servo without power.
        slipped: A servo whose horn has slipped, by 250 counts.
    """

    def __init__(self, hand, exchanged=(), turned=0, missing=0, slipped=0):
        self.hand, self.t_s = dict(np.load(hand)), 0.0
        self.exchanged = dict([exchanged, exchanged[::-1]]) if exchanged else {}
        self.turned, self.slipped = turned, slipped
        self.servo_ids = tuple(i for i in range(1, 7) if i != missing)
        self.angles = [0.0] * 6

    def advance(self, t_s):
        self.t_s = t_s
        at = np.array([np.interp(t_s, self.hand["t_s"], column) for column in self.hand["position"].T])
        self.angles = np.clip(at, -np.array(STOPS_RAD), STOPS_RAD).tolist()

    def command(self, servo_id, mode, goal):
        assert mode == 0, "a wrong arm must not move"

    def measure(self, servo_id):
        joint = self.exchanged.get(servo_id, servo_id) - 1
        sign = -1.0 if servo_id == self.turned else 1.0
        shift = 250 if servo_id == self.slipped else 0
        return sign * self.angles[joint] + (ZERO_COUNTS[joint] + shift) * RAD_PER_COUNT, 0.0, 0.0

    def state(self):
        return {f"position[{i}]": angle for i, angle in enumerate(self.angles)}

    def truth(self):
        return {}
