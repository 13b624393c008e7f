"""LeRobot's bus behind a lock, with retries, counts and signs of life; LeRobot itself builds and reads the packets."""

from __future__ import annotations

import threading
import time
from array import array
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Final, TypeVar

import numpy as np

from sim2real.errors import HardwareLost, SafetyStop, UsageError
from sim2real.hardware.bus.port import LinkConfig
from sim2real.hardware.bus.registers import Register
from sim2real.hardware.device import Counters, Transaction
from sim2real.hardware.feetech import registers as reg
from sim2real.hardware.feetech.protocol import PROTOCOL

if TYPE_CHECKING:
    from sim2real.hardware.safety.guardian import Guardian

T = TypeVar("T")
_PRIMITIVES: Final = ("ping", "_read", "_write", "_sync_read")
_BUS: Final = "FeetechMotorsBus"
_MIN_LOSSES: Final = 3
_FORCED_ATTEMPTS: Final = 5


@dataclass(frozen=True)
class LerobotConfig(LinkConfig):
    """Port and time limits; the baud rate is LeRobot's.

    Args:
        max_silence_s: As in `LinkConfig`; LeRobot waits 50 ms for each answer, so few attempts would fit into 0.1 s.
        make: Returns LeRobot's robot on a port, not connected.
    """

    max_silence_s: float = 1.0
    make: Callable[[str], Any] | None = None

    family = "LeRobot"
    baud_rates = reg.BAUD_RATES


class LerobotLink:
    """LeRobot's robot, connected with torque off.

    LeRobot gives up at the first lost answer. Here its instructions are repeated until the bus counts as lost.

    Attributes:
        retries: Repetitions of the last call [1].

    Raises:
        UsageError: The robot has no bus whose packets sim2real can build, so no guardian could take its torque off; or
            it has no calibration.
        HardwareLost: The port cannot be opened, or a motor does not answer.
    """

    form: ClassVar = PROTOCOL
    table: ClassVar = reg.TABLE

    def __init__(self, config: LerobotConfig) -> None:
        if config.make is None:
            raise UsageError("there is no robot of LeRobot to connect")
        self.config, self.closed, self.torque_withheld = config, False, False
        self.guardian: Guardian | None = None
        self.retries = self._transactions = self._lost = self._retried = self._late = self.withheld = 0
        self._late_us = array("i")
        self._sent_ns = 0
        self._lock = threading.RLock()
        self.robot = config.make(config.port)
        self.bus: Any = getattr(self.robot, "bus", None)
        if type(self.bus).__name__ != _BUS:
            raise UsageError(
                f"{type(self.robot).__name__} has no {_BUS}, so no guardian can take its torque off",
                hint="robots of LeRobot with Feetech servos can be driven: so100_follower, so101_follower",
            )
        if not self.robot.calibration:
            raise UsageError(
                f"{self.robot} has no calibration {self.robot.calibration_fpath}",
                hint="lerobot-calibrate writes it; the id of the robot is the file's name",
            )
        # `force` writes and reads once at each attempt: it must not wait for a bus that is lost.
        self._write, self._read = self.bus._write, self.bus._read
        for name in _PRIMITIVES:
            setattr(self.bus, name, self._patient(getattr(self.bus, name)))
        self._connect()

    @property
    def fd(self) -> int:
        """The port's file descriptor."""
        return self.bus.port_handler.ser.fileno()

    @property
    def counters(self) -> Counters:
        """Counts of the transactions since the port was opened."""
        late_s = np.array(self._late_us, np.float64) * 1e-6
        return Counters(self._transactions, self._lost, self._retried, self._late, late_s, self.withheld)

    def call(self, function: Callable[[], T]) -> tuple[T, Transaction]:
        """Return the result of a call of LeRobot's, and the times of its last instruction.

        Raises:
            HardwareLost: The bus is closed, or does not answer.
            SafetyStop: A servo reports an alarm; the guardian has taken over, or has died.
        """
        requested_ns = time.monotonic_ns()
        with self._lock:
            began_ns, lost = time.monotonic_ns(), self._lost
            if self.closed:
                raise HardwareLost(f"the bus on {self.config.port} is closed")
            if self.guardian is not None:
                self.guardian.beat()
            self._sent_ns = began_ns
            try:
                result = function()
            except RuntimeError as error:
                raise SafetyStop(f"a servo on {self.config.port} reports an alarm: {error}") from error
            except OSError as error:
                raise HardwareLost(f"{self.config.port} failed: {error}") from error
            now_ns = time.monotonic_ns()
            late_us = (now_ns - self._sent_ns) // 1000
            self._transactions += 1
            self._late += late_us > 1e6 * self.config.late_after_s
            self._late_us.append(min(late_us, 1 << 30))
            retries = self._lost - lost
            return result, Transaction(
                self._sent_ns, began_ns - requested_ns, now_ns - began_ns, retries, 1000 * late_us
            )

    def force(self, servo_id: int, register: Register, value: int) -> bool:
        """Write the torque register despite errors; return whether it reads back. Never raises."""
        for _ in range(_FORCED_ATTEMPTS):
            with suppress(Exception), self._lock:
                self._write(register.address, register.size, servo_id, value)
                if self._read(register.address, register.size, servo_id)[0] == value:
                    return True
        return False

    def scan(self) -> list[int]:
        """Return the ids of the robot's motors."""
        return list(self.bus.ids)

    def close(self) -> None:
        """Close the port. Never raises."""
        self.closed = True
        with suppress(Exception):
            for camera in getattr(self.robot, "cameras", {}).values():
                camera.disconnect()
        with suppress(Exception):
            self.bus.port_handler.closePort()

    def _connect(self) -> None:
        """Connect, and let LeRobot write its settings, without the torque that it switches on behind them."""
        switch_on, self.bus.enable_torque = self.bus.enable_torque, lambda *_, **__: None
        try:
            self.robot.connect(calibrate=False)
        except (OSError, RuntimeError) as error:
            self.close()
            raise HardwareLost(
                f"LeRobot cannot connect {self.robot} on {self.config.port}: {error}",
                hint="check power, cable and ids; lerobot-setup-motors sets ids",
            ) from error
        except BaseException:
            self.close()
            raise
        finally:
            self.bus.enable_torque = switch_on
        if not self.robot.is_calibrated:
            path = self.robot.calibration_fpath
            self.close()
            raise HardwareLost(
                f"the servos on {self.config.port} do not hold the calibration {path}", hint="run lerobot-calibrate"
            )

    def _patient(self, primitive: Callable[..., Any]) -> Callable[..., Any]:
        """Return an instruction of LeRobot's bus that is repeated while answers are missing."""

        def repeated(*arguments: Any, **settings: Any) -> Any:
            settings |= {"num_retry": 0, "raise_on_error": True}
            losses, began_s = 0, time.monotonic()
            while True:
                # Show the guardian that this process lives, and drop late answers, which LeRobot takes for new ones.
                if self.guardian is not None:
                    self.guardian.beat()
                self.bus.port_handler.ser.reset_input_buffer()
                self._sent_ns = time.monotonic_ns()
                try:
                    return primitive(*arguments, **settings)
                except (ConnectionError, IndexError) as error:
                    # Feetech's package indexes the data of the next answer: a late one to a ping, or a damaged one, has
                    # none, which is an IndexError.
                    losses += 1
                    self._lost += 1
                    silent_s = time.monotonic() - began_s
                    if losses >= _MIN_LOSSES and silent_s > self.config.max_silence_s:
                        if self.guardian is not None:
                            self.guardian.require_watching()
                        raise HardwareLost(
                            f"no answer on {self.config.port}: {losses} missed in a row, {1e3 * silent_s:.0f} ms",
                            hint="check power, cable, ids and baud rate",
                        ) from error
                    self._retried += 1

        return repeated
