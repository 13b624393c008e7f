"""The physics behind emulated servos: the protocol that a plant obeys, and the clock that steps it."""

from __future__ import annotations

import heapq
import importlib
import importlib.util
import math
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any, Final, Protocol, runtime_checkable

from sim2real.errors import UsageError
from sim2real.hardware.truth import Kind, TruthLog

STATE_PERIOD_S: Final = 0.005


class Plant(Protocol):
    """A mechanism driven by servos. The emulator owns it, alone, in one thread.

    A plant need not subclass this. Times are seconds since the emulator's start, angles are rad at the servo's output.
    """

    servo_ids: tuple[int, ...]

    def advance(self, t_s: float) -> None:
        """Integrate up to time `t_s`, in fixed steps of at most 1 ms under the commands given last.

        It is called with k * plant_step_s, k = 1, 2, ...: the plant's own step has to divide `plant_step_s`, and
        `round((t_s - now) / step)` steps bring it there without drift.
        """
        ...

    def command(self, servo_id: int, mode: int, goal: float) -> None:
        """Command a servo from the plant's present time on.

        Args:
            servo_id: One of `servo_ids`.
            mode: 16 (PWM): share of the supply voltage in [-1, 1]; 3 (position): rad; 1 (velocity): rad/s;
                0 (torque off): the goal is 0.
            goal: In the mode's unit.
        """
        ...

    def measure(self, servo_id: int) -> tuple[float, float, float]:
        """Return position (rad, 0 where the encoder counts 0), velocity (rad/s), load (share of the largest)."""
        ...

    def state(self) -> dict[str, float]:
        """Return the true state, always with the same names, for the truth log."""
        ...

    def truth(self) -> dict[str, Any]:
        """Return the true parameters, for the truth log's header: what an identification should find."""
        ...


@runtime_checkable
class ConfigurablePlant(Plant, Protocol):
    """A plant that wants to know how its servos' position controllers are set."""

    def configure(self, servo_id: int, p_gain: int, d_gain: int, profile_velocity_rad_s: float) -> None:
        """Set a servo's position controller from the plant's present time on.

        It is called for every servo before time goes on from 0, with the power-up values, and when one of them changes:
        by a write, at the time that it is complete, or by a reboot.

        Args:
            servo_id: One of `servo_ids`.
            p_gain: Position P Gain, in the register's counts.
            d_gain: Position D Gain, in the register's counts.
            profile_velocity_rad_s: Speed at which the setpoint follows the goal; inf: it is the goal.
        """
        ...


class PlantClock:
    """Steps a plant on a fixed grid, applies commands at grid points, and remembers what could be measured.

    The plant is stepped lazily, and never past the time asked for: nothing that arrives later can find itself in the
    plant's past.

    Args:
        plant: The mechanism; must be at time 0.
        step_ns: Spacing of the grid.
        start_ns: Time of the grid's first point, CLOCK_MONOTONIC.
        history_ns: How far back `sample` must reach from the newest grid point.
        truth: Where effects and states are logged.
    """

    def __init__(self, plant: Plant, step_ns: int, start_ns: int, history_ns: int, truth: TruthLog) -> None:
        self._plant = plant
        self._step_ns = step_ns
        self._start_ns = start_ns
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
        target = (t_ns - self._start_ns) // self._step_ns
        while self._index < target:
            while self._effects and self._effects[0][0] <= self._index:
                self._apply()
            self._index += 1
            self._plant.advance(self._index * self._step_ns * 1e-9)
            self._remember()

    def configure(self, servo_id: int, p_gain: int, d_gain: int, profile_velocity_rad_s: float) -> None:
        """Set a servo's position controller now, if the plant wants to know."""
        if isinstance(self._plant, ConfigurablePlant):
            self._plant.configure(servo_id, p_gain, d_gain, profile_velocity_rad_s)

    def schedule(self, t_ns: int, t_host_ns: int, servo_id: int, mode: int, goal: float) -> None:
        """Plan a command for the grid point nearest to `t_ns`; commands of one point apply in the order given."""
        index = max(round((t_ns - self._start_ns) / self._step_ns), self._index)
        self._sequence += 1
        heapq.heappush(self._effects, (index, self._sequence, t_ns, t_host_ns, servo_id, mode, goal))

    def cancel(self, servo_id: int) -> None:
        """Drop the commands of a servo that have not taken effect yet."""
        self._effects = [effect for effect in self._effects if effect[4] != servo_id]
        heapq.heapify(self._effects)

    def sample(self, servo_id: int, t_ns: int) -> tuple[float, float, float]:
        """Return position, velocity and load at a time at or before the time advanced to.

        Linear between grid points; after the newest one the position is carried on by its velocity.
        """
        place = max(0.0, (t_ns - self._start_ns) / self._step_ns)
        before = min(int(place), self._index)
        before = max(before, self._index - self._depth + 2)
        position_rad, velocity_rad_s, load = self._history[before % self._depth][servo_id]
        share = max(0.0, place - before)
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
        t_ns = self._start_ns + self._index * self._step_ns
        self._plant.command(servo_id, mode, goal)
        self._truth.write(Kind.EFFECT, servo_id, t_host_ns, t_ns, t_ns, t_ns - planned_ns, (mode, goal))

    def _remember(self) -> None:
        plant = self._plant
        self._history[self._index % self._depth] = {i: plant.measure(i) for i in plant.servo_ids}
        if self._index % self._state_stride == 0:
            t_ns = self._start_ns + self._index * self._step_ns
            self._truth.write(Kind.STATE, 0, 0, t_ns, t_ns, 0, tuple(plant.state().values()))


def load_plant(spec: str, arguments: Mapping[str, Any] | None = None) -> Plant:
    """Make the plant that a command line names.

    Args:
        spec: `package.module:Name` or `path/to/file.py:Name`; calling `Name` gives the plant.
        arguments: Keyword arguments of that call.

    Raises:
        UsageError: The module, the file or the name does not exist.
    """
    place, _, name = spec.rpartition(":")
    if not place or not name:
        raise UsageError(f"plant {spec!r} is not of the form MODULE_OR_FILE:NAME", hint="e.g. my_robot/plant.py:Plant")
    module = _load_module(place)
    factory: Callable[..., Plant] | None = getattr(module, name, None)
    if not callable(factory):
        available = [key for key, value in vars(module).items() if callable(value) and not key.startswith("_")]
        raise UsageError(f"{place} has no callable {name!r}. Available: {available}")
    return factory(**(arguments or {}))


def _load_module(place: str) -> ModuleType:
    path = Path(place)
    if path.suffix == ".py":
        module_spec = importlib.util.spec_from_file_location(f"_sim2real_plant_{path.stem}", path)
        if not path.is_file() or module_spec is None or module_spec.loader is None:
            raise UsageError(f"there is no plant file {path}")
        module = importlib.util.module_from_spec(module_spec)
        sys.modules[module.__name__] = module  # dataclasses look their own module up there
        module_spec.loader.exec_module(module)
        return module
    try:
        return importlib.import_module(place)
    except ModuleNotFoundError as error:
        raise UsageError(
            f"plant module {place!r} cannot be imported: {error}", hint="a file's path must end in .py"
        ) from error
