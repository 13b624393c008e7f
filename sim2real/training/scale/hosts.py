"""The processes of one training, on one host or several. Imports no JAX, so ``--help`` is instant."""

import re
import socket
from dataclasses import dataclass

from sim2real.errors import UsageError


@dataclass(frozen=True)
class HostsConfig:
    """The processes of a training; each divides its part among its own devices."""

    found: bool = False
    """Join the processes that SLURM, Open MPI or Kubernetes started; JAX reads their addresses from the environment."""
    coordinator: str | None = None
    """Address of process 0, HOST:PORT with a free port, which all others can reach; for processes started by hand."""
    processes: int | None = None
    """Number of processes started by hand."""
    process: int | None = None
    """Number of this process: 0, 1 ...; process 0 writes all files and shows progress."""
    timeout_s: int = 300
    """Longest wait for a process that has not joined, or that no longer answers [s]."""

    def __post_init__(self) -> None:
        """Check the settings before any connection is made."""
        by_hand = (self.coordinator, self.processes, self.process)
        if self.found and by_hand != (None, None, None):
            raise UsageError("hosts.found excludes hosts.coordinator, hosts.processes and hosts.process")
        if None in by_hand and by_hand != (None, None, None):
            raise UsageError(
                "processes that are started by hand need all of hosts.coordinator, hosts.processes and hosts.process",
                hint="--hosts.coordinator HOST:PORT --hosts.processes 2 --hosts.process 0, and 1 on the other host",
            )
        if self.coordinator is not None and not re.fullmatch(r"\S+:\d{1,5}", self.coordinator):
            raise UsageError(f"hosts.coordinator must be HOST:PORT, got {self.coordinator!r}")
        if self.processes is not None and self.process is not None and not 0 <= self.process < self.processes:
            raise UsageError(f"hosts.process must lie in [0, {self.processes}), got {self.process}")
        if not 5 <= self.timeout_s <= 86400:
            raise UsageError(f"hosts.timeout_s must lie in [5, 86400] s, got {self.timeout_s}")

    @property
    def several(self) -> bool:
        """Whether there are, or may be, other processes."""
        return self.found or self.processes is not None

    def __str__(self) -> str:
        """Describe the processes, for the output of each: JAX's own messages are hard to read."""
        name = "one of the processes that the launcher started"
        if self.process is not None:
            name = f"process {self.process} of {self.processes}, which meet at {self.coordinator}"
        end = f"if one does not join, or answer, within {self.timeout_s} s, all end"
        where = "the coordinator's interfaces" if self.found else self.coordinator
        trust = f"any program that reaches {where} can join or end the training: use a network that you trust"
        return "; ".join([name, end, *([] if self.process else [trust]), *self._loopback_warning()])

    def _loopback_warning(self) -> list[str]:
        """Return a warning if process 0 listens only on the loopback, though its address names a host (Debian)."""
        host = (self.coordinator or "").rpartition(":")[0].strip("[]")
        if self.process != 0 or host == "localhost" or _is_loopback(host):
            return []
        try:
            addresses = sorted({str(info[4][0]) for info in socket.getaddrinfo(host, None)})
        except OSError:
            return []  # the other processes cannot resolve the name, either: joining raises the error
        if not all(map(_is_loopback, addresses)):
            return []
        return [f"warning: {host} is {', '.join(addresses)} here, which no other host reaches: name a network address"]


def _is_loopback(address: str) -> bool:
    return address.startswith("127.") or address == "::1"
