"""A robot that never was: four nodes whose steps, messages and outputs are known in closed form."""

from __future__ import annotations

from typing import Any

import numpy as np
from flax import struct

from sim2real.graph.base import Base, Empty
from sim2real.graph.episode import MessageRecord, StepRecord
from sim2real.log.writer import SessionFile, _snapshot

EPOCH_NS = 1_790_000_000_123_456_789
RATE_HZ = 200
METADATA = {"pipeline": "fake", "seed": 7, "config": {"rate": 200.0, "gains": np.array([1.0, 2.0])}}
ATTACHMENTS = {"config.yaml": b"rate: 200\n", "model.bin": bytes(range(256))}
INPUTS = [("Sensor", "world"), ("agent", "sensorReading"), ("world", "agent"), ("monitor", "world")]
JOINTS = {
    "Sensor": {
        "hip": {"position": "th", "velocity": "rates[0]"},
        "knee": {"position": "rates[2]"},
    }
}


@struct.dataclass
class Reading(Base):
    th: Any
    rates: Any


@struct.dataclass
class Nested(Base):
    reading: Reading
    gripOpen: Any  # noqa: N815 - not every name is snake case


def outputs(k: int = 0) -> dict[str, Any]:
    """What the nodes send at their step k; k = 0 serves as the example."""
    return {
        "world": {
            "pose": np.arange(6, dtype=np.float32).reshape(2, 3) + k,
            "contact": k % 3 == 0,
            "Tick": np.int32(k),
            "stamp": np.uint64(k),
            "none": np.zeros((0, 2), np.float32),
        },
        "Sensor": Reading(th=np.float32(0.001 * k), rates=np.array([k, -k, 0.5 * k])),
        "agent": Nested(Reading(np.float64(k), np.full(1, k, np.int16)), np.bool_(k % 2)),
        "monitor": Empty(),
    }


def records(k: int) -> tuple[list[StepRecord], list[MessageRecord]]:
    """Steps and messages of tick k. Every message is consumed by its reader's next step, the agent's never."""
    begin = k * 1_000_000 // RATE_HZ
    steps = [
        StepRecord(node, k, begin, begin + 10 * i, begin + 10 * i + 3, -1 if k % 2 else begin + 5, begin + 500 + i, i)
        for i, node in enumerate(outputs())
    ]
    messages = [
        MessageRecord(node, name, k, -1 if node == "world" else k + 1, begin + 500, begin + 700 + i)
        for i, (node, name) in enumerate(INPUTS)
    ]
    return steps, messages


def feed(ticks: range, *recorders: Any) -> None:
    """Report ticks to recorders; a message's fate is known one tick later."""
    for k in ticks:
        values = outputs(k)
        steps, _ = records(k)
        for recorder in recorders:
            for record in steps:
                recorder.step(record, values[record.node])
            if k:
                for message in records(k - 1)[1]:
                    recorder.message(message)


def arguments() -> tuple[Any, ...]:
    """Arguments of a recorder behind its path."""
    return METADATA, ATTACHMENTS, outputs(), INPUTS, JOINTS


class Flushed:
    """Writes a session file directly, flushed every 0.2 s of the fake robot's time, however fast it is fed."""

    def __init__(self, file: SessionFile) -> None:
        self.file = file
        self.next_flush = 200_000

    def step(self, record: StepRecord, output: Any) -> None:
        names = dict.fromkeys(outputs()["world"]) if record.node == "world" else {}
        self.file.step(record, _snapshot(record.node, output, names))
        if record.end >= self.next_flush:
            self.file.flush()
            self.next_flush += 200_000

    def message(self, record: MessageRecord) -> None:
        self.file.message(record)
