"""Plants whose answers are known in closed form."""

from __future__ import annotations

import math
from dataclasses import dataclass

PWM, POSITION, VELOCITY = 16, 3, 1
STEP_S = 0.00025


class FirstOrder:
    """Speed follows its command with a time constant; position servo: proportional on top of that."""

    def __init__(self, ids=(1,), time_constant_s=0.05, top_speed_rad_s=6.0):
        self.servo_ids = tuple(ids)
        self._time_constant_s = time_constant_s
        self._top_speed_rad_s = top_speed_rad_s
        self._steps = 0
        self._q = dict.fromkeys(self.servo_ids, 0.0)
        self._dq = dict.fromkeys(self.servo_ids, 0.0)
        self._command = dict.fromkeys(self.servo_ids, (0, 0.0))

    def advance(self, t_s):
        for _ in range(round(t_s / STEP_S) - self._steps):
            self._steps += 1
            for i in self.servo_ids:
                self._dq[i] += STEP_S / self._time_constant_s * (self._target(i) - self._dq[i])
                self._q[i] += STEP_S * self._dq[i]

    def _target(self, i):
        mode, goal = self._command[i]
        if mode == PWM:
            return self._top_speed_rad_s * goal
        if mode == POSITION:
            error = goal - self._q[i]
            return math.copysign(min(abs(10.0 * error), self._top_speed_rad_s), error)
        return goal if mode == VELOCITY else 0.0

    def command(self, servo_id, mode, goal):
        self._command[servo_id] = (mode, goal)

    def measure(self, servo_id):
        mode, goal = self._command[servo_id]
        return self._q[servo_id], self._dq[servo_id], goal if mode == PWM else 0.0

    def state(self):
        return {f"{name}{i}": v[i] for i in self.servo_ids for name, v in (("q", self._q), ("dq", self._dq))}

    def truth(self):
        return {"time_constant_s": self._time_constant_s, "top_speed_rad_s": self._top_speed_rad_s}


class Ramp:
    """Position is 0.4 rad/s times time, whatever is commanded: a read tells when it was sampled."""

    SPEED_RAD_S = 0.4

    def __init__(self, ids=(1,)):
        self.servo_ids = tuple(ids)
        self._t_s = 0.0

    def advance(self, t_s):
        self._t_s = t_s

    def command(self, servo_id, mode, goal):
        pass

    def measure(self, servo_id):
        return self.SPEED_RAD_S * self._t_s, self.SPEED_RAD_S, 0.0

    def state(self):
        return {"q": self.SPEED_RAD_S * self._t_s}

    def truth(self):
        return {}


@dataclass
class Still:
    """A dataclass, which only works in a module that Python knows by name."""

    servo_ids: tuple[int, ...] = (1,)


class Breaks(Ramp):
    """A plant with a bug that shows after 0.5 s."""

    def advance(self, t_s):
        super().advance(t_s)
        if t_s > 0.5:
            raise RuntimeError("the plant broke")
