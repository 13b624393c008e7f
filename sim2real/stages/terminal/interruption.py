"""Ending a command by a signal, with clean-up."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any, TypeVar

Result = TypeVar("Result")


_soft = threading.Event()


@contextmanager
def interruptible() -> Iterator[None]:
    """Let the next signal raise an exception, even after an earlier signal."""
    _soft.set()
    try:
        yield
    finally:
        _soft.clear()


class SignalHandling:
    """Turns SIGINT, SIGTERM and SIGHUP into exceptions, so that every ``finally`` runs: torque off, logs closed.

    Only the first signal raises an exception: a second Ctrl-C must not interrupt the clean-up that takes the torque
    off. Clean-up that may take long, such as a soft stop, runs in ``interruptible``, where the next signal raises
    again. If the exception is raised where Python ignores exceptions (in a finaliser or a callback of the garbage
    collector), the signal is sent again.

    Attributes:
        received: Number of the signal that raised an exception; 0 before.
    """

    def __init__(self) -> None:
        self.received = 0
        self._raised: BaseException | None = None
        self._before: dict[int, Any] = {}
        self._hook = sys.unraisablehook

    def __enter__(self) -> SignalHandling:
        if threading.current_thread() is threading.main_thread():
            numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
            # Signals that are ignored at the start, as under nohup and in background jobs, stay ignored.
            self._before = {n: old for n in numbers if (old := signal.getsignal(n)) is not signal.SIG_IGN}
            sys.unraisablehook = self._dropped
            for number in self._before:
                signal.signal(number, self._handle)
        return self

    def __exit__(self, *exception: object) -> None:
        if self._before:
            sys.unraisablehook = self._hook
        for number, old in self._before.items():
            signal.signal(number, old)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self._raised is not None and not _soft.is_set():
            os.write(2, b"still cleaning up\n")  # print() is not safe inside a signal handler
            return
        # Python also ignores an exception in this hook: wait until the hook has returned.
        while frame is not None:
            if frame.f_code is SignalHandling._dropped.__code__:
                self._send_later(number)
                return
            frame = frame.f_back
        _soft.clear()
        self.received = number
        self._raised = KeyboardInterrupt() if number == signal.SIGINT else SystemExit(128 + number)
        raise self._raised

    def _dropped(self, unraisable: Any) -> None:
        if self._raised is None or unraisable.exc_value is not self._raised:
            self._hook(unraisable)
            return
        self._raised = None
        self._send_later(self.received)

    def _send_later(self, number: int) -> None:
        threading.Timer(0.01, os.kill, (os.getpid(), number)).start()


def patiently(work: Callable[[], Result]) -> Result:
    """Run a long computation in another thread, so that a signal is handled at once.

    Python handles signals between bytecode instructions of the main thread, and a single call into XLA may compile for
    a minute. The signal does not stop the computation, which ends with the process: its callbacks must not write files
    after the caller has left. An exception of the computation is raised here.
    """
    # Work in a thread, so that the main thread receives signals at once.
    outcome: list[Result] = []
    failure: list[BaseException] = []
    done = threading.Event()

    def run() -> None:
        try:
            outcome.append(work())
        except BaseException as error:
            failure.append(error)
        finally:
            done.set()

    threading.Thread(target=run, name="sim2real:work", daemon=True).start()
    while not done.wait(0.25):  # polls: a signal that another thread receives does not wake this one
        pass
    if failure:
        raise failure[0]
    return outcome[0]
