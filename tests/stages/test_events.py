"""Files for TensorBoard hold the curves, one folder for each policy."""

import sys

import numpy as np
import pytest
from tensorboardX.proto.event_pb2 import Event

from sim2real.errors import Sim2RealError
from sim2real.stages.train.tensorboard import event_files
from sim2real.training.ppo.result import Progress


def scalars(folder):
    """Return (name, step, value) of an event file, read by its format: length, check sum, message, check sum."""
    data, found = next(folder.glob("events.*")).read_bytes(), []
    while data:
        size = int.from_bytes(data[:8], "little")
        event = Event.FromString(data[12 : 12 + size])
        found += [(value.tag, event.step, round(value.simple_value, 4)) for value in event.summary.value]
        data = data[16 + size :]
    return found


def test_each_policy_has_its_curves(tmp_path):
    names = ["gamma=0.9, seed 0", "gamma=0.9, seed 1"]
    with event_files(tmp_path, names) as write:
        for number in (1, 2):
            values = {"return": np.float32([-number, -2.5]), "reward/angle": np.float32([0.5, number])}
            write(Progress(number, 2, 100 * number, 1.0, values))
    assert scalars(tmp_path / "gamma=0.9_seed_0") == [
        ("return", 100, -1.0), ("reward/angle", 100, 0.5), ("return", 200, -2.0), ("reward/angle", 200, 0.5),
    ]  # fmt: skip
    assert scalars(tmp_path / "gamma=0.9_seed_1")[-1] == ("reward/angle", 200, 2.0)


def test_without_tensorboardx_the_error_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "tensorboardX", None)
    needed = r"need tensorboardX[\s\S]*hint: pip install 'tensorboard"
    with pytest.raises(Sim2RealError, match=needed), event_files(tmp_path, ["seed 0"]):
        pass
