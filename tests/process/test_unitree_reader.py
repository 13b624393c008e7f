"""A reader with the types that a code generator makes gets our messages, over DDS."""

import time
from dataclasses import dataclass

import numpy as np
import pytest

idl = pytest.importorskip("cyclonedds.idl")
from cyclonedds.domain import DomainParticipant  # noqa: E402
from cyclonedds.pub import DataWriter  # noqa: E402
from cyclonedds.sub import DataReader  # noqa: E402
from cyclonedds.topic import Topic  # noqa: E402

from sim2real.hardware.unitree.messages import COMMAND_TOPIC, LowCmd  # noqa: E402

pytestmark = pytest.mark.process


def test_a_reader_of_generated_types_gets_the_message():
    fields = {"__annotations__": LowCmd.__annotations__, "__module__": __name__}
    generated = dataclass(type(idl.IdlStruct)("LowCmd", (idl.IdlStruct,), fields, typename=LowCmd.__idl_typename__))
    participant = DomainParticipant(97)
    writer = DataWriter(participant, Topic(participant, COMMAND_TOPIC, LowCmd))
    reader = DataReader(participant, Topic(participant, COMMAND_TOPIC, generated))
    message = LowCmd()
    message.record["motor_cmd"]["kd"] = np.arange(20) / 4
    message.sign()
    # Until they have found each other; if they never do, the limit of all tests ends this one.
    while not (received := reader.take(1)):
        writer.write(message)
        time.sleep(0.01)
    assert received[0].crc == int(message.record["crc"])
    assert [motor.kd for motor in received[0].motor_cmd] == (np.arange(20) / 4).tolist()
