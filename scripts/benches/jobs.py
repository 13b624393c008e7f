"""Several fits or robots at once, each in its own process on one processor: as fair as one after the other."""

from __future__ import annotations

import argparse
import ctypes
import multiprocessing
import os
import signal
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import partial
from itertools import cycle, islice
from queue import SimpleQueue
from typing import Any

ONE_THREAD = {
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1",
    **dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"),
    "JAX_PLATFORMS": "cpu",
}
"""Environment of a process that computes in one thread; other flags in XLA_FLAGS stay."""
_PR_SET_PDEATHSIG = 1
OVER = "not done when the bench's time was up"
"""Message of the error that ends a robot after the time limit."""


def each(
    work: Callable[..., dict[str, Any]],
    tasks: Sequence[Sequence[Any]],
    options: argparse.Namespace,
    lost: Callable[[Sequence[Any]], dict[str, Any]] | None = None,
) -> Iterator[tuple[int, dict[str, Any]]]:
    """Call ``work(*task, options)`` for each task, and yield its number and its result in the order of their ends.

    Args:
        options: The bench's flags; ``jobs`` tasks run at once, in this process if that is 1.
        lost: Returns the result of a task whose process was killed; without it, that is an error.
    """
    if options.jobs == 1:
        for i, task in enumerate(tasks):
            yield i, work(*task, options)
        return
    context, free = multiprocessing.get_context("spawn"), SimpleQueue()
    for number in islice(cycle(_processors()), options.jobs):
        free.put(number)

    def alone(task: Sequence[Any]) -> dict[str, Any]:
        number = free.get()
        try:
            # One process for each task: no task profits from programs that another has compiled.
            with ProcessPoolExecutor(1, context, _hold, (number,)) as pool:
                return pool.submit(work, *task, options).result()
        except BrokenProcessPool:
            if lost is None:
                raise
            return lost(task)
        finally:
            free.put(number)

    with _environment(), ThreadPoolExecutor(options.jobs) as threads:
        numbers = {threads.submit(alone, task): i for i, task in enumerate(tasks)}
        try:
            for done in as_completed(numbers):
                yield numbers[done], done.result()
        finally:
            threads.shutdown(cancel_futures=True)


def robots(
    one: Callable[[int, Any], dict[str, Any]], numbers: Sequence[int], options: argparse.Namespace
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Call ``one(number, options)`` for every robot; the failure of one does not end the others.

    Args:
        options: The bench's flags: ``jobs`` as for :func:`each`; ``within_s``, if there is one, is the time after which
            robots that are not done count as failed [s].

    Returns:
        The results, and number and error of the robots that failed, in order.
    """
    within_s = getattr(options, "within_s", None)
    until = None if within_s is None else time.time() + within_s
    tasks = [(number,) for number in numbers]
    lost = lambda task: {"number": task[0], "failed": "its process was killed"}  # noqa: E731
    outcomes = [outcome for _, outcome in each(partial(_outcome, one, until), tasks, options, lost)]
    outcomes.sort(key=lambda outcome: outcome["number"])
    return [o for o in outcomes if "failed" not in o], [o for o in outcomes if "failed" in o]


def _outcome(
    one: Callable[[int, Any], dict[str, Any]], until: float | None, number: int, options: Any
) -> dict[str, Any]:
    try:
        with _until(until):
            return one(number, options)
    except Exception as error:  # the results of the other robots must not be lost
        print(f"robot {number} failed:\n{traceback.format_exc()}", file=sys.stderr, flush=True)
        return {"number": number, "failed": f"{type(error).__name__}: {error}"}


@contextmanager
def _until(until: float | None) -> Iterator[None]:
    """Raise TimeoutError in the block at a time; a call into C ends first."""
    if until is None:
        yield
        return

    def ring(*_: Any) -> None:
        raise TimeoutError(OVER)

    before = signal.signal(signal.SIGALRM, ring)
    try:
        signal.setitimer(signal.ITIMER_REAL, max(until - time.time(), 1e-3))
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def _hold(number: int) -> None:
    """Hold this process on one processor, and let the kernel end it with the bench, also with a killed one.

    C engines start one thread for each processor that they may use.
    """
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {number})


def _processors() -> list[int]:
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(0))
    return list(range(os.cpu_count() or 1))


@contextmanager
def _environment() -> Iterator[None]:
    """Set the environment of new processes to one thread, which libraries read when they are loaded."""
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(ONE_THREAD | {"XLA_FLAGS": f"{before['XLA_FLAGS'] or ''} {ONE_THREAD['XLA_FLAGS']}".strip()})
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
