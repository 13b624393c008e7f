"""Several processes that make one training: they join, agree on what they do, and end in words where one is lost."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils

from sim2real.errors import Sim2RealError, UsageError
from sim2real.train.scale.aborts import aborted, catch_aborts
from sim2real.train.scale.hosts import HostsConfig

_AFTERWARDS_S = 7 * 86400
"""How long a process that has ended well waits for the others: the first one still judges and writes the policy."""
_LOST = re.compile(r"gloo|nccl|coordination|heartbeat|barrier|deadline_exceeded|unavailable", re.IGNORECASE)
_WHY = "the reason is in the output of the process that ended first; `--resume newest` goes on from the last evaluation"


def join(hosts: HostsConfig) -> None:
    """Join the other processes; nothing may have been computed before.

    Raises:
        UsageError: No launcher is found, or JAX has computed before.
        Sim2RealError: They do not come in time.
    """
    if not hosts.several:
        return
    # Or it takes SIGTERM for a message to itself: a launcher's time limit would not end the training, but be noted.
    jax.config.update("jax_enable_preemption_service", False)
    try:
        jax.distributed.initialize(
            hosts.coordinator,
            hosts.processes,
            hosts.process,
            cluster_detection_method=None if hosts.found else "deactivate",
            initialization_timeout=hosts.timeout_s,
            heartbeat_timeout_seconds=hosts.timeout_s,
            shutdown_timeout_seconds=_AFTERWARDS_S,
            # JAX itself would listen on all interfaces.
            coordinator_bind_address=os.environ.get("JAX_COORDINATOR_BIND_ADDRESS", hosts.coordinator),
        )
    except (ValueError, RuntimeError) as error:
        if isinstance(error, jax.errors.JaxRuntimeError):
            raise Sim2RealError(
                f"the processes of this training did not meet within {hosts.timeout_s} s: {_first_line(error)}",
                hint="start all of them; process 0 must be reachable at that address and port, proxies apart; where it "
                "is not its own address, as behind a NAT, JAX_COORDINATOR_BIND_ADDRESS=HOST:PORT says where it listens",
            ) from error
        raise UsageError(
            f"the processes cannot be joined: {_first_line(error)}",
            hint="start them by srun, mpirun or as a Kubernetes job, or say who they are: --hosts.coordinator ...",
        ) from error
    catch_aborts(_lost("JAX ended it, and says why above"), _WHY, Sim2RealError.exit_code)


def require_neighbours() -> None:
    """Raise where JAX has ended this process because another one was lost; asked while it waits for a computation.

    Raises:
        Sim2RealError: In words; the process must end soon.
    """
    if words := aborted():
        raise Sim2RealError(words, hint=_WHY)


def _lost(why: str) -> str:
    return f"process {jax.process_index()} of {jax.process_count()} lost another one of this training: {why}"


def leads() -> bool:
    """Return whether this process writes files and shows how training goes; one that is alone does."""
    return jax.process_index() == 0


def wait_for_all(what: str) -> None:
    """Wait until all processes have come here."""
    if jax.process_count() > 1:
        multihost_utils.sync_global_devices(what)


def agree(mine: Mapping[str, Any]) -> None:
    """Compare what the processes are about to do; different programs would wait for each other for ever.

    Args:
        mine: What this one does, name -> what JSON holds.

    Raises:
        UsageError: They differ; all processes raise it.
    """
    if jax.process_count() == 1:
        return
    text = np.frombuffer(json.dumps(mine).encode(), np.uint8)
    longest = int(np.max(multihost_utils.process_allgather(np.int32(text.size))))
    rows = np.asarray(multihost_utils.process_allgather(np.pad(text, (0, longest - text.size))))
    first, *others = (json.loads(bytes(row).rstrip(b"\0")) for row in rows)
    for number, other in enumerate(others, 1):
        if names := [n for n in {**first, **other} if first.get(n) != other.get(n)]:
            said = ", ".join(f"{n} = {first.get(n)} in process 0 and {other.get(n)} in process {number}" for n in names)
            raise UsageError(
                f"the processes were not started alike: {said}",
                hint="start all of them with the same flags, code, versions and run folder",
            )


@contextmanager
def in_words() -> Iterator[None]:
    """Say so where another process of the training was lost, in place of what its transport says."""
    try:
        yield
    except (ValueError, jax.errors.JaxRuntimeError) as error:
        if isinstance(error, Sim2RealError) or jax.process_count() == 1 or not _LOST.search(str(error)):
            raise
        raise Sim2RealError(_lost(_first_line(error)), hint=_WHY) from error


def _first_line(error: Exception) -> str:
    return str(error).strip().partition("\n")[0][:300]
