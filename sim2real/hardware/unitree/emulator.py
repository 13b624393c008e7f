"""The emulator process: a robot of Unitree behind the topics of its low-level interface, in real time.

    python -m sim2real.hardware.unitree.emulator --emulation sim2real.hardware.unitree.emulation:UnitreeEmulation \
        --plant pipelines/go2/body.py:Go2Body --truth truth.bin --sensing-latency-s 0.004

prints one line of JSON with the port when it is ready, and runs until SIGTERM. It sends 500 states a second on
``rt/lowstate``, and obeys the commands on ``rt/lowcmd``, on the loopback interface of this machine alone.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import select
import socket
import sys
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Final

from sim2real.errors import HardwareLost
from sim2real.hardware.emulation.emulator import StopFlag, emulate, keep_time, plant_arguments
from sim2real.hardware.emulation.truth import Kind, TruthLog
from sim2real.hardware.plant import load_named
from sim2real.hardware.unitree.dds import Address
from sim2real.hardware.unitree.emulation import STATE_HZ, EmulatedLegs, UnitreeEmulation, truth_header
from sim2real.hardware.unitree.messages import COMMAND_TOPIC, STATE_TOPIC, LowCmd, LowState

if TYPE_CHECKING:
    from cyclonedds.sub import DataReader

_POLL_NS: Final = 1_000_000
_PERIOD_NS: Final = 1_000_000_000 // STATE_HZ
_DOMAINS: Final = range(50, 230)
"""Domains of emulators; a real robot has domain 0."""
_LOCK_PORT: Final = 29_000
"""A domain belongs to the process that has the UDP port of this number plus the domain's."""
_DDS_PORT, _DDS_PORTS = 7400, 250
"""Every program in a domain hears on this UDP port plus a number of ports for each domain (DDSI-RTPS, section 9.6)."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line of an emulated robot; return its exit code."""
    return emulate(arguments, UnitreeEmulation.program, __doc__, UnitreeEmulation, _run)


def _run(options: argparse.Namespace, config: UnitreeEmulation, stop: StopFlag) -> None:
    # Imported here: without cyclonedds, `messages` above has raised an error that names its extra.
    from cyclonedds.domain import Domain, DomainParticipant
    from cyclonedds.pub import DataWriter
    from cyclonedds.sub import DataReader
    from cyclonedds.topic import Topic

    body = load_named(options.plant, "plant")(**plant_arguments(options.plant_args))
    lock, domain = _free_domain()
    # DDS has threads of its own, which take no part in the real-time priority.
    address = Address("lo", domain)
    network = Domain(domain, address.config)
    participant = DomainParticipant(domain)
    reader = DataReader(participant, Topic(participant, COMMAND_TOPIC, LowCmd))
    writer = DataWriter(participant, Topic(participant, STATE_TOPIC, LowState))
    keep_time()
    start_ns = time.monotonic_ns()
    truth = TruthLog(options.truth, truth_header(body, config, start_ns))
    try:
        legs = EmulatedLegs(body, config, truth, start_ns)
        ready = {"port": str(address), "pid": os.getpid(), "truth": str(options.truth.resolve())}
        print(json.dumps(ready), flush=True)
        parent_fd = sys.stdin.fileno() if options.until_stdin_closes else None
        _serve(legs, config, reader, Sender(writer.write, config, truth), truth, start_ns, stop, parent_fd)
    finally:
        truth.close()
        del writer, reader, participant, network
        lock.close()


class Sender:
    """Sends states, with the faults of the settings."""

    def __init__(
        self,
        write: Callable[[LowState], object],
        config: UnitreeEmulation,
        truth: TruthLog,
        now_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._write, self._config, self._truth, self._now_ns = write, config, truth, now_ns
        self._random = random.Random(config.seed)
        self._waiting: deque[tuple[LowState, int]] = deque()
        self._held_ns = 0

    def send(self, state: LowState, state_ns: int) -> None:
        """Send a state that is due at ``state_ns``, and those that were held up before it; or hold it up."""
        config, chance = self._config, self._random.random
        if self._held_ns == 0 and chance() < config.late:
            self._held_ns = state_ns + round(1e9 * config.late_s)
        self._waiting.append((state, state_ns))
        if state_ns < self._held_ns:
            return
        self._held_ns = 0
        while self._waiting:
            state, state_ns = self._waiting.popleft()
            if chance() < config.corrupt:
                state.record["crc"] ^= 1
            lost = chance() < config.reply_loss
            if not lost:
                self._write(state)
            done_ns, sampled_ns = self._now_ns(), state_ns - round(1e9 * config.sensing_latency_s)
            kind = Kind.LOSS if lost else Kind.SAMPLE
            self._truth.write(kind, 0, state_ns, sampled_ns, done_ns, done_ns - state_ns)


def _serve(
    legs: EmulatedLegs,
    config: UnitreeEmulation,
    reader: DataReader,
    sender: Sender,
    truth: TruthLog,
    start_ns: int,
    stop: StopFlag,
    parent_fd: int | None,
) -> None:
    """Send states and obey commands until ``stop`` is set; with ``parent_fd``, also until that pipe is closed."""
    faulty_ns = None if config.on_signal else start_ns
    due_ns, inputs = start_ns + _PERIOD_NS, [] if parent_fd is None else [parent_fd]
    while not stop.is_set:
        # Sleep until the next millisecond.
        now_ns = time.monotonic_ns()
        wait_s = 1e-9 * (_POLL_NS - (now_ns - start_ns) % _POLL_NS)
        if select.select(inputs, [], [], wait_s)[0] and not os.read(inputs[0], 1024):
            return
        now_ns = time.monotonic_ns()
        faulty_ns = stop.faulty_ns or faulty_ns
        late_s = config.silent_after_s
        silent = late_s is not None and faulty_ns is not None and now_ns - faulty_ns > 1e9 * late_s
        # Commands count from the time at which they were written.
        for message in reader.take(16):
            if isinstance(message, LowCmd) and not silent:
                written_ns = message.sample_info.source_timestamp  # pyright: ignore[reportAttributeAccessIssue]
                age_ns = max(0, time.time_ns() - written_ns)
                legs.receive(message, time.monotonic_ns() - age_ns)
        legs.advance(now_ns)
        truth.flush_if_due(now_ns)
        if now_ns < due_ns:
            continue
        # A process that was held up sends the newest state alone.
        state_ns = now_ns - (now_ns - due_ns) % _PERIOD_NS
        due_ns = state_ns + _PERIOD_NS
        if not silent:
            sender.send(legs.state(state_ns), state_ns)


def _free_domain() -> tuple[socket.socket, int]:
    """Return a domain that no program of this machine uses, not even an earlier robot's guardian, and its socket."""
    for domain in _DOMAINS:
        lock, heard = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
        try:
            lock.bind(("127.0.0.1", _LOCK_PORT + domain))
            heard.bind(("", _DDS_PORT + _DDS_PORTS * domain))
        except OSError:
            lock.close()
            continue
        finally:
            heard.close()
        return lock, domain
    raise HardwareLost("all DDS domains of this machine have an emulator", hint="end emulators that still run")


if __name__ == "__main__":
    sys.exit(main())
