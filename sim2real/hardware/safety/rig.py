"""A rig: a device behind the safety gate, and everything that makes its motors stop."""

from __future__ import annotations

import threading
import time
from array import array
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final, Self

import numpy as np

from sim2real.errors import HardwareLost, SafetyStop, Sim2RealError, UsageError
from sim2real.hardware.device import Device, Reading, Transaction
from sim2real.hardware.joint import Joint, Mounting
from sim2real.hardware.safety.gate import GateConfig, SafetyGate
from sim2real.hardware.safety.plausibility import Plausibility
from sim2real.runtime.clock import keep_time

_CHECK_PERIOD_S: Final = 0.5
_STILL_RAD_S: Final = 0.05
"""A joint this slow is at rest."""
_FADE: Final = 0.4
"""Share of a soft stop in which commands fade; the rest is for what they leave to come to rest."""


@dataclass(frozen=True)
class BusUse:
    """How long transactions of one kind took, in their order.

    Attributes:
        transfer_us: From getting the bus to having the answer, retries included [us].
        wait_us: How long each waited before for another's use of the bus [us].
    """

    transfer_us: array[int] = field(default_factory=lambda: array("q"))
    wait_us: array[int] = field(default_factory=lambda: array("q"))

    def add(self, transaction: Transaction) -> None:
        """Note a transaction."""
        self.transfer_us.append(transaction.transfer_ns // 1000)
        self.wait_us.append(transaction.lock_wait_ns // 1000)


class Rig:
    """A device behind a safety gate, commanded in the device's unit; it is opened with the rig, with torque off.

    Whatever is commanded, limited, checked and returned here is on the joints' side: an angle is the joint's, and a
    positive voltage or load pushes towards larger angles of the joint. The device alone has the motors' side.

    Three things stop its motors: every way out of this context (torque off); what watches the device from outside this
    process, when this one dies or hangs; and a watchdog here when commands stop coming while measurements, which show
    that this process lives, go on. That one sends what the gate makes of a stale command: zero, or the last one once
    more.

    Args:
        device: The device, not opened yet.
        gate: Limits of the commands, in the device's unit.
        joints: How each motor's joint is mounted; none: as the device measures and commands it.

    Attributes:
        measuring: The bus's use by `measure` since `start`.
        commanding: The bus's use by `command` since then.

    Raises:
        UsageError: Gate, joints and device do not fit together.
        HardwareLost: The device cannot be opened, or a motor does not answer.
    """

    def __init__(self, device: Device, gate: GateConfig, joints: Sequence[Joint] = ()) -> None:
        _require_stale(gate, device)
        self._mounting = Mounting(joints, device)
        self.device = device
        self.gate = SafetyGate(gate)
        self._plausibility = Plausibility(gate)
        self._sent: np.ndarray | None = None
        self._speed_rad_s: np.ndarray | None = None
        self._checked_s = 0.0
        self._sampled_s: float | None = None
        self._eased_s: float | None = None
        self._commanded_s: float | None = None
        self._lock = threading.Lock()
        self._done = threading.Event()
        self._failure: Sim2RealError | None = None
        self.timeouts = 0
        self.measuring, self.commanding = BusUse(), BusUse()
        device.open()
        try:
            self._require_reach()
        except BaseException:
            device.close()
            raise

    def __enter__(self) -> Self:
        """Return the rig, with torque off."""
        return self

    def __exit__(self, *exception: object) -> None:
        """Take the torque off and close the device."""
        self.close()

    @property
    def torque_withheld(self) -> bool:
        """Whether this is a dry run; see `withhold_torque`."""
        return self.device.torque_withheld

    def withhold_torque(self) -> None:
        """Move nothing from now on, for a dry run: all goes on as it would, but no torque and no goal is ever sent.

        Commands pass the gate, and `command` returns what would have been sent.

        Raises:
            UsageError: Torque is on, or the device does not say that it withholds it.
        """
        self.device.withhold_torque()
        if not self.device.torque_withheld:
            raise UsageError(f"{type(self.device).__name__} cannot do a dry run: it does not withhold its torque")

    @property
    def suspects(self) -> list[str]:
        """What was odd about the measurements since `start`, but not sure enough to stop."""
        return self._plausibility.suspects

    def start(self) -> None:
        """Switch the torque on, at rest, and start watching the age of commands."""
        self._done.set()
        self._done = threading.Event()  # a watcher that has not noticed yet that it is over must not go on
        self._commanded_s = self._speed_rad_s = self._failure = self._sampled_s = self._eased_s = None
        self.measuring, self.commanding = BusUse(), BusUse()
        self._require_reach()
        self.device.enable()
        self.gate.reset(self._mounting.to_joints(self.device.rest()))
        self._plausibility.reset()
        self._sent = self.gate.fallback
        threading.Thread(target=self._watch, args=(self._done,), name="sim2real:watchdog", daemon=True).start()

    def stop(self) -> None:
        """Switch the torque off; the rig can be started again."""
        self._done.set()
        self._sent = None
        self.device.disable()

    def stop_quietly(self) -> None:
        """Switch the torque off on a way out that has an error of its own to report; never raises."""
        self._done.set()
        self._sent = None
        self.device.make_safe()

    def close(self) -> None:
        """Make safe and close the device; never raises."""
        self._done.set()
        self.device.close()

    def measure(self) -> Reading:
        """Read positions, velocities and loads of all joints.

        Raises:
            SafetyStop: A motor has stopped itself, or what it measures cannot be true.
            HardwareLost: The device is silent.
        """
        self._check()
        self._supervise()
        sent = self._sent
        measured = self.device.measure()
        reading, asked = self._mounting.reading(measured), measured.transaction
        self.measuring.add(asked)
        effort = np.zeros(len(measured.position_rad))
        if sent is not None and not self.torque_withheld:
            # Of the motors, whose direction does not matter to what is plausible.
            effort = self.device.effort(self._mounting.to_motors(sent), measured.position_rad)
        self._plausibility.check(reading.position_rad, 1e-9 * asked.t_sent_ns, 1e-9 * asked.late_ns, effort)
        self._speed_rad_s, self._sampled_s = reading.velocity_rad_s, 1e-9 * asked.t_sent_ns
        return reading

    def command(self, command: np.ndarray, age_s: float, now_s: float) -> np.ndarray:
        """Send a command through the gate and return what was sent.

        Args:
            command: Shape ``(n,)``, of the joints [the device's unit].
            age_s: How long ago it was decided [s].
            now_s: A monotonic time, for the slew limit [s].

        Raises:
            SafetyStop: The gate refused, or a motor has stopped itself.
            HardwareLost: The device is silent.
        """
        self._check()
        with self._lock:
            allowed = self.gate.apply(self._softened(command), age_s, now_s, self._speed_rad_s)
            self.commanding.add(self.device.command(self._mounting.to_motors(allowed)))
            self._sent = allowed
            self._commanded_s = time.monotonic()
        return allowed

    def require_fresh(self) -> None:
        """Refuse to go on without a recent measurement.

        Raises:
            SafetyStop: The newest is older than ``max_sample_age_s``, or, of a process that was stopped meanwhile, the
                guardian has taken the torque off: that is the reason then.
        """
        now_s, most_s = time.monotonic(), self.gate.config.max_sample_age_s
        age_s = 0.0 if self._sampled_s is None else now_s - self._sampled_s  # before the first, all is at rest
        if age_s > most_s:
            self.device.require_watching()
            raise SafetyStop(
                f"node {self.gate.config.node!r} stopped: the newest measurement is {age_s:.3g} s old, "
                f"{most_s:g} s are allowed",
                hint="what holds up the sensor? max_sample_age_s sets the limit",
            )

    def ease(self) -> None:
        """Begin a soft stop: from now on commands fade to zero within ``stop_s``, and goals stay where they are."""
        self._eased_s = time.monotonic()

    @property
    def eased(self) -> bool:
        """Whether a soft stop is over: all is still, or ``stop_s`` has passed."""
        if self._eased_s is None:
            return False
        passed_s = time.monotonic() - self._eased_s
        faded = self.gate.config.stale == "hold" or self._sent is None or not np.any(self._sent)
        still = self._speed_rad_s is not None and bool(np.all(np.abs(self._speed_rad_s) < _STILL_RAD_S))
        return passed_s > self.gate.config.stop_s or (faded and still)

    def _softened(self, command: np.ndarray) -> np.ndarray:
        if self._eased_s is None or self._sent is None:
            return command
        if self.gate.config.stale == "hold":
            return self._sent
        left = 1.0 - (time.monotonic() - self._eased_s) / (_FADE * self.gate.config.stop_s)
        return np.asarray(command) * max(0.0, left)

    def wait_until_still(self, timeout_s: float, speed_rad_s: float = _STILL_RAD_S, for_s: float = 0.5) -> Reading:
        """Wait, with torque off, until nothing moves any more.

        Args:
            timeout_s: Longest time to wait [s].
            speed_rad_s: A motor this slow or slower counts as still [rad/s].
            for_s: How long all must be still without a break [s].

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
        """Have the device look every now and then for motors that have stopped without saying so."""
        now_s = time.monotonic()
        if now_s - self._checked_s > _CHECK_PERIOD_S:
            self.device.check()  # before the state is read, not after: a measurement should not wait
            self._checked_s = now_s

    def _require_reach(self) -> None:
        """Refuse gate limits beyond what the motors follow, or for another number of motors."""
        gate, (low, high) = self.gate.config, self._mounting.limits(*self.device.reach())
        for limits in gate.range:
            if limits.ndim and limits.shape != low.shape:
                raise UsageError(f"gate of {gate.node!r}: limits for {limits.size} motors, but there are {low.size}")
        if np.any(gate.range[0] < low) or np.any(gate.range[1] > high):
            raise UsageError(
                f"gate of {gate.node!r}: limit {gate.limit} exceeds what the motors take, "
                f"{np.round(low, 3).tolist()} to {np.round(high, 3).tolist()} {self.device.commanded.unit}",
                hint="narrow the limit, or set the joints' zeros and the motors' own limits",
            )

    def _watch(self, done: threading.Event) -> None:
        """Send what is safe while no command has come yet, and when the last one is too old: its loop may hang."""
        keep_time()
        timeout_s = self.gate.config.command_timeout_s
        period_s = min(timeout_s, self.device.silence_s or timeout_s) / 5
        while not done.is_set():
            with self._lock:
                if done.is_set():
                    return
                waiting = self._commanded_s is None  # the graph starts up: keeps the motors' own watchdog quiet
                late = not waiting and time.monotonic() - (self._commanded_s or 0.0) > timeout_s
                if waiting or late:
                    try:
                        fallback = self.gate.fallback
                        self.device.command(self._mounting.to_motors(fallback))
                        self._sent = fallback
                    except Sim2RealError as error:
                        self._failure = error
                        return
                if late:
                    self.timeouts += 1
                    self._commanded_s = time.monotonic()
            done.wait(period_s)


def _require_stale(gate: GateConfig, device: Device) -> None:
    kind = device.commanded
    if gate.stale != kind.stale:
        raise UsageError(
            f"gate of {gate.node!r}: stale = {gate.stale!r} is not safe with {kind.name}",
            hint=f"stale = {kind.stale!r} is",
        )
