"""Runs this policy with numpy: `python run_policy.py`. policy.json describes observation, action and rate."""

import hashlib
import json
from pathlib import Path

import numpy as np


class BarePolicy:
    """The policy of a bundle: observation ``(O,)`` -> action ``(A,)``. Do not send an action that is not finite."""

    def __init__(self, folder: Path) -> None:
        about, raw = json.loads((folder / "policy.json").read_text()), (folder / "policy.safetensors").read_bytes()
        entries = {name: value for name, value in about.items() if name != "sha256"}
        seal = hashlib.sha256(json.dumps(entries, sort_keys=True).encode()).hexdigest()
        if about.get("sha256", seal) != seal:  # bundles of older versions have no hash
            raise ValueError("policy.json was changed: its hash differs from its sha256")
        if hashlib.sha256(raw).hexdigest() != about["files"]["policy.safetensors"]:
            raise ValueError("policy.safetensors was changed: its hash differs from the one in policy.json")
        begin, self.clip = 8 + int.from_bytes(raw[:8], "little"), about["normaliser"]["clip"]
        tensors = {n: (t["shape"], t["data_offsets"]) for n, t in json.loads(raw[8:begin]).items() if n[0] != "_"}
        self.w = {n: np.frombuffer(raw[begin + a : begin + b], "<f4").reshape(s) for n, (s, (a, b)) in tensors.items()}
        layers = range(sum("layers." in name for name in tensors) // 2)
        *self.hidden, self.out = [[self.w.pop(f"layers.{i}.{part}") for part in ("kernel", "bias")] for i in layers]
        if about["format_version"] != 1 or set(self.w) != {"log_std", "mean", "std", "low", "high"}:
            raise ValueError(f"not only clipped tanh layers, but {sorted(self.w)}: run policy.onnx with onnxruntime")

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        x = np.clip((np.asarray(observation, np.float32) - self.w["mean"]) / self.w["std"], -self.clip, self.clip)
        for kernel, bias in self.hidden:
            x = np.tanh(x @ kernel + bias)
        return self.w["low"] + (self.w["high"] - self.w["low"]) * np.clip((x @ self.out[0] + self.out[1] + 1) / 2, 0, 1)


if __name__ == "__main__":
    print(BarePolicy(Path(__file__).resolve().parent)(np.zeros(())).tolist())  # the action for an observation of zeros
