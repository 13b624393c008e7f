"""The physics of emulated servos: the protocol of a plant, the clock that steps it, and mountings."""

import heapq
import math
from collections.abc import Sequence
from typing import Any, Final, Protocol

from sim2real.emulation.truth import Kind, TruthLog
from sim2real.errors import UsageError
from sim2real.hardware.device import OperatingMode
from sim2real.hardware.joint import Joint

STATE_PERIOD_S: Final = 0.005


class Plant(Protocol):
    """A mechanism driven by servos; only the emulator uses it, in one thread.

    A plant need not inherit from this class. Times count from the emulator's start [s]; angles are those of the servos'
    output shafts [rad]. A plant that emulates the servos' position controllers also has ``configure(servo_id, p_gain,
    d_gain, speed_rad_s)``: gains [counts], and the speed at which the setpoint moves to the goal. It is called at time
    0 for every servo with the power-up values, and whenever a write or a restart changes them.
    """

    servo_ids: tuple[int, ...]

    def advance(self, t_s: float) -> None:
        """Integrate up to a time [s], in fixed steps of at most 1 ms, under the last commands.

        Called with k * plant_step_s, k = 1, 2, ... The plant's step must divide `plant_step_s`; to avoid drift, make
        `round((t_s - now) / step)` steps.
        """
        ...

    def command(self, servo_id: int, mode: int, goal: float) -> None:
        """Command a servo from the plant's present time on.

        Args:
            mode: One of `OperatingMode`: PWM, position, velocity, or off.
            goal: PWM: fraction of the supply voltage in [-1, 1]; position: [rad]; velocity: [rad/s]; torque off: 0.
        """
        ...

    def measure(self, servo_id: int) -> tuple[float, float, float]:
        """Return position from the encoder's zero [rad], velocity [rad/s], and load, a fraction of the largest."""
        ...

    def state(self) -> dict[str, float]:
        """Return the true state for the truth log, with the same names at every call."""
        ...

    def truth(self) -> dict[str, Any]:
        """Return the true parameters, which an identification should find, for the truth log's header."""
        ...


class PlantClock:
    """Steps a plant on a fixed time grid, applies commands at grid points, and keeps a history of measurements.

    The plant is never stepped past the requested time, so that no command arrives for a time that has passed.

    Args:
        plant: The mechanism; must be at time 0.
        step_ns: Spacing of the grid [ns].
        history_ns: How far back from the newest grid point `sample` must reach [ns].
    """

    def __init__(self, plant: Plant, step_ns: int, history_ns: int, truth: TruthLog) -> None:
        self._plant = plant
        self._configure = getattr(plant, "configure", None)
        self._step_ns = step_ns
        self._truth = truth
        self._index = 0
        self._effects: list[tuple[int, int, int, int, int, int, float]] = []
        self._sequence = 0
        self._state_stride = max(1, round(STATE_PERIOD_S * 1e9 / step_ns))
        self._depth = math.ceil(history_ns / step_ns) + 3
        self._history: list[dict[int, tuple[float, float, float]]] = [{}] * self._depth
        self._remember()

    def advance(self, t_ns: int) -> None:
        """Step the plant to the last grid point at or before `t_ns`."""
        target = t_ns // self._step_ns
        while self._index < target:
            while self._effects and self._effects[0][0] <= self._index:
                self._apply()
            self._index += 1
            self._plant.advance(self._index * self._step_ns * 1e-9)
            self._remember()

    def configure(self, servo_id: int, p_gain: int, d_gain: int, speed_rad_s: float) -> None:
        """Pass the settings of a servo's controller to a plant that emulates it; see `Plant`."""
        if self._configure is not None:
            self._configure(servo_id, p_gain, d_gain, speed_rad_s)

    def schedule(self, t_ns: int, t_host_ns: int, servo_id: int, mode: int, goal: float) -> None:
        """Schedule a command at the grid point nearest to a time; commands at one point apply in the order of calls.

        Args:
            t_ns: Time of its effect [ns].
            t_host_ns: Time at which the emulator received the command, for the truth log [ns]; 0: the servo's own
                command.
        """
        index = max(round(t_ns / self._step_ns), self._index)
        self._sequence += 1
        heapq.heappush(self._effects, (index, self._sequence, t_ns, t_host_ns, servo_id, mode, goal))

    def cancel(self, servo_id: int) -> None:
        """Drop a servo's commands that have not taken effect yet."""
        self._effects = [effect for effect in self._effects if effect[4] != servo_id]
        heapq.heapify(self._effects)

    def sample(self, servo_id: int, t_ns: int) -> tuple[float, float, float]:
        """Return position, velocity and load at a time [ns] that `advance` has reached.

        Interpolated linearly between grid points; after the newest one the position is extrapolated by the velocity.
        """
        # Find the grid point before, within the history.
        place = max(0.0, t_ns / self._step_ns)
        before = min(int(place), self._index)
        before = max(before, self._index - self._depth + 2)
        position_rad, velocity_rad_s, load = self._history[before % self._depth][servo_id]
        share = max(0.0, place - before)
        # Interpolate to the next grid point, or extrapolate if there is none yet.
        if before == self._index:
            return position_rad + velocity_rad_s * share * self._step_ns * 1e-9, velocity_rad_s, load
        after = self._history[(before + 1) % self._depth][servo_id]
        return (
            position_rad + share * (after[0] - position_rad),
            velocity_rad_s + share * (after[1] - velocity_rad_s),
            load + share * (after[2] - load),
        )

    def _apply(self) -> None:
        _, _, planned_ns, t_host_ns, servo_id, mode, goal = heapq.heappop(self._effects)
        t_ns = self._index * self._step_ns
        self._plant.command(servo_id, mode, goal)
        self._truth.write(Kind.EFFECT, servo_id, t_host_ns, t_ns, t_ns, t_ns - planned_ns, (mode, goal))

    def _remember(self) -> None:
        plant = self._plant
        self._history[self._index % self._depth] = {i: plant.measure(i) for i in plant.servo_ids}
        if self._index % self._state_stride == 0:
            t_ns = self._index * self._step_ns
            self._truth.write(Kind.STATE, 0, 0, t_ns, t_ns, 0, tuple(plant.state().values()))


class MountedPlant:
    """A plant whose servos drive its joints through mountings; see `sim2real.emulation.plant.Plant`.

    The inner plant computes with the joints' angles, speeds and voltages.

    Args:
        joints: One for each servo, in the order of the plant's `servo_ids`.
        zero_rad: Angle from the encoder's count 0 at which the device reports 0 [rad]; in the inner plant, the same for
            a joint at 0.

    Raises:
        UsageError: There is another number of joints than of servos.
    """

    def __init__(self, inside: Plant, joints: Sequence[Joint], zero_rad: float) -> None:
        self._plant, self._zero_rad, self.servo_ids = inside, zero_rad, tuple(inside.servo_ids)
        if len(joints) != len(self.servo_ids):
            raise UsageError(f"{len(joints)} joints are mounted on {len(self.servo_ids)} servos")
        self._joints = dict(zip(self.servo_ids, joints, strict=True))
        self.advance, self.state, self.truth = inside.advance, inside.state, inside.truth
        self._configure = getattr(inside, "configure", None)

    def command(self, servo_id: int, mode: int, goal: float) -> None:
        joint = self._joints[servo_id]
        if mode == OperatingMode.POSITION:
            goal = joint.angle(goal - self._zero_rad) + self._zero_rad
        elif mode == OperatingMode.VELOCITY:
            goal = joint.speed(goal)
        else:
            goal = joint.direction * goal
        self._plant.command(servo_id, mode, goal)

    def configure(self, servo_id: int, p_gain: int, d_gain: int, speed_rad_s: float) -> None:
        if self._configure is not None:
            self._configure(servo_id, p_gain, d_gain, speed_rad_s / self._joints[servo_id].gear)

    def measure(self, servo_id: int) -> tuple[float, float, float]:
        joint = self._joints[servo_id]
        angle, speed, load = self._plant.measure(servo_id)
        encoder = joint.encoder(angle - self._zero_rad) + self._zero_rad
        return encoder, joint.direction * joint.gear * speed, joint.direction * load
