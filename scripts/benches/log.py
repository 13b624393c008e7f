"""The log: the cost of recording for a control loop, the content of a cut file, the time to read a range.

The robot has three nodes with six joints; a tick is eight messages. The yardsticks are mcap-ros2-support's writer in
the same loop with the same messages, mcap's reader on the same cuts, and the readers of mcap-ros2-support and rosbags
on the same range.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import struct
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from mcap_ros2.writer import Writer

from benches.rows import Report, Row, medians, row
from sim2real.errors import Sim2RealError
from sim2real.graph.episode import MessageRecord, StepRecord
from sim2real.log.reader import TruncatedLogWarning, read_log
from sim2real.log.writer import McapRecorder

JOINTS = 6
LOSS_S = 0.25
"""Longest loss of the newest data in a crash [s]."""
RANGE_S = 1.0
EPOCH_NS = 1_790_000_000_000_000_000
NODES = {"sensor": None, "agent": "sensor", "actuator": "agent"}
FIELDS = {"sensor": ("position", "velocity"), "agent": ("goal",), "actuator": ("goal",)}
QUICK = {"seconds": 0.5, "cuts": 3, "repeats": 1}

Step = tuple[StepRecord, dict[str, np.ndarray]]


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of this bench."""
    parser.add_argument("--seconds", type=float, default=30.0, help="length of the loop")
    parser.add_argument("--rate", type=float, default=200.0, help="rate of the loop [Hz]")
    parser.add_argument("--cuts", type=int, default=200, help="places at which the file is cut")
    parser.add_argument("--repeats", type=int, default=7, help="how often the range is read")


def run(options: argparse.Namespace) -> Report:
    """Record in real time, ours first, then read the log."""
    with tempfile.TemporaryDirectory() as scratch:
        log = Path(scratch) / "session.mcap"
        rows = loop(log, Path(scratch) / "theirs.mcap", options.rate, options.seconds)
        return {"rows": [*rows, truncations(log, options.cuts), range_read(log, options.repeats)]}


def outputs(k: int) -> dict[str, dict[str, np.ndarray]]:
    """Return the outputs of the nodes at tick k."""
    value = np.sin(0.01 * k + np.arange(JOINTS)).astype(np.float32)
    return {node: dict.fromkeys(fields, value) for node, fields in FIELDS.items()}


def tick_records(k: int, period_us: int) -> tuple[list[Step], list[MessageRecord]]:
    """Return the records of tick k: steps with their outputs, and messages."""
    begin, sent = k * period_us, outputs(k)
    steps = [
        (StepRecord(node, k, begin, begin + 100 * i, begin + 100 * i + 20, -1, begin + 100 * i + 80, 0), sent[node])
        for i, node in enumerate(NODES)
    ]
    messages = [
        MessageRecord(node, source, k, k, begin + 100 * i - 20, begin + 100 * i - 10)
        for i, (node, source) in enumerate(NODES.items())
        if source
    ]
    return steps, messages


def paced(write: Callable[[int], None], rate_hz: float, count: int) -> np.ndarray:
    """Call ``write`` once a period; return the durations of the calls, ``(count,)`` [ms]."""
    took, begin = np.zeros(count), time.perf_counter()
    for k in range(count):
        time.sleep(max(0.0, begin + k / rate_hz - time.perf_counter()))
        before = time.perf_counter()
        write(k)
        took[k] = 1e3 * (time.perf_counter() - before)
    return took


def loop(log: Path, other: Path, rate_hz: float, seconds: float) -> list[Row]:
    """Return the time of a tick of the loop that recording takes."""
    # Ours first: the recorder in the loop.
    count, period_us = round(rate_hz * seconds), round(1e6 / rate_hz)
    inputs = [(node, source) for node, source in NODES.items() if source]
    records = [tick_records(k, period_us) for k in range(count)]
    with McapRecorder(log, {"pipeline": "bench"}, {}, outputs(0), inputs) as recorder:
        recorder.start(EPOCH_NS, time.monotonic_ns())

        def ours(k: int) -> None:
            steps, messages = records[k]
            for record, output in steps:
                recorder.step(record, output)
            for record in messages:
                recorder.message(record)

        took = paced(ours, rate_hz, count)
    with open(log, "rb") as stream:
        decoded = list(make_reader(stream, decoder_factories=[DecoderFactory()]).iter_decoded_messages())
    ticks: list[list[Any]] = [[] for _ in range(count)]
    for item in decoded:
        ticks[item.message.sequence].append(item)
    with open(other, "wb") as stream:
        writer = Writer(stream)
        schemas = {
            s.id: writer.register_msgdef(s.name, s.data.decode())
            for s in {i.schema.id: i.schema for i in decoded}.values()
        }

        def theirs(k: int) -> None:
            for item in ticks[k]:
                schema, at = schemas[item.schema.id], item.message.log_time
                writer.write_message(item.channel.topic, schema, item.decoded_message, at, at, k)

        beside = paced(theirs, rate_hz, count)
        writer.finish()
    name, about = f"log/loop_{rate_hz:g}hz", "mcap_ros2.writer in the loop"
    return [
        row(f"{name}/{what}_ms", round(float(value(took)), 3), "ms", f"{value(beside):.3g} ms: {about}")
        for what, value in (("p50", np.median), ("p99", lambda x: np.quantile(x, 0.99)), ("max", np.max))
    ]


def truncations(log: Path, count: int) -> dict[str, Any]:
    """Return the number of cut files that open, and lose at most the last 0.25 s."""
    content = log.read_bytes()
    summary = make_reader(io.BytesIO(content)).get_summary()
    chunks = [(c.chunk_start_offset, c.chunk_length, c.message_end_time) for c in summary.chunk_indexes]
    cut = log.with_name("cut.mcap")
    opened = theirs = 0
    for position in np.random.default_rng(0).integers(chunks[0][0], chunks[-1][0] + chunks[-1][1], count):
        cut.write_bytes(content[:position])
        # The recording up to the cut ends with the chunk that the cut goes through.
        recorded_s = min((t - EPOCH_NS) / 1e9 for begin, size, t in chunks if begin + size > position)
        with warnings.catch_warnings(), contextlib.suppress(Sim2RealError):
            warnings.simplefilter("ignore", TruncatedLogWarning)
            opened += read_log(cut).duration_s >= recorded_s - LOSS_S
        with contextlib.suppress(McapError, struct.error):
            theirs += any(True for _ in make_reader(io.BytesIO(content[:position])).iter_messages())
    return row("log/truncations/opened", opened, f"of {count}", f"{theirs} open with mcap.reader", str(count))


def range_read(log: Path, repeats: int) -> dict[str, Any]:
    """Return the time to read one second, or less in a short log, from the middle of the log."""
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    length = read_log(log).duration_s
    start_s, end_s = length / 2, min(length / 2 + RANGE_S, length)
    limits = [EPOCH_NS + round(1e9 * s) for s in (start_s, end_s)]

    def mcap_ros2() -> None:
        with open(log, "rb") as stream:
            reader = make_reader(stream, decoder_factories=[DecoderFactory()])
            list(reader.iter_decoded_messages(starting_at=limits[0], ending_before=limits[1]))

    def rosbags() -> None:
        with AnyReader([log], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            for connection, _, raw in reader.messages(start=limits[0], stop=limits[1]):
                reader.deserialize(raw, connection.msgtype)

    programs = {"ours": lambda: read_log(log, start_s, end_s), "mcap_ros2": mcap_ros2, "rosbags": rosbags}
    ms = {name: 1e3 * s for name, s in medians(programs, repeats).items()}
    about = (
        f"{ms['mcap_ros2']:.3g} ms mcap_ros2, {ms['rosbags']:.3g} ms rosbags; {end_s - start_s:.3g} s of {length:.3g} s"
    )
    return row("log/range_read_ms", round(ms["ours"], 2), "ms", about)
