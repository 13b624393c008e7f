"""Run this policy where neither sim2real nor JAX is installed: this file and the bundle beside it need numpy alone.

    python run_policy.py         # prints the action for the mean observation

Observations and actions, their order, units and bounds, and the rate: policy.json. Send no action that is not finite.
"""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np


def load(folder: Path) -> Callable[[np.ndarray], np.ndarray]:
    """Return the policy: observation, float32 of shape ``(O,)`` -> action ``(A,)``."""
    about, raw = json.loads((folder / "policy.json").read_text()), (folder / "policy.safetensors").read_bytes()
    if about["format_version"] != 1:
        raise ValueError(
            f"this file runs clipped tanh layers, not {about['network']}: run policy.onnx with onnxruntime"
        )
    clip = about["normaliser"]["clip"]
    begin = 8 + int.from_bytes(raw[:8], "little")
    w = {}
    for name, entry in json.loads(raw[8:begin]).items():
        if name != "__metadata__":
            start, end = (begin + offset for offset in entry["data_offsets"])
            w[name] = np.frombuffer(raw[start:end], "<f4").reshape(entry["shape"])
    count = sum(name.startswith("layers.") for name in w) // 2
    layers = [(w.pop(f"layers.{i}.kernel"), w.pop(f"layers.{i}.bias")) for i in range(count)]
    if set(w) != {"log_std", "mean", "std", "low", "high"}:
        raise ValueError(f"this file runs tanh layers, the bundle holds {sorted(w)} as well")

    def policy(observation: np.ndarray) -> np.ndarray:
        x = np.clip((np.asarray(observation, np.float32) - w["mean"]) / w["std"], -clip, clip)
        for kernel, bias in layers[:-1]:
            x = np.tanh(x @ kernel + bias)
        x = np.clip(x @ layers[-1][0] + layers[-1][1], -1.0, 1.0)
        return w["low"] + 0.5 * (w["high"] - w["low"]) * (x + 1.0)

    return policy


if __name__ == "__main__":
    here = Path(__file__).resolve().parent
    print(load(here)(np.array(json.loads((here / "policy.json").read_text())["normaliser"]["mean"])).tolist())
