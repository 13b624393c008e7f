"""Small files of other recorders, all with the same signals: 50 samples of a command and of two joints."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

COUNT = 50
U = np.sin(0.3 * np.arange(COUNT))
Q = np.stack([np.cos(0.3 * np.arange(COUNT)), 0.01 * np.arange(COUNT)], axis=1)
STAMPS_US = 3501 + 20_000 * np.arange(COUNT) + np.arange(COUNT) ** 2 % 7
"""Irregular, as a real clock's."""

MAPPING = {
    "pipeline": "rig",
    "nodes": {
        "actuator": {"stamps": "t", "fields": {"action": {"source": ["u"], "unit": "V"}}},
        "sensor": {
            "stamps": "t",
            "fields": {
                "th": {"source": "q[:,0]", "unit": "rad", "scale": 2.0, "offset": 0.5},
                "q": {"source": "q", "unit": "rad"},
            },
        },
    },
}
TOML = """
pipeline = "rig"
[nodes.actuator]
rate_hz = 40.0
fields.action = { source = ["u"], unit = "V" }
[nodes.sensor]
stamps = "t"
fields.th = { source = "q[:,0]", unit = "rad" }
"""


def npz(path: Path, **changes: object) -> Path:
    """Write the signals as arrays; None leaves one out."""
    signals = {"t": STAMPS_US / 1e6, "u": U, "q": Q, "kp": np.float64(7.0), **changes}
    np.savez(path, **{name: value for name, value in signals.items() if value is not None})
    return path


def records(path: Path) -> Path:
    """Write JSON with a list of records and constants beside it."""
    entries = [
        {"t": t / 1e6, "u": u, "on": bool(i % 2), "state": {"q": q.tolist()}}
        for i, (t, u, q) in enumerate(zip(STAMPS_US.tolist(), U.tolist(), Q, strict=True))
    ]
    path.write_text(json.dumps({"meta": {"kp": 7}, "motor": "m1", "entries": entries}))
    return path
