"""A rig: a device behind the safety gate, with watchdogs that stop its motors."""

from __future__ import annotations

import logging
import threading
from array import array
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Final, Self

import numpy as np

from sim2real.errors import HardwareLost, SafetyStop, Sim2RealError, UsageError
from sim2real.hardware.device import Device, Following, Reading, Transaction
from sim2real.hardware.joint import Joint, Mounting
from sim2real.hardware.safety.following import FollowingCheck
from sim2real.hardware.safety.gate import GateConfig, SafetyGate
from sim2real.hardware.safety.plausibility import Plausibility, require_parts

_LOGGER = logging.getLogger(__name__)
_CHECK_PERIOD_S: Final = 0.5
_STOP_WAIT_S: Final = 2.0
"""Longest wait of `Rig.stop` for another thread that sends a command or switches the torque on [s]."""
_STILL_RAD_S: Final = 0.05
"""A joint below this speed is at rest [rad/s]."""
_FADE: Final = 0.4
"""Share of a soft stop's time in which commands fade; then the robot comes to rest."""


@dataclass(frozen=True)
class BusUse:
    """Times of the transactions of one kind, in their order.

    Attributes:
        transfer_us: From getting the bus to having the answer, retries included [us].
        wait_us: Time of waiting for another thread to release the bus [us].
    """

    transfer_us: array[int] = field(default_factory=lambda: array("q"))
    wait_us: array[int] = field(default_factory=lambda: array("q"))

    def add(self, transaction: Transaction) -> None:
        """Append the times of a transaction."""
        self.transfer_us.append(transaction.transfer_ns // 1000)
        self.wait_us.append(transaction.lock_wait_ns // 1000)


class Rig:
    """A device behind a safety gate, commanded in the device's unit. The constructor opens it, with torque off.

    Commands, limits and readings are those of the joints: a positive voltage or load pushes towards larger angles of
    the joint. Only the device has values of the motors.

    Three mechanisms stop the motors. Leaving the ``with`` block takes the torque off. The guardian does so when this
    process dies or hangs. A watchdog thread replaces a stale command, by zero or the last command, when commands stop
    while measurements go on; an error in this thread makes the motors safe, and the next call raises it.

    `start`, `stop`, `command` and the watchdog share one lock: after `stop` nothing is sent.

    Args:
        device: The device, not opened yet.
        gate: Limits of the commands, in the device's unit.
        joints: The mounting of each motor's joint; none: joints have the motors' angles and commands.

    Attributes:
        measuring: Use of the bus by `measure` since `start`.
        commanding: Use of the bus by `command` since `start`.
        torque_withheld: Whether this is a dry run; see `withhold_torque`.
        following: How the joints follow their commands, which `measure` checks; None: not known, or not checked.

    Raises:
        UsageError: Gate, joints and device do not fit together.
        HardwareLost: The device cannot be opened, or a motor does not answer.
    """

    def __init__(self, device: Device, gate: GateConfig, joints: Sequence[Joint] = ()) -> None:
        kind = device.commanded
        if gate.stale != kind.stale:
            raise UsageError(
                f"gate of {gate.node!r}: stale = {gate.stale!r} is not safe with {kind.name}",
                hint=f"stale = {kind.stale!r} is",
            )
        self._mounting = Mounting(joints, device)
        self.device = device
        gate = gate if gate.joints else replace(gate, joints=device.motors)
        self.gate = SafetyGate(gate)
        self._plausibility = Plausibility(gate)
        self.following: Following | None = None
        self._follow_check: FollowingCheck | None = None
        # The last command, when it was sent, and the last measurement; `start` forgets them.
        self._sent: np.ndarray | None = None
        self._commanded_s: float | None = None
        self._speed_rad_s: np.ndarray | None = None
        self._position_rad: np.ndarray | None = None
        self._sampled_s: float | None = None
        self._tick: int | None = None
        self._is_first = False  # whether the next command is the first of a new sender
        self._checked_s = 0.0
        # A soft stop: when it began, and the last command before it.
        self._eased_s: float | None = None
        self._before_stop: np.ndarray | None = None
        self._lock = threading.Lock()
        self._done = threading.Event()
        self._on = False  # whether commands may be sent
        self.torque_withheld = False
        self._failure: Sim2RealError | None = None
        self.timeouts = 0
        self.measuring, self.commanding = BusUse(), BusUse()
        # Open the device, and refuse a gate beyond its reach.
        device.open()
        self.clock = device.clock
        try:
            self._require_reach()
            following, gear = device.following(), self._mounting.gear
            if following is not None and following.most_nm is None:
                following = replace(following, limit=following.limit / gear, speed_rad_s=following.speed_rad_s / gear)
            self.follow(following)
        except BaseException:
            device.close()
            raise

    def __enter__(self) -> Self:
        """Return the rig, with torque off."""
        return self

    def __exit__(self, *exception: object) -> None:
        """Take the torque off and close the device."""
        self.close()

    def withhold_torque(self) -> None:
        """Begin a dry run: until the rig is closed, the device is measured, but neither enabled nor commanded.

        All else happens as usual: `command` returns the output of the gate, and makes a measurement instead of sending,
        so that the bus is about as busy.

        Raises:
            UsageError: Torque is on.
        """
        if self._on:
            raise UsageError("torque cannot be withheld: it is on", hint="call withhold_torque before start")
        self.torque_withheld = True

    def start(self) -> None:
        """Switch the torque on, with the robot at rest, and start the watchdog; if this raises, torque is off."""
        with self._lock:
            # A new event for the new watchdog: an old watchdog that still runs must end at its own event.
            self._done.set()
            self._done = threading.Event()
            self._commanded_s = self._speed_rad_s = self._failure = self._sampled_s = self._eased_s = None
            self._tick = self._position_rad = None
            self.measuring, self.commanding = BusUse(), BusUse()
            self._require_reach()
            try:
                # The slew limit starts from the command that the motors follow at rest.
                self.gate.reset(self._begin_at_rest())
                self._plausibility.reset()
                self._sent = self.gate.fallback
                self._follow_check = None
                if self.following is not None and not self.torque_withheld:
                    name = self.gate.config.joint
                    self._follow_check = FollowingCheck(self.following, self._sent, self._now_s(), name)
                self._is_first = True
                self._on = True
                if not self.torque_withheld:
                    self._start_watchdog(self._done)
            except BaseException as error:
                self._on = False
                self._done.set()
                try:
                    self.device.disable()
                except BaseException as then:
                    self.device.make_safe()
                    error.add_note(f"then: {then}")
                raise

    def stop(self) -> None:
        """Switch the torque off; the rig can be started again.

        Raises:
            HardwareLost: A motor does not confirm; or a command hangs, and the motors were made safe.
        """
        self._done.set()
        # Let a command that is being sent finish; none follows.
        if not self._lock.acquire(timeout=_STOP_WAIT_S):
            self.stop_quietly()
            raise HardwareLost(
                f"a command has not returned for {_STOP_WAIT_S:g} s: the motors were made safe meanwhile",
                hint="open the device again",
            )
        try:
            self._on, self._sent = False, None
            if not self.torque_withheld:
                self.device.disable()
        finally:
            self._lock.release()

    @contextmanager
    def running(self) -> Iterator[None]:
        """Keep the torque on for a block, and off afterwards; a failure to stop does not hide the block's error."""
        self.start()
        try:
            yield
        except BaseException:
            self.stop_quietly()
            raise
        self.stop()

    def stop_quietly(self) -> None:
        """Switch the torque off while another error is being raised; takes no lock, never raises."""
        self._done.set()
        self._on, self._sent = False, None
        self.device.make_safe()

    def close(self) -> None:
        """Make safe and close the device; takes no lock, never raises."""
        self._done.set()
        self._on = False
        self.device.close()

    def measure(self) -> Reading:
        """Read positions, velocities and loads of all joints.

        Raises:
            SafetyStop: A motor has stopped itself, or a measurement is not plausible.
            HardwareLost: The device is silent.
        """
        self._require_no_failure()
        # Twice a second, look for motors that stopped without an error in their answers. Do so before the state is
        # read,         # so that the measurement does not wait.
        if (now_s := self._now_s()) - self._checked_s > _CHECK_PERIOD_S:
            self.device.check()
            self._checked_s = now_s
        # Remember the last command before the reading: it acted while the sample was taken.
        sent = self._sent
        measured = self.device.measure()
        reading, transaction = self._mounting.reading(measured), measured.transaction
        self.measuring.add(transaction)
        # Do not check the same sample twice.
        if measured.tick is not None and measured.tick == self._tick:
            return reading
        self._tick = measured.tick
        require_parts(measured.parts, self.device.parts)
        pushed = np.zeros(len(measured.position_rad), bool)
        if sent is not None and not self.torque_withheld:
            pushed = self.gate.config.pushes(sent)
        sampled_s, late_s = 1e-9 * transaction.t_sent_ns, 1e-9 * transaction.late_ns
        self._plausibility.check(reading.position_rad, sampled_s, late_s, pushed)
        self._speed_rad_s, self._sampled_s = reading.velocity_rad_s, sampled_s
        self._position_rad = reading.position_rad
        if self._follow_check is not None and self._on:
            self._follow_check.check(reading.position_rad, reading.velocity_rad_s, reading.load, sampled_s, late_s)
        return reading

    def follow(self, following: Following | None) -> None:
        """Check from the next `start` on whether the joints follow as an identified model predicts; see `following`.

        A limit that the user has set replaces the model's limit; an infinite limit ends the check.
        """
        limit = self.gate.config.following_rad
        if following is not None and following.unit == "rad" and limit is not None:
            following = replace(following, limit=limit, source="following_rad")
        self.following = None if limit is not None and np.all(np.isinf(limit)) else following

    def hand_over(self) -> None:
        """Treat the next command as the first of a new sender: it must be near the measured pose, see `command`."""
        self._is_first = True

    def command(self, command: np.ndarray, age_s: float, now_s: float) -> np.ndarray:
        """Send a command through the gate and return the gate's output.

        Args:
            command: Shape ``(n,)`` or ``(n, k)``, of the joints [the device's unit].
            age_s: Time since the policy computed it [s].
            now_s: A monotonic time, for the slew limit [s].

        Raises:
            SafetyStop: The gate stopped the robot, a motor has stopped itself, or the first goals since `start` or
                `hand_over` are farther than ``first_step_rad`` away from the measured pose.
            HardwareLost: The device is silent.
        """
        with self._lock:
            self._require_no_failure()
            if not self._on:
                raise SafetyStop("no command is sent: the torque is off", hint="start the rig first")
            self._require_near(np.asarray(command, np.float64))
            allowed = self.gate.apply(self._softened(command), age_s, now_s, self._speed_rad_s)
            if self.torque_withheld:
                self.commanding.add(self.device.measure().transaction)
                self._sent = allowed
            else:
                self.commanding.add(self._send(allowed))
            self._commanded_s = self._now_s()
        return allowed

    def require_fresh(self) -> None:
        """Raise SafetyStop if the newest measurement is older than ``max_sample_age_s``."""
        now_s, max_age_s = self._now_s(), self.gate.config.max_sample_age_s
        age_s = 0.0 if self._sampled_s is None else now_s - self._sampled_s  # before the first, the robot is at rest
        if age_s > max_age_s:
            # If this process was stopped for a while, report that the guardian has acted.
            self.device.require_watching()
            raise SafetyStop(
                f"node {self.gate.config.node!r} stopped: the newest measurement is {age_s:.3g} s old, "
                f"{max_age_s:g} s are allowed",
                hint="is this computer too busy, or the sensor held up? max_sample_age_s sets the limit",
            )

    def ease(self) -> None:
        """Begin a soft stop: within ``stop_s``, commands fade to the replacement of a stale command.

        Voltages fade to zero, goals stay, and legs sink, as their gains fade to damping.
        """
        self._eased_s, self._before_stop = self._now_s(), self._sent

    @property
    def eased(self) -> bool:
        """Whether a soft stop is over: all joints are still, or ``stop_s`` has passed."""
        if self._eased_s is None:
            return False
        passed_s = self._now_s() - self._eased_s
        config = self.gate.config
        if config.has_columns:
            faded = passed_s > _FADE * config.stop_s
        else:
            faded = config.holds or self._sent is None or not np.any(self._sent)
        still = self._speed_rad_s is not None and bool(np.all(np.abs(self._speed_rad_s) < _STILL_RAD_S))
        return passed_s > self.gate.config.stop_s or (faded and still)

    def _softened(self, command: np.ndarray) -> np.ndarray:
        if self._eased_s is None or self._before_stop is None:
            return command
        # A held goal is the last one; a fading voltage is a share of the agent's newest command.
        config = self.gate.config
        last = self._before_stop if config.holds else np.asarray(command)
        left = max(0.0, 1.0 - (self._now_s() - self._eased_s) / (_FADE * config.stop_s))
        rest = config.at_rest(last)
        return rest + left * (last - rest)

    def wait_until_still(self, timeout_s: float, speed_rad_s: float = _STILL_RAD_S, for_s: float = 0.5) -> Reading:
        """Wait, with torque off, until all joints are still; raise HardwareLost if they move after ``timeout_s``.

        Args:
            timeout_s: Longest time to wait [s].
            speed_rad_s: A motor this slow or slower counts as still [rad/s].
            for_s: Time for which all must be still without a break [s].
        """
        end = self._now_s() + timeout_s
        still_since: float | None = None
        while True:
            reading = self.measure()
            now = self._now_s()
            # Restart the time of stillness at every motion.
            if np.max(np.abs(reading.velocity_rad_s)) > speed_rad_s:
                still_since = None
            else:
                still_since = now if still_since is None else still_since
                if now - still_since >= for_s:
                    return reading
            if now > end:
                raise HardwareLost(
                    f"the robot still moves after {timeout_s:g} s with torque off",
                    hint="hold it still; deploy waits longer with --settle-s",
                )
            self.clock.sleep(0.02)

    def _begin_at_rest(self) -> np.ndarray:
        """Switch the torque on, and return the command that the joints follow; in a dry run, the command at rest."""
        if not self.torque_withheld:
            return self._mounting.to_joints(self.device.enable())
        units, here = self.device.commanded.units, self._mounting.reading(self.device.measure()).position_rad
        columns = np.stack([here if unit == "rad" else np.zeros_like(here) for unit in units], axis=-1)
        return self.gate.config.at_rest(columns if self.gate.config.has_columns else columns[:, 0])

    def _require_near(self, command: np.ndarray) -> None:
        """Refuse first goals of a sender that are far away from the measured pose."""
        if not self._is_first:
            return
        self._is_first = False
        kinds = self.device.commanded.columns or (self.device.commanded,)
        goals = [i for i, kind in enumerate(kinds) if kind.unit == "rad" and kind.stale == "hold"]
        position = self._sent if self._position_rad is None else self._position_rad
        if not goals or position is None or self.torque_withheld:
            return
        wanted, here = (values[:, goals[0]] if values.ndim > 1 else values for values in (command, position))
        away = np.abs(wanted - here)
        most = np.broadcast_to(np.asarray(self.gate.config.first_step_rad), away.shape)
        if np.any(away > most):  # the gate refuses NaN
            worst = int(np.nanargmax(away - most))
            raise SafetyStop(
                f"the first command puts {self.gate.config.joint(worst)} at {wanted[worst]:.3g} rad, measured are "
                f"{here[worst]:.3g} rad: {away[worst]:.2g} rad away, {most[worst]:.2g} rad are allowed",
                hint="bring the robot to the pose in which the policy starts; first_step_rad sets the limit",
            )

    def _require_no_failure(self) -> None:
        if self._failure is not None:
            raise self._failure

    def _require_reach(self) -> None:
        """Refuse gate limits beyond the reach of the motors, or for another number of motors."""
        gate, (low, high) = self.gate.config, self._mounting.limits(*self.device.reach())
        for limits in gate.range:
            if limits.ndim > gate.has_columns and limits.shape != low.shape:
                count = len(self.device.motors)
                raise UsageError(f"gate of {gate.node!r}: limits for {len(limits)} motors, but there are {count}")
        if np.any(gate.range[0] < low) or np.any(gate.range[1] > high):
            raise UsageError(
                f"gate of {gate.node!r}: limit {gate.limit} exceeds the reach of the motors, "
                f"{np.round(low, 3).tolist()} to {np.round(high, 3).tolist()} {', '.join(self.device.commanded.units)}",
                hint="narrow the limit, or set the joints' zeros and the motors' own limits",
            )

    def _start_watchdog(self, done: threading.Event) -> None:
        timeout_s = self.gate.config.command_timeout_s
        # Look five times in each timeout of the motors' own watchdog.
        period_s = min(timeout_s, self.device.silence_s or timeout_s) / 5
        self.clock.repeat(lambda: self._watch(done), period_s, done, "sim2real:watchdog")

    def _watch(self, done: threading.Event) -> None:
        """Send the gate's fallback before the first command, and when the last command is too old: its loop may hang.

        Never raises: an error makes the motors safe and is printed; the control loop's next call raises it.

        Args:
            done: The event of this watchdog; after a stop and a new start, the rig has another event.
        """
        try:
            with self._lock:
                if self._on and not done.is_set():
                    self._replace_stale_command()
        except BaseException as error:
            if isinstance(error, Sim2RealError):
                failure = error
            else:
                failure = SafetyStop(f"the watchdog of stale commands failed: {type(error).__name__}: {error}")
                failure.__cause__ = error
            self._failure, self._on = failure, False
            done.set()
            self.device.make_safe()
            _LOGGER.error("the motors were made safe: %s", failure, exc_info=error)

    def _replace_stale_command(self) -> None:
        # Before the first command the graph starts up, and the motors' own watchdog must not trip.
        waiting = self._commanded_s is None
        late = not waiting and self._now_s() - (self._commanded_s or 0.0) > self.gate.config.command_timeout_s
        if waiting or late:
            self._send(self.gate.fallback)
        if late:
            self.timeouts += 1
            self._commanded_s = self._now_s()

    def _send(self, command: np.ndarray) -> Transaction:
        """Send a command of the joints."""
        check = self._follow_check
        if check is not None:
            check.sending(command, self._now_s())
        transaction = self.device.command(self._mounting.to_motors(command))
        if check is not None:
            check.sent(self._now_s())
        self._sent = command
        return transaction

    def _now_s(self) -> float:
        return 1e-9 * self.clock.now_ns()
