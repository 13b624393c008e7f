"""The stream of states of a robot that sends them without a request: the first after a call, and counts of losses."""

import threading
from array import array
from typing import Final

import numpy as np

from sim2real.errors import HardwareLost
from sim2real.hardware.device import Counters, Transaction
from sim2real.hardware.unitree.dds import QUEUE, DdsLink
from sim2real.hardware.unitree.messages import LowState

PERIOD_S: Final = 0.002
"""Time between two states of a Go2."""
_LATE_S: Final = 0.005
"""A state that arrives this long after the call is late."""
_LEARNT: Final = 11
"""States from which the step of the tick is learnt."""


class StateStream:
    """Reads states in their order, and counts those that are missing, damaged, late or overtaken.

    A state that is damaged has a wrong CRC; it is dropped. Missing and damaged ones show as a gap in the ticks.

    Args:
        max_silence_s: Time without a state after which the robot is lost [s].
    """

    def __init__(self, robot: DdsLink, max_silence_s: float) -> None:
        self._robot, self._max_silence_s = robot, max_silence_s
        self._clock = robot.clock
        self._lock = threading.Lock()
        self._step = 1
        self._tick: int | None = None
        self._taken_s = 0.0
        self._lost = self._late = self._answered = self._retries = 0
        self._late_s = array("d")

    def begin(self, timeout_s: float) -> LowState:
        """Wait for the first states, learn by how much the tick grows, and return the newest state."""
        with self._lock:
            states, damaged, end_s = [], 0, self._now_s() + timeout_s
            while len(states) < _LEARNT:
                left_s = end_s - self._now_s()
                state = self._robot.next_state(left_s) if left_s > 0.0 else None
                if state is None:
                    raise self._silent(timeout_s, damaged)
                states += [state] if state.intact else []
                damaged += not state.intact
            ticks = np.array([state.record["tick"] for state in states], np.int64)
            self._step = max(1, round(float(np.median(np.diff(ticks)))))
            self._tick, self._taken_s = int(ticks[-1]), self._now_s()
            return states[-1]

    def next(self) -> tuple[LowState, Transaction]:
        """Return the first state that arrives after the call, and its times; raise HardwareLost if none does."""
        called_ns = self._clock.now_ns()
        with self._lock:
            # The states that came before are older than the step that reads them.
            begin_ns = self._clock.now_ns()
            while (old := self._robot.next_state(0.0)) is not None:
                self._is_next(old)
            lost, damaged, end_s = self._lost, 0, self._now_s() + self._max_silence_s
            while True:
                left_s = end_s - self._now_s()
                state = self._robot.next_state(left_s) if left_s > 0.0 else None
                if state is None:
                    raise self._silent(self._max_silence_s, damaged)
                if self._is_next(state):
                    break
                damaged += not state.intact
            # Count it.
            arrived_ns = self._clock.now_ns()
            retries, waited_s = self._lost - lost, 1e-9 * (arrived_ns - begin_ns)
            late_s = max(0.0, waited_s - PERIOD_S * (1 + retries))
            self._late += retries == 0 and waited_s > _LATE_S
            self._retries += retries
            self._answered += 1
            self._late_s.append(late_s)
        times = begin_ns - called_ns, arrived_ns - begin_ns, retries, int(1e9 * late_s)
        return state, Transaction(arrived_ns, *times)

    def counters(self, commands: int) -> Counters:
        """Return the counts, with those of the commands."""
        done = self._answered + commands
        return Counters(done, self._lost, self._retries, self._late, np.array(self._late_s))

    def _is_next(self, state: LowState) -> bool:
        """Note a state; return whether it is intact and newer than the one before."""
        if not state.intact:
            return False
        tick, now_s = int(state.record["tick"]), self._now_s()
        # The counter of 32 bits starts again at 0.
        ahead = (tick - (self._tick or 0) + 2**31) % 2**32 - 2**31
        if ahead <= 0:
            self._late += 1
            return False
        # After a pause the queue has dropped states itself.
        if now_s - self._taken_s < (QUEUE - 2) * PERIOD_S:
            self._lost += max(0, round(ahead / self._step) - 1)
        self._tick, self._taken_s = tick, now_s
        return True

    def _now_s(self) -> float:
        return 1e-9 * self._clock.now_ns()

    def _silent(self, time_s: float, damaged: int) -> HardwareLost:
        if damaged:
            return HardwareLost(
                f"the robot on {self._robot.address} has sent {damaged} states in {time_s:g} s, all with a wrong CRC",
                hint="is it a Go2, and does its firmware fill in the CRC of its states?",
            )
        return HardwareLost(
            f"the robot on {self._robot.address} has sent no state for {time_s:g} s",
            hint="is it on, is the cable in, and are interface and domain the robot's?",
        )
