"""Joins several processes of one training, compares their settings, and raises an error if one is lost."""

import json
import os
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

import jax
import numpy as np
from jax.experimental import multihost_utils

from sim2real.errors import Sim2RealError, UsageError
from sim2real.training.config import PPOConfig
from sim2real.training.scale.hosts import HostsConfig
from sim2real.types import Json

_SHUTDOWN_S = 7 * 86400
"""Time that a finished process waits for the others, as the first one still evaluates and writes the policy [s]."""
_LOST = re.compile(r"gloo|nccl|coordination|heartbeat|barrier|deadline_exceeded|unavailable", re.IGNORECASE)
_HINT = (
    "the reason is in the output of the process that ended first; `--resume newest` continues from the last evaluation"
)


def join(hosts: HostsConfig) -> None:
    """Join the other processes, before JAX computes anything."""
    if not hosts.several:
        return
    # JAX's preemption service would catch SIGTERM, so that a launcher's time limit would not end the training.
    jax.config.update("jax_enable_preemption_service", False)
    try:
        jax.distributed.initialize(
            hosts.coordinator,
            hosts.processes,
            hosts.process,
            cluster_detection_method=None if hosts.found else "deactivate",
            initialization_timeout=hosts.timeout_s,
            heartbeat_timeout_seconds=hosts.timeout_s,
            shutdown_timeout_seconds=_SHUTDOWN_S,
            # JAX would listen on all interfaces by default.
            coordinator_bind_address=os.environ.get("JAX_COORDINATOR_BIND_ADDRESS", hosts.coordinator),
        )
    except (ValueError, RuntimeError) as error:
        if isinstance(error, jax.errors.JaxRuntimeError):
            raise Sim2RealError(
                f"the processes of this training did not meet within {hosts.timeout_s} s: {_first_line(error)}",
                hint="start all of them; process 0 must be reachable at that address and port, without a proxy; behind "
                "a NAT, JAX_COORDINATOR_BIND_ADDRESS=HOST:PORT sets the address that it listens on",
            ) from error
        raise UsageError(
            f"the processes cannot be joined: {_first_line(error)}",
            hint="start them by srun, mpirun or as a Kubernetes job, or give their address: --hosts.coordinator ...",
        ) from error


def require_one_clock(config: PPOConfig) -> None:
    """Raise a ``UsageError`` for a time budget of several processes: their clocks differ."""
    if config.minutes is not None and jax.process_count() > 1:
        raise UsageError("minutes: several processes have several clocks", hint="use a target, or total_steps")


def _lost_message(reason: str) -> str:
    return f"process {jax.process_index()} of {jax.process_count()} lost another one of this training: {reason}"


def leads() -> bool:
    """Return whether this process writes files and shows progress; a single process does."""
    return jax.process_index() == 0


def wait_for_all(what: str) -> None:
    """Wait until all processes have made this call."""
    if jax.process_count() > 1:
        multihost_utils.sync_global_devices(what)


def agree(settings: Mapping[str, Json]) -> None:
    """Compare the settings of all processes: with different programs they would wait for each other forever."""
    if jax.process_count() == 1:
        return

    # Gather the settings of all processes as texts of one length.
    text = np.frombuffer(json.dumps(settings).encode(), np.uint8)
    longest = int(np.max(multihost_utils.process_allgather(np.int32(text.size))))
    rows = np.asarray(multihost_utils.process_allgather(np.pad(text, (0, longest - text.size))))

    # Compare each with those of process 0.
    first, *others = (json.loads(bytes(row).rstrip(b"\0")) for row in rows)
    for number, other in enumerate(others, 1):
        if names := [n for n in {**first, **other} if first.get(n) != other.get(n)]:
            differences = ", ".join(
                f"{n} = {first.get(n)} in process 0 and {other.get(n)} in process {number}" for n in names
            )
            raise UsageError(
                f"the processes were started with different settings: {differences}",
                hint="start all of them with the same flags, code, versions and run folder",
            )


@contextmanager
def lost_process_errors() -> Iterator[None]:
    """Convert transport errors to a ``Sim2RealError`` that names the cause: another process was lost."""
    try:
        yield
    except (ValueError, jax.errors.JaxRuntimeError) as error:
        if isinstance(error, Sim2RealError) or jax.process_count() == 1 or not _LOST.search(str(error)):
            raise
        raise Sim2RealError(_lost_message(_first_line(error)), hint=_HINT) from error


def _first_line(error: Exception) -> str:
    return str(error).strip().partition("\n")[0][:300]
