"""Several fits or robots at once, each in a process of its own on one processor: as fair as one after the other."""

from __future__ import annotations

import argparse
import ctypes
import multiprocessing
import os
import signal
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from functools import partial
from itertools import cycle, islice
from typing import Any

ONE_THREAD = {
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1",
    **dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"),
    "JAX_PLATFORMS": "cpu",
}
"""Environment of a process that computes in one thread; other flags in XLA_FLAGS stay."""
_PR_SET_PDEATHSIG = 1
Work = Callable[..., dict[str, Any]]


def each(work: Work, tasks: Sequence[Sequence[Any]], options: argparse.Namespace) -> Iterator[tuple[int, Any]]:
    """Call ``work(*task, options)`` for each task; yield its number and its result in the order of their ends.

    Args:
        options: The bench's flags; ``jobs`` tasks run at once, in this process if that is 1.
    """
    if options.jobs == 1:
        yield from ((i, work(*task, options)) for i, task in enumerate(tasks))
        return
    before = dict(os.environ)  # libraries read it when a new process loads them
    os.environ.update(ONE_THREAD | {"XLA_FLAGS": f"{before.get('XLA_FLAGS', '')} {ONE_THREAD['XLA_FLAGS']}".strip()})
    processors = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else range(os.cpu_count() or 1)
    free, waiting, running = list(islice(cycle(processors), options.jobs)), list(enumerate(tasks)), {}
    # One process a task: no task profits from programs that another has compiled.
    pool = ProcessPoolExecutor(
        options.jobs, multiprocessing.get_context("spawn"), _end_with_parent, max_tasks_per_child=1
    )
    try:
        while waiting or running:
            while waiting and free:
                (i, task), processor = waiting.pop(0), free.pop()
                running[pool.submit(_pinned, processor, work, task, options)] = i, processor
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                i, processor = running.pop(future)
                free.append(processor)
                yield i, future.result()
    finally:
        pool.shutdown(cancel_futures=True)
        os.environ.clear()
        os.environ.update(before)


def robots(one: Work, numbers: Sequence[int], options: argparse.Namespace) -> tuple[list[Any], list[Any]]:
    """Call ``one(number, options)`` for every robot; return the results, and number and error of those that failed."""
    outcomes = [outcome for _, outcome in each(partial(_outcome, one), [(number,) for number in numbers], options)]
    outcomes.sort(key=lambda outcome: outcome["number"])
    return [o for o in outcomes if "failed" not in o], [o for o in outcomes if "failed" in o]


def _outcome(one: Work, number: int, options: argparse.Namespace) -> dict[str, Any]:
    try:
        return one(number, options)
    except Exception as error:  # the results of the other robots must not be lost
        print(f"robot {number} failed:\n{traceback.format_exc()}", file=sys.stderr, flush=True)
        return {"number": number, "failed": f"{type(error).__name__}: {error}"}


def _end_with_parent() -> None:
    """Let the kernel end this process with the bench, also with a killed one."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)


def _pinned(processor: int, work: Work, task: Sequence[Any], options: argparse.Namespace) -> dict[str, Any]:
    """Work on one processor: C engines start a thread for each processor that they may use."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {processor})
    return work(*task, options)
