"""BAM's models M1 and M6, implemented from their published equations, fitted as BAM fits them.

M. Duclusaud, G. Passault, V. Padois, O. Ly: "Extended Friction Models for the Physics Simulation of Servo Actuators",
arXiv 2410.08650; equations, bounds and integrator as in Rhoban/bam, ``bam/model.py``, ``bam/simulate.py`` (17d9addc).

A motor of ``kt`` and ``R`` under a voltage, with Coulomb and viscous friction (M1), in M6 also with Stribeck,
load-dependent, directional and quadratic terms. As in BAM: 5 ms steps, CMA-ES with restarts, mean absolute error over
whole episodes, a given load, and offset and delay as parameters. Other than BAM, commands are held between samples.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from benches.recorded.search import minimise
from benches.recorded.sets import Recording
from sim2real.types import Array, PyTree

Constants = Mapping[str, float | bool]
"""Load, supply voltage, and kind of a recording."""
STEP_S, GRAVITY = 0.005, 9.80665
POPULATION = 32
_COMMON = {
    "kt": (0.3, 3.0), "R": (0.5, 10.0), "armature": (1e-4, 0.05), "q_offset": (-0.1, 0.1), "command_delay": (0.0, 0.05),
    "friction_base": (0.0, 0.2), "friction_viscous": (0.0, 1.0),
}  # fmt: skip
_SERVO = {"error_gain_ratio": (0.1, 10.0), "max_velocity": (0.5, 50.0)}
"""Feetech's servos: a factor on their firmware's gain, and the speed of their profile."""
_M6 = {
    "friction_stribeck": (0.0, 0.2), "load_friction_motor": (0.0, 0.5), "load_friction_external": (0.0, 0.5),
    "load_friction_motor_stribeck": (0.0, 1.0), "load_friction_external_stribeck": (0.0, 1.0),
    "load_friction_motor_quad": (0.0, 0.01), "load_friction_external_quad": (0.0, 0.01),
    "dtheta_stribeck": (0.1, 1.0), "alpha": (1.0, 10.0),
}  # fmt: skip
_DISK = {"kt": (0.005, 0.2), "R": (1.0, 60.0), "armature": (1e-6, 1e-3), "friction_base": (0.0, 0.005),
         "friction_viscous": (0.0, 0.005), "friction_stribeck": (0.0, 0.005)}  # fmt: skip
"""Bounds for the disk's small motor, which BAM's own do not reach."""
DISK_LOAD = {"mass": 0.0762, "length": 0.0411, "voltage": True}
"""Source: the rig's published simulator, GerbenBeintema/gym-unbalanced-disk."""
ARM_LOAD = {"mass": 0.0, "length": 0.0, "vin": 7.4, "duty_per_rad": 16 * 0.166, "profiled": True}
"""An STS3215 at the gain that the SO-101's software sets, without a load: BAM has none for an arm's joints."""


def bounds(kind: str, constants: Constants) -> dict[str, tuple[float, float]]:
    """Return parameter -> (low, high) of the model ``M1`` or ``M6``."""
    limits = {**_COMMON, **(_M6 if kind == "M6" else {})}
    if constants.get("profiled"):
        limits |= _SERVO
    return {n: (_DISK.get(n, b) if constants.get("voltage") else b) for n, b in limits.items()}


def friction(p: dict[str, Array], motor: Array, load: Array, speed: Array) -> PyTree:
    """Return the largest friction [N m], by M6 if its parameters are present, else by M1.

    Args:
        motor: The motor's torque [N m].
        load: The torque from outside [N m].
        speed: [rad/s].
    """
    base = p["friction_base"] + p["friction_viscous"] * jnp.abs(speed)
    if "friction_stribeck" not in p:
        return base
    rest = jnp.exp(-(jnp.abs(speed / p["dtheta_stribeck"]) ** p["alpha"]))
    gears = jnp.abs(load * p["load_friction_external"] - motor * p["load_friction_motor"])
    stuck = jnp.abs(load * p["load_friction_external_stribeck"] - motor * p["load_friction_motor_stribeck"])
    driving = (jnp.abs(load) < jnp.abs(motor)) * p["load_friction_external_quad"] * load**2
    driven = (jnp.abs(load) > jnp.abs(motor)) * p["load_friction_motor_quad"] * motor**2
    against = jnp.sign(load) != jnp.sign(motor)
    return base + gears + rest * (p["friction_stribeck"] + stuck + against * (driving + driven))


def simulate(
    p: dict[str, Array], constants: Constants, duty_per_rad: Array, start: Array, commands: Array, on: Array
) -> PyTree:
    """Return positions at every step, ``(T,)`` [rad].

    Args:
        constants: ``mass``, ``length``, and ``vin`` or ``voltage``.
        commands: Goals [rad] or voltages, late already, ``(T,)``.
        on: Whether torque is on ``(T,)``.
    """
    mass, length = constants["mass"], constants["length"]
    inertia = mass * length**2 + p["armature"]

    def step(state: PyTree, row: PyTree) -> PyTree:
        (q, speed, setpoint), (command, enabled) = state, row
        if constants.get("voltage"):
            volts = command
        else:
            reach = p["max_velocity"] * STEP_S if "max_velocity" in p else jnp.inf
            setpoint = jnp.clip(command, setpoint - reach, setpoint + reach)
            duty = (setpoint - q) * duty_per_rad * p.get("error_gain_ratio", 1.0)
            volts = constants["vin"] * jnp.clip(duty, -1.0, 1.0)
        # Torques of motor and load; friction stops at most the motion of this step.
        motor = jnp.where(enabled, p["kt"] / p["R"] * (volts - p["kt"] * speed), 0.0)
        load = -mass * GRAVITY * length * jnp.sin(q + p["q_offset"])
        net = motor + load
        stop = inertia / STEP_S * speed + net
        net = net - jnp.sign(stop) * jnp.minimum(jnp.abs(stop), friction(p, motor, load, speed))
        faster = net / inertia
        new = jnp.clip(speed + faster * STEP_S, -100.0, 100.0)
        return (q + new * STEP_S + 0.5 * faster * STEP_S**2, new, setpoint), q

    return jax.lax.scan(step, (start[0], start[1], commands[0]), (commands, on))[1]


class Bench:
    """Recordings of one joint, padded to one length, under the model ``M1`` or ``M6``."""

    def __init__(self, kind: str, recordings: Sequence[Recording]) -> None:
        constants = {
            k: v for k, v in recordings[0].constants.items() if k in ("mass", "length", "vin", "voltage", "profiled")
        }
        self.names, limits = zip(*bounds(kind, constants).items(), strict=True)
        low, high = np.array(limits).T
        count = max(round(float(r.t[-1] - r.t[0]) / STEP_S) + 2 for r in recordings)
        grid = STEP_S * np.arange(count)
        rows = [self._on_grid(r, grid) for r in recordings]
        commands, on, measured, weight = (jnp.asarray(np.stack(x)) for x in zip(*rows, strict=True))
        gains = jnp.array([r.constants.get("duty_per_rad", 0.0) for r in recordings])
        starts = jnp.array([r.start[0] for r in recordings])

        def one(u: Array, gain: Array, start: Array, command: Array, enabled: Array) -> PyTree:
            p = dict(zip(self.names, low + (high - low) * u, strict=True))
            before = jnp.interp(grid - p["command_delay"], grid, command)
            return simulate(p, constants, gain, start, before, enabled)

        def play(u: Array) -> PyTree:
            return jax.vmap(lambda g, s, c, e: one(u, g, s, c, e))(gains, starts, commands, on)

        def loss(u: Array) -> PyTree:
            return jnp.sum(weight * jnp.abs(play(u) - measured)) / jnp.sum(weight)

        self._grid, self._play, self.losses = grid, jax.jit(play), jax.jit(jax.vmap(loss))

    @staticmethod
    def _on_grid(r: Recording, grid: np.ndarray) -> tuple[np.ndarray, ...]:
        t = r.t - r.t[0]
        held = np.clip(np.searchsorted(t, grid + 1e-9, side="right") - 1, 0, len(t) - 1)
        on = np.asarray(r.constants.get("torque_enable", np.ones(len(t), bool)))[held]
        return r.command[held, 0], on, np.interp(grid, t, r.position[:, 0]), (grid <= t[-1]).astype(float)

    def predict(self, u: np.ndarray, recordings: Sequence[Recording]) -> list[np.ndarray]:
        """Return positions at the recordings' stamps, ``(N, 1)`` each."""
        rows = np.asarray(self._play(jnp.asarray(u)))
        return [np.interp(r.t - r.t[0], self._grid, q)[:, None] for r, q in zip(recordings, rows, strict=True)]


def fit(
    kind: str, fitted: Sequence[Recording], budget_s: float, seed: int
) -> tuple[Callable[[Sequence[Recording]], list[np.ndarray]], str]:
    """Fit one joint with ``M1`` or ``M6`` within a budget, compilation included; return its predictor and a summary."""
    deadline = time.process_time() + budget_s
    bench = Bench(kind, fitted)
    middle = np.full(len(bench.names), 0.5)
    many = lambda c: np.asarray(bench.losses(jnp.asarray(c)), np.float64)  # noqa: E731
    u, _, count = minimise(many, middle, deadline, seed, population=POPULATION)
    return lambda recordings: Bench(kind, recordings).predict(u, recordings), f"{count} evaluations"
