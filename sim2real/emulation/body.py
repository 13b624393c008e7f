"""The physics of an emulated robot of Unitree: what a body has to do. Imports no cyclonedds."""

from typing import Final, Protocol

import numpy as np

LAW: Final = ("q", "dq", "kp", "kd", "tau")
"""Columns of a motor's law: its torque is ``tau + kp (q - measured q) + kd (dq - measured dq)``."""


def measured_dtype(motors: int) -> np.dtype:
    """Return the layout of a body's measurement; every entry is a double.

    Its fields have the names and units of ``LowState``: ``q`` [rad], ``dq`` [rad/s] and ``tau_est`` [N m] of each
    motor, ``quaternion`` (w first), ``gyroscope`` [rad/s], ``accelerometer`` [m/s^2], and ``foot_force`` [N].
    """
    sizes = {"q": motors, "dq": motors, "tau_est": motors, "quaternion": 4, "gyroscope": 3, "accelerometer": 3}
    return np.dtype([(name, np.float64, (size,)) for name, size in {**sizes, "foot_force": 4}.items()])


class Body(Protocol):
    """A robot on legs, driven by motors with a law each; used by the emulator alone, in one thread.

    Times count from the emulator's start [s].

    Attributes:
        motors: Number of motors.
        step_s: Time step of the physics [s].
    """

    motors: int
    step_s: float

    def drive(self, law: np.ndarray) -> None:
        """Set the laws of all motors ``(motors, 5)``, columns as in `LAW`, from the body's present time on."""
        ...

    def step(self) -> None:
        """Integrate one time step."""
        ...

    def measure(self) -> np.ndarray:
        """Return a measurement without noise, of `measured_dtype` and shape ``()``."""
        ...

    def state(self) -> dict[str, float]:
        """Return the true state for the truth log, with the same names at every call."""
        ...

    def truth(self) -> dict[str, object]:
        """Return the true parameters, which an identification should find."""
        ...
