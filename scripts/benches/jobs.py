"""Many robots at the same time: one process each, and what becomes of one is no other's business."""

from __future__ import annotations

import multiprocessing
import os
import sys
import traceback
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from typing import Any

_ONE_THREAD = {"OMP_NUM_THREADS": "1", "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false"}


def each(
    one: Callable[[int, Any], dict[str, Any]], numbers: Sequence[int], options: Any
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Call a function for every robot, ``options.jobs`` at the same time; several have one thread each.

    Args:
        one: Takes a robot's number and the flags, and returns what became of it.
        numbers: Of the robots.
        options: Flags of the bench.

    Returns:
        What became of each, and number and error of those that failed, in order.
    """
    if options.jobs == 1:
        outcomes = [_outcome(one, n, options) for n in numbers]
    else:
        for name, value in _ONE_THREAD.items():  # the processes inherit them
            os.environ.setdefault(name, value)
        context = multiprocessing.get_context("spawn")
        cores = context.Queue()
        for worker in range(options.jobs):
            cores.put(worker)
        with ProcessPoolExecutor(options.jobs, context, _on_one_core, (cores,)) as pool:
            outcomes = list(pool.map(_outcome, [one] * len(numbers), numbers, [options] * len(numbers)))
    return [o for o in outcomes if "failed" not in o], [o for o in outcomes if "failed" in o]


def _on_one_core(cores: Any) -> None:
    """Keep a worker on a core of its own: C MuJoCo would start as many threads in each as there are cores."""
    if hasattr(os, "sched_setaffinity"):
        there = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, {there[cores.get() % len(there)]})


def _outcome(one: Callable[[int, Any], dict[str, Any]], number: int, options: Any) -> dict[str, Any]:
    try:
        return one(number, options)
    except Exception as error:  # an hour's other robots must not be lost to it
        print(f"robot {number} failed:\n{traceback.format_exc()}", file=sys.stderr, flush=True)
        return {"number": number, "failed": f"{type(error).__name__}: {error}"}
