"""Many fits at once, each in a process of its own that has one processor: as fair as one after the other."""

from __future__ import annotations

import argparse
import multiprocessing
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from itertools import cycle, islice
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
    context, jobs = multiprocessing.get_context("spawn"), max(min(options.jobs, len(tasks)), 1)
    processors = context.Queue()
    for number in islice(cycle(_processors()), jobs):
        processors.put(number)
    # A process a task: none finds programs compiled that another had to compile.
    with (
        _environment(),
        ProcessPoolExecutor(jobs, context, _take, (processors,), max_tasks_per_child=1) as pool,
    ):
        numbers = {pool.submit(_alone, work, task, options): i for i, task in enumerate(tasks)}
        try:
            for done in as_completed(numbers):
                yield numbers[done], done.result()
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


_free: Any = None
"""Of a process: the processors that no other has."""


def _take(processors: Any) -> None:
    global _free
    _free = processors


def _alone(work: Callable[..., dict[str, Any]], task: Sequence[Any], options: argparse.Namespace) -> dict[str, Any]:
    """Do the work on one processor: C engines count those that a process may use, and take a thread for each."""
    number = _free.get()
    try:
        if hasattr(os, "sched_setaffinity"):
            os.sched_setaffinity(0, {number})
        return work(*task, options)
    finally:
        _free.put(number)


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
