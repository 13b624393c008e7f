"""A rig: servos on a bus behind the safety gate, and everything that makes them stop."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from typing import Final, Self

import numpy as np

from sim2real.errors import HardwareLost, Sim2RealError
from sim2real.hardware.dynamixel.bus import BusConfig, ServoBus, StateReading
from sim2real.hardware.dynamixel.drive import Drive
from sim2real.hardware.gate import GateConfig, SafetyGate
from sim2real.hardware.plausibility import Plausibility

_CHECK_PERIOD_S: Final = 0.5


class ServoRig:
    """Servos behind a safety gate, commanded in the unit of their drive [V or rad].

    Three things stop them: every way out of this context (torque off); the guardian, a process of its own, when this
    one dies or hangs; and a watchdog here when commands stop coming while measurements, which show the guardian and the
    servos that this process lives, go on. That one sends what the gate makes of a stale command: zero, or the last one
    once more.

    Args:
        bus: Port and limits of the bus.
        gate: Limits of the commands, in the drive's unit.
        ids: The servos.
        drive: What they are driven with.

    Raises:
        UsageError: Gate and drive do not fit together.
        HardwareLost: The port cannot be opened, a servo does not answer, or does not keep the drive's settings.
    """

    def __init__(self, bus: BusConfig, gate: GateConfig, ids: Sequence[int], drive: Drive) -> None:
        drive.check(gate, ids)
        self.gate = SafetyGate(gate)
        self._plausibility = Plausibility(gate)
        self._sent: np.ndarray | None = None
        self._drive = drive
        self.ids = tuple(ids)
        self._speed_rad_s: np.ndarray | None = None
        self._checked_s = 0.0
        self._commanded_s: float | None = None
        self._lock = threading.Lock()
        self._done = threading.Event()
        self._failure: Sim2RealError | None = None
        self.timeouts = 0
        self.bus = ServoBus(bus)
        try:
            self.bus.handshake(dict.fromkeys(self.ids))
            self.bus.setup(drive.mode)
            drive.prepare(self.bus, gate)
        except BaseException:
            self.bus.close()
            raise

    def __enter__(self) -> Self:
        """Return the rig, with torque off."""
        return self

    def __exit__(self, *exception: object) -> None:
        """Take the torque off and close the port."""
        self.close()

    @property
    def torque_withheld(self) -> bool:
        """Whether this is a dry run; see `withhold_torque`."""
        return self.bus.torque_withheld

    def withhold_torque(self) -> None:
        """Move nothing from now on, for a dry run: all goes on as it would, but no torque and no goal is ever sent.

        Commands pass the gate, and `command` returns what would have been sent.

        Raises:
            UsageError: Torque is on.
        """
        self.bus.withhold_torque()

    @property
    def suspects(self) -> list[str]:
        """What was odd about the measurements since `start`, but not sure enough to stop."""
        return self._plausibility.suspects

    def start(self) -> None:
        """Switch the torque on, at rest, and start watching the age of commands."""
        self._done.set()
        self._done = threading.Event()  # a watcher that has not noticed yet that it is over must not go on
        self._commanded_s = self._speed_rad_s = self._failure = None
        self._drive.prepare(self.bus, self.gate.config)  # again: a servo may have been rebooted, to clear an error
        self.bus.torque(True)
        self.gate.reset(self._drive.rest(self.bus))
        self._plausibility.reset()
        self._sent = self.gate.fallback
        threading.Thread(target=self._watch, args=(self._done,), name="sim2real:watchdog", daemon=True).start()

    def stop(self) -> None:
        """Switch the torque off; the rig can be started again."""
        self._done.set()
        self._sent = None
        self.bus.torque(False)

    def stop_quietly(self) -> None:
        """Switch the torque off on a way out that has an error of its own to report; never raises."""
        self._done.set()
        self._sent = None
        self.bus.make_safe()

    def close(self) -> None:
        """Make safe and close the port; never raises."""
        self._done.set()
        self.bus.close()

    def measure(self) -> StateReading:
        """Read angles [rad], from the drive's zero, and velocities [rad/s] of all servos.

        Raises:
            SafetyStop: A servo has stopped itself, or what it measures cannot be true.
            HardwareLost: The bus is silent.
        """
        self._check()
        self._supervise()
        sent = self._sent
        reading = self._drive.reading(self.bus.read_state(self.ids))
        position, asked = reading.position_rad, reading.transaction
        effort = np.zeros(len(self.ids)) if sent is None or self.torque_withheld else self._drive.effort(sent, position)
        self._plausibility.check(position, 1e-9 * asked.t_sent_ns, 1e-9 * asked.late_ns, effort)
        self._speed_rad_s = reading.velocity_rad_s
        return reading

    def command(self, command: np.ndarray, age_s: float, now_s: float) -> np.ndarray:
        """Send a command through the gate and return what was sent.

        Args:
            command: Shape ``(n,)`` [V or rad].
            age_s: How long ago it was decided [s].
            now_s: A monotonic time, for the slew limit [s].

        Raises:
            SafetyStop: The gate refused, or a servo has stopped itself.
            HardwareLost: The bus is silent.
        """
        self._check()
        with self._lock:
            allowed = self.gate.apply(command, age_s, now_s, self._speed_rad_s)
            self._drive.send(self.bus, allowed)
            self._sent = allowed
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

    def _check(self) -> None:
        if self._failure is not None:
            raise self._failure

    def _supervise(self) -> None:
        """Look every now and then for servos whose watchdog has tripped; one alone says so when it refuses a goal.

        Hardware errors need no look: every answer that `measure` gets tells of them.
        """
        now_s = time.monotonic()
        if len(self.ids) > 1 and now_s - self._checked_s > _CHECK_PERIOD_S:
            # Before the read of the state, not after: a measurement should not wait. For three servos at 1 Mbaud it is
            # 53 bytes, 0.53 ms, a thousandth of the bus' time. With the emulator it took 0.74 ms, a state 1.06 ms.
            self.bus.check()
            self._checked_s = now_s

    def _watch(self, done: threading.Event) -> None:
        """Send what is safe while no command has come yet, and when the last one is too old: its loop may hang."""
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
                        fallback = self.gate.fallback
                        self._drive.send(self.bus, fallback)
                        self._sent = fallback
                    except Sim2RealError as error:
                        self._failure = error
                        return
                if late:
                    self.timeouts += 1
                    self._commanded_s = time.monotonic()
            done.wait(period_s)
