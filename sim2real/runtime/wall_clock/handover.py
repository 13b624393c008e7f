"""Synchronises the supervisor's thread with the caller of ``reset`` and ``step``, step by step."""

import threading
from typing import NamedTuple

import numpy as np

from sim2real.graph.base import StepState
from sim2real.runtime.failure import GraphTimeout, Stopped


class Reply(NamedTuple):
    """The caller's answer to an offered step state.

    Attributes:
        step_state: The step state after the step; None: unchanged.
        leaves: The step's output, as ``Format.pack`` returns it; None: the node's ``step`` is called.
    """

    step_state: StepState | None = None
    leaves: list[np.ndarray] | None = None

    @property
    def autonomous(self) -> bool:
        """Whether the node's ``step`` is called with ``step_state``."""
        return self.leaves is None


class Handover:
    """The supervisor offers its step state and waits; the caller observes it and replies.

    Args:
        autonomous: Whether the node makes its own steps at first, without waiting for a caller.
    """

    def __init__(self, autonomous: bool) -> None:
        self._condition = threading.Condition()
        self._autonomous = autonomous
        self._closed = False
        self._offered: StepState | None = None
        self._reply: Reply | None = None
        self._finished = 0

    @property
    def autonomous(self) -> bool:
        """Whether the node makes its own steps."""
        return self._autonomous

    def set_autonomous(self, autonomous: bool) -> None:
        """Let the node, or else the caller, make the steps from now on, the one on offer included."""
        with self._condition:
            self._autonomous = autonomous
            if autonomous:
                self._offered = None
            self._condition.notify_all()

    def close(self) -> None:
        """Wake both sides, for good: the graph is stopping."""
        with self._condition:
            self._closed = True
            self._condition.notify_all()

    def meet(self, step_state: StepState, timeout_s: float) -> Reply:
        """Offer a step and wait for the reply; called by the supervisor's thread.

        Raises:
            Stopped: The graph stopped meanwhile.
            GraphTimeout: There was no reply in time.
        """
        with self._condition:
            # Offer the step, and wait for the caller's reply.
            if not self._autonomous:
                self._offered = step_state
                self._condition.notify_all()
                self._condition.wait_for(lambda: self._reply or self._autonomous or self._closed, timeout_s)
                self._offered = None
            reply, self._reply = self._reply, None
            if reply is not None:
                return reply
            if self._closed:
                raise Stopped
            if not self._autonomous:
                raise GraphTimeout(
                    f"the supervisor waited {timeout_s:g} s for its output, so the graph stopped",
                    hint="call step() in time, or give AsyncGraph a longer timeout_s",
                )
            return Reply()

    def finished(self) -> None:
        """Count a step after it was sent and recorded; called by the supervisor's thread."""
        with self._condition:
            self._finished += 1
            self._condition.notify_all()

    def observe(self, timeout_s: float) -> StepState | None:
        """Wait for a step on offer and return it; None after a timeout or when the graph stopped. For the caller."""
        with self._condition:
            self._condition.wait_for(lambda: self._offered is not None or self._closed, timeout_s)
            return None if self._closed else self._offered

    def reply(self, reply: Reply) -> int:
        """Reply to the step on offer, for the caller; return the number of finished steps after it."""
        with self._condition:
            self._offered, self._reply = None, reply
            self._condition.notify_all()
            return self._finished + 1

    def settle(self, finished: int, timeout_s: float) -> bool:
        """Wait until ``finished`` steps are finished, for the caller; return False after a timeout."""
        with self._condition:
            self._condition.wait_for(lambda: self._finished >= finished or self._closed, timeout_s)
            return self._finished >= finished
