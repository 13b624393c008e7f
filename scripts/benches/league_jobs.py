"""Many fits at once, each in a process of its own that has one processor: as fair as one after the other."""

from __future__ import annotations

import argparse
import multiprocessing
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from itertools import cycle, islice
from queue import SimpleQueue
from typing import Any

ONE_THREAD = {
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1",
    **dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"),
    "JAX_PLATFORMS": "cpu",
}
"""Environment of a process that computes by one thread; what stands in XLA_FLAGS already is kept."""


def each(
    work: Callable[..., dict[str, Any]], tasks: Sequence[Sequence[Any]], options: argparse.Namespace
) -> Iterator[tuple[int, dict[str, Any]]]:
    """Do ``work(*task, options)`` for each task, and yield its number and its result as they come.

    Args:
        work: A function of a module.
        tasks: Arguments.
        options: The bench's flags; ``jobs`` of them run at once, in this process where that is 1.
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
            # A process a task: none finds programs compiled that another had to compile.
            with ProcessPoolExecutor(1, context, _hold, (number,)) as pool:
                return pool.submit(work, *task, options).result()
        finally:
            free.put(number)

    with _environment(), ThreadPoolExecutor(options.jobs) as threads:
        numbers = {threads.submit(alone, task): i for i, task in enumerate(tasks)}
        try:
            for done in as_completed(numbers):
                yield numbers[done], done.result()
        finally:
            threads.shutdown(cancel_futures=True)


def _hold(number: int) -> None:
    """Hold this process on one processor: C engines count those that it may use, and take a thread for each."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {number})


def _processors() -> list[int]:
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(0))
    return list(range(os.cpu_count() or 1))


@contextmanager
def _environment() -> Iterator[None]:
    """Have processes that are started meanwhile compute by one thread: libraries read this when they are loaded."""
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
