"""Where the supervisor's thread and the caller meet, one step at a time."""

from __future__ import annotations

import threading
from typing import NamedTuple

import numpy as np

from sim2real.graph.base import StepState
from sim2real.runtime.failure import GraphTimeout, Stopped


class Reply(NamedTuple):
    """What the caller does with a step.

    Attributes:
        step_state: The step state after the step; None: as it was.
        leaves: The step's output, packed; None when ``own``.
    """

    step_state: StepState | None = None
    leaves: list[np.ndarray] | None = None

    @property
    def own(self) -> bool:
        """Whether the node makes the step itself, from ``step_state``."""
        return self.leaves is None


class Handover:
    """The supervisor offers its step state and waits; the caller looks at it and replies.

    Args:
        own: Start with the node making its steps itself, without meeting anybody.
    """

    def __init__(self, own: bool) -> None:
        self._condition = threading.Condition()
        self._own = own
        self._closed = False
        self._offered: StepState | None = None
        self._reply: Reply | None = None
        self._finished = 0

    @property
    def own(self) -> bool:
        """Whether the node makes its steps itself."""
        return self._own

    def set_own(self, own: bool) -> None:
        """Let the node make its steps itself, the one on offer too, or hand them over again."""
        with self._condition:
            self._own = own
            if own:
                self._offered = None
            self._condition.notify_all()

    def close(self) -> None:
        """Nobody waits here any more."""
        with self._condition:
            self._closed = True
            self._condition.notify_all()

    def meet(self, step_state: StepState, timeout_s: float) -> Reply:
        """Offer a step and wait for the reply (the supervisor's side).

        Raises:
            Stopped: When the graph stopped meanwhile.
            GraphTimeout: When nobody replied in time.
        """
        with self._condition:
            if not self._own:
                self._offered = step_state
                self._condition.notify_all()
                self._condition.wait_for(lambda: self._reply or self._own or self._closed, timeout_s)
                self._offered = None
            reply, self._reply = self._reply, None
            if reply is not None:
                return reply
            if self._closed:
                raise Stopped
            if not self._own:
                raise GraphTimeout(
                    f"the supervisor waited {timeout_s:g} s for its output, so the graph stopped",
                    hint="call step() in time, or give AsyncGraph a longer timeout_s",
                )
            return Reply()

    def finished(self) -> None:
        """A step is over: made, sent and recorded (the supervisor's side)."""
        with self._condition:
            self._finished += 1
            self._condition.notify_all()

    def observe(self, timeout_s: float) -> StepState | None:
        """Wait for a step on offer; None when the time is up or the graph stopped (the caller's side)."""
        with self._condition:
            self._condition.wait_for(lambda: self._offered is not None or self._closed, timeout_s)
            return None if self._closed else self._offered

    def reply(self, reply: Reply) -> int:
        """Reply to the step on offer; return how many steps are finished once it is (the caller's side)."""
        with self._condition:
            self._offered, self._reply = None, reply
            self._condition.notify_all()
            return self._finished + 1

    def settle(self, finished: int, timeout_s: float) -> bool:
        """Wait until that many steps are finished; return whether they are (the caller's side)."""
        with self._condition:
            self._condition.wait_for(lambda: self._finished >= finished or self._closed, timeout_s)
            return self._finished >= finished
