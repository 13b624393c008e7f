"""Plants whose answers are known in closed form."""

from __future__ import annotations

import math

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


class Joints:
    """Position servos whose encoders show 2048 at 0 rad; they start elsewhere and stay where they are without torque.

    A setpoint follows the goal at the profile velocity, and the joint the setpoint, the faster the higher the gain. It
    keeps all that it was told of its controllers, in `told`.
    """

    CENTRE_RAD = math.pi
    RATE_PER_GAIN = 0.025

    def __init__(self, ids=(1, 2, 3), start_rad=(0.5, -0.8, 0.3), rate_per_gain=RATE_PER_GAIN):
        self.servo_ids = tuple(ids)
        self._rate_per_gain = rate_per_gain
        self._steps = 0
        self._q = dict(zip(ids, start_rad, strict=True))
        self._dq = dict.fromkeys(ids, 0.0)
        self._setpoint = dict(self._q)
        self._command = dict.fromkeys(ids, (0, 0.0))
        self.told = []
        self._controller = {}

    def configure(self, servo_id, p_gain, d_gain, profile_velocity_rad_s):
        self.told.append((self._steps * STEP_S, servo_id, p_gain, d_gain, profile_velocity_rad_s))
        self._controller[servo_id] = (p_gain, profile_velocity_rad_s)

    def advance(self, t_s):
        for _ in range(round(t_s / STEP_S) - self._steps):
            self._steps += 1
            for i in self.servo_ids:
                self._dq[i] = self._speed(i)
                self._q[i] += STEP_S * self._dq[i]

    def _speed(self, i):
        mode, goal = self._command[i]
        if mode != POSITION:
            self._setpoint[i] = self._q[i]
            return 0.0
        p_gain, profile_rad_s = self._controller[i]
        error = goal - self.CENTRE_RAD - self._setpoint[i]
        self._setpoint[i] += math.copysign(min(abs(error), STEP_S * profile_rad_s), error)
        return self._rate_per_gain * p_gain * (self._setpoint[i] - self._q[i])

    def command(self, servo_id, mode, goal):
        self._command[servo_id] = (mode, goal)

    def measure(self, servo_id):
        return self._q[servo_id] + self.CENTRE_RAD, self._dq[servo_id], 0.0

    def state(self):
        gains = {i: p_gain for i, (p_gain, _) in self._controller.items()}
        profiles = {i: profile_rad_s for i, (_, profile_rad_s) in self._controller.items()}
        rows = {"q": self._q, "dq": self._dq, "gain": gains, "profile": profiles}
        return {f"{name}{i}": row.get(i, 0.0) for name, row in rows.items() for i in self.servo_ids}

    def truth(self):
        return {}


class Ramp:
    """Position is speed times time, whatever is commanded: a read tells when it was sampled."""

    def __init__(self, ids=(1,), speed_rad_s=0.4):
        self.servo_ids = tuple(ids)
        self.speed_rad_s = speed_rad_s
        self._t_s = 0.0

    def advance(self, t_s):
        self._t_s = t_s

    def command(self, servo_id, mode, goal):
        pass

    def measure(self, servo_id):
        return self.speed_rad_s * self._t_s, self.speed_rad_s, 0.0

    def state(self):
        return {"q": self.speed_rad_s * self._t_s}

    def truth(self):
        return {}
