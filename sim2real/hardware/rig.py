"""A rig: servos on a bus behind the safety gate, and everything that makes them stop."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from typing import Self

import numpy as np

from sim2real.errors import HardwareLost, Sim2RealError
from sim2real.hardware.bus import BusConfig, ServoBus, StateReading
from sim2real.hardware.gate import GateConfig, SafetyGate
from sim2real.hardware.registers import OperatingMode


class ServoRig:
    """Servos in PWM mode, commanded in volts.

    Three things stop them: every way out of this context (torque off); the servos' own watchdog when this process dies
    or hangs; and a watchdog here when commands stop coming while measurements, which feed the servos' one, go on.

    Args:
        bus: Port and limits of the bus.
        gate: Limits of the commands [V].
        ids: The servos.
        supply_v: Voltage of a motor at full PWM [V].

    Raises:
        HardwareLost: The port cannot be opened or a servo does not answer.
    """

    def __init__(self, bus: BusConfig, gate: GateConfig, ids: Sequence[int], supply_v: float) -> None:
        self.gate = SafetyGate(gate)
        self._supply_v = supply_v
        self._ids = tuple(ids)
        self._speed_rad_s: np.ndarray | None = None
        self._commanded_s: float | None = None
        self._lock = threading.Lock()
        self._done = threading.Event()
        self._failure: Sim2RealError | None = None
        self.timeouts = 0
        self.bus = ServoBus(bus)
        try:
            self.bus.handshake(dict.fromkeys(self._ids))
            self.bus.setup(OperatingMode.PWM)
        except BaseException:
            self.bus.close()
            raise

    def __enter__(self) -> Self:
        """Return the rig, with torque off."""
        return self

    def __exit__(self, *exception: object) -> None:
        """Take the torque off and close the port."""
        self.close()

    def start(self) -> None:
        """Switch the torque on, with zero voltage, and start watching the age of commands."""
        self._done.set()
        self._done = threading.Event()  # a watcher that has not noticed yet that it is over must not go on
        self.gate.reset()
        self._commanded_s = self._speed_rad_s = self._failure = None
        self.bus.torque(True)
        threading.Thread(target=self._watch, args=(self._done,), name="sim2real:watchdog", daemon=True).start()

    def stop(self) -> None:
        """Switch the torque off; the rig can be started again."""
        self._done.set()
        self.bus.torque(False)

    def stop_quietly(self) -> None:
        """Switch the torque off on a way out that has an error of its own to report; never raises."""
        self._done.set()
        self.bus.make_safe()

    def close(self) -> None:
        """Make safe and close the port; never raises."""
        self._done.set()
        self.bus.close()

    def measure(self) -> StateReading:
        """Read angles [rad] and velocities [rad/s] of all servos."""
        self._check()
        reading = self.bus.read_state(self._ids)
        self._speed_rad_s = reading.velocity_rad_s
        return reading

    def command(self, voltage: np.ndarray, age_s: float, now_s: float) -> np.ndarray:
        """Send voltages through the gate and return what was sent.

        Args:
            voltage: Shape ``(n,)`` [V].
            age_s: How long ago they were decided [s].
            now_s: A monotonic time, for the slew limit [s].

        Raises:
            SafetyStop: The gate refused.
            HardwareLost: The bus is silent.
        """
        self._check()
        with self._lock:
            allowed = self.gate.apply(voltage, age_s, now_s, self._speed_rad_s)
            self._send(allowed)
            self._commanded_s = time.monotonic()
        return allowed

    def wait_until_still(self, timeout_s: float, speed_rad_s: float = 0.05, for_s: float = 0.5) -> StateReading:
        """Wait, with torque off, until nothing moves any more.

        Raises:
            HardwareLost: It still moves after ``timeout_s``.
        """
        end = time.monotonic() + timeout_s
        still_since: float | None = None
        while True:
            reading = self.measure()
            now = time.monotonic()
            if np.max(np.abs(reading.velocity_rad_s)) > speed_rad_s:
                still_since = None
            else:
                still_since = now if still_since is None else still_since
                if now - still_since >= for_s:
                    return reading
            if now > end:
                raise HardwareLost(
                    f"the robot still moves after {timeout_s:g} s with torque off",
                    hint="hold it still, or allow longer with --settle-s",
                )
            time.sleep(0.02)

    def _send(self, voltage: np.ndarray) -> None:
        self.bus.write_goal_pwm({i: float(v) / self._supply_v for i, v in zip(self._ids, voltage, strict=True)})

    def _check(self) -> None:
        if self._failure is not None:
            raise self._failure

    def _watch(self, done: threading.Event) -> None:
        """Send zero while no command has come yet, and when the last one is too old: its loop may hang."""
        timeout_s = self.gate.config.command_timeout_s
        period_s = min(timeout_s, self.bus.config.watchdog_s or timeout_s) / 5
        while not done.is_set():
            with self._lock:
                if done.is_set():
                    return
                waiting = self._commanded_s is None  # the graph starts up: keeps the servos' own watchdog quiet
                late = not waiting and time.monotonic() - (self._commanded_s or 0.0) > timeout_s
                if waiting or late:
                    try:
                        self._send(np.zeros(len(self._ids)))
                    except Sim2RealError as error:
                        self._failure = error
                        return
                if late:
                    self.timeouts += 1
                    self._commanded_s = time.monotonic()
            done.wait(period_s)
