"""A run folder of a robot that never was: a sine that is measured, predicted, learned and deployed."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from sim2real.artifacts.sensitivity import Moved, Sensitivity
from sim2real.emulation.truth import Kind, TruthLog
from sim2real.graph.episode import MessageRecord, StepRecord
from sim2real.log.writer import McapRecorder

EVIL = "<b>gain</b> & $x_1$"
"""A name that must neither become markup nor mathematics."""
PERIOD_US = 20_000
STEPS = 200
MONOTONIC_NS = 5_000_000_000
NODES = {"sensor": None, "agent": "sensor", "actuator": "agent"}
COLOR = "#663399"
"""The actuator's own, which also has an order: it stands first."""
UNITS = {"th": "rad", "thdot": "rad/s", "action": "V"}


def write_log(path: Path, steps: int = STEPS, end: bool = True) -> None:
    """Write a session of three nodes; the agent wakes 4 ms late at step 100."""
    graph = {
        n: {"rate_hz": 50.0, "delay_s": 0.002, "inputs": {s: {"from": s, "blocking": True}} if s else {}}
        for n, s in NODES.items()
    }
    graph["actuator"] |= {"color": COLOR, "order": 0}
    graph["agent"] |= {"color": "no such colour"}
    outputs: dict[str, Any] = {
        "sensor": {"th": np.float32(0), "thdot": np.float32(0)},
        "agent": {"action": np.zeros(1, np.float32)},
        "actuator": {"action": np.zeros(1, np.float32)},
    }
    metadata = {"pipeline": "pendulum", "graph": graph, "units": UNITS}
    inputs = [(n, s) for n, s in NODES.items() if s]
    recorder = McapRecorder(path, metadata, {}, outputs, inputs, {})
    recorder.start(1_790_000_000_000_000_000, MONOTONIC_NS)
    for k in range(steps):
        begin, t = k * PERIOD_US, k * PERIOD_US / 1e6
        action = np.array([np.sin(3 * t)], np.float32)
        values = {
            "sensor": {"th": np.float32(np.sin(t)), "thdot": np.float32(np.cos(t))},
            "agent": {"action": action},
            "actuator": {"action": action},
        }
        at = begin
        for number, node in enumerate(NODES):
            late = 4000 if (node, k) == ("agent", 100) else 50
            end_at = at + late + 1000
            recorder.step(StepRecord(node, k, begin + 500 * number, at, at + late, -1, end_at, 0), values[node])
            if number < 2:
                reader = list(NODES)[number + 1]
                recorder.message(MessageRecord(reader, node, k, k, end_at, end_at + 10))
            at = end_at + 10
    timing = {n: {"steps": steps, "period_s": [0.02] * 3, "lateness_s": [0.0] * 3, "overruns": 1} for n in NODES}
    if end:
        recorder.close("finished", 0, {"timing": timing, "lost_replies": 3, "monotonic_ns": MONOTONIC_NS, "bus": BUS})
    else:
        recorder.close()


BUS = {"sensor": {"transfer_us": [1230] * 3, "wait_us": [0] * 3}}


def write_truth(path: Path) -> None:
    """Write the truth at 200 Hz, from half a second before the episode."""
    log = TruthLog(path, {"state_names": ["th", "thdot", "voltage"], "truth": {}, "servo_ids": [1]})
    for k in range(-100, STEPS * 4 + 50):
        t_ns = MONOTONIC_NS + k * 5_000_000
        t = k * 0.005
        log.write(Kind.STATE, 0, 0, t_ns, 0, 0, (np.sin(t + 0.012), np.cos(t + 0.012), 0.0))
    log.close()


def entry(
    name: str, unit: str, kind: str, estimate: float, se: float | None, nominal: float, truth: float | None
) -> dict[str, Any]:
    """Return an identified parameter as in parameters.json; without a standard error it has no interval either."""
    low, high = (None, None) if se is None else (estimate - 2 * se, estimate + 2 * se)
    return {
        "name": name, "unit": unit, "kind": kind, "about": f"about {name}", "nominal": nominal,
        "estimate": estimate, "standard_error": se, "low95": low, "high95": high,
        "lower": 0.0 if kind != "dynamics" else nominal / 4, "upper": 0.06 if unit == "s" else nominal * 4,
        "state": "ok", "truth": truth,
    }  # fmt: skip


def parameters(truth: bool = True) -> dict[str, Any]:
    """Return parameters.json; ``truth``: with the true values, as of an emulated robot."""
    names = [EVIL, "friction", "sensor_delay"]
    ranges = {"mean": (67, 65, 69), "deviation": (38, 36, 40), "p95": (126, 124, 128), "lost": (300, 200, 400)}
    ends = ("value", "low95", "high95")
    link = {n: dict(zip(ends, (1e-4 * v for v in of), strict=True)) for n, of in ranges.items()}
    link |= {"delays": [0.004, 0.012], "share": [0.6, 0.4]}
    return {
        "format": 6,
        "pipeline": "pendulum",
        "logs": [{"path": "../record/session.mcap", "sha256": "0" * 64}],
        "verdict": {"status": "change the model", "reasons": ["at a bound: friction", "sensor_delay is <b>loose</b>"]},
        "parameters": [
            entry(EVIL, "rad/s^2/V", "dynamics", 21.0784, 0.0231, 26.96, 21.10 if truth else None),
            entry("friction", "rad/s^2", "dynamics", 8.507, None, 6.097, 8.482 if truth else None),
            entry("sensor_delay", "s", "delay", 0.01234, 0.0005, 0.0, 0.0119 if truth else None),
            entry("round_trip_delay", "s", "derived", 0.0448, 0.0001, 0.0, 0.0446 if truth else None),
        ],
        "posterior": {
            "names": names, "transform": ["linear"] * 3, "mean": [0.0] * 3, "lower": [-9.0] * 3, "upper": [9.0] * 3,
            "covariance": (np.eye(3) * 0.5 + 0.5).tolist(),
        },
        "errors": [
            {
                "log": "", "joint": n, "unit": "rad", "seconds": 1.0, "error": e, "as_good": g,
                "baselines": {"without delays": 0.2, "nominal": 0.58, "standing still": None},
            }
            for n, e, g in (("th", 0.0234, ["nominal"]), (EVIL, 0.0117, []))
        ],
        "worst": {
            "joint": "th", "field": "th", "unit": "rad", "log": "session.mcap", "begin_s": 3.0, "end_s": 3.98,
            "error": 0.01, "share_of_motion": 0.1,
        },
        "links": [{"name": "sensor_delay + actuator_delay", **link}],
        "units": UNITS,
    }  # fmt: skip


def predictions() -> dict[str, np.ndarray]:
    """Six segments of 1 s each; the last two are held out and overlap by half a second."""
    starts = [0.0, 1.0, 2.0, 3.0, 3.5, 4.1]
    t = np.concatenate([s + np.arange(0, 1.0, 0.02) for s in starts])
    segment = np.repeat(np.arange(len(starts)), 50)
    values = {
        "t": t, "segment": segment, "held_out": segment >= 3, "recording": np.zeros(t.shape, int),
        "into": t - np.array(starts)[segment], "worst": segment == 3,
    }  # fmt: skip
    for field, true in (("th", np.sin(t)), ("thdot", np.cos(t))):
        values |= {f"{field}_measured": true, f"{field}_identified": true + 0.01, f"{field}_nominal": 1.3 * true}
        values[f"{field}_without delays"] = 1.1 * true
    return values


def free_runs() -> dict[str, np.ndarray]:
    """One free run over all that is held out."""
    into = np.arange(0, 2.0, 0.02)
    t = 3.0 + into
    values = {
        "t": t, "into": into, "segment": np.zeros(t.shape, int), "recording": np.zeros(t.shape, int),
        "held_out": np.ones(t.shape, bool),
    }  # fmt: skip
    for field, true in (("th", np.sin(t)), ("thdot", np.cos(t))):
        values |= {f"{field}_measured": true, f"{field}_identified": true + 0.01, f"{field}_without delays": 30 * true}
    return values


def history(seeds: int = 3) -> dict[str, Any]:
    steps = [1000 * k for k in range(1, 11)]
    curves = [[-1300.0 / k - 10 * s for s in range(seeds)] for k in range(1, 11)]
    success = [[min(1.0, 0.1 * k) for _ in range(seeds)] for k in range(1, 11)]
    return {"steps": steps, "returns": curves, "success": success, "seconds": [1.5 * k for k in range(1, 11)]}


def result(simulated: bool = True) -> dict[str, Any]:
    real = {"success": 0.98, "first_upright_s": 1.375, "command_rms_v": 0.97}
    model = {"success": 1.0, "first_upright_s": 1.340, "command_rms_v": 0.46} if simulated else {}
    return {"format": 5, "episodes": [{"real": real, "simulation": model}] * 2}


def simulation() -> dict[str, np.ndarray]:
    """Two episodes: states at 100 Hz, commands at 50 Hz, the second one's with times of their own."""
    t = np.arange(1, 401) / 100
    found: dict[str, np.ndarray] = {}
    for i in range(2):
        found |= {f"{i}/t": t, f"{i}/th": np.sin(t), f"{i}/thdot": np.cos(t), f"{i}/command": np.sin(3 * t[::2])}
    return {**found, "1/t_command": t[::2] + 0.003}


def write_stage(run: Path, stage: str, folder: str | None = None, status: str = "finished") -> Path:
    """Write a stage's folder with its manifest."""
    path = run / (folder or stage)
    path.mkdir(parents=True)
    outputs = {"record": {"log": "session.mcap", "truth": "truth.bin"}, "train": {"history": "history.json"}}
    if stage == "record":
        write_log(path / "session.mcap")
        write_truth(path / "truth.bin")
    elif stage == "identify":
        (path / "parameters.json").write_text(json.dumps(parameters()))
        np.savez(path / "predictions.npz", **predictions())
        np.savez(path / "free_runs.npz", **free_runs())
    elif stage == "train":
        (path / "history.json").write_text(json.dumps(history()))
        multiples, success = (
            np.array([-2.0, -1.0, 1.0, 2.0]),
            {EVIL: (1.0, 1.0, 0.95, 0.9), "friction": (0.2, 0.9, 1, 1)},
        )
        moved = [Moved(n, "rad/s^2", 3.0, 0.25, 3.0 + 0.25 * multiples, np.array(s)) for n, s in success.items()]
        Sensitivity.of(multiples, 0.98, 16, moved).save(path / "sensitivity.json")
    else:
        for i in range(2):
            write_log(path / f"episode_{i}.mcap")
        (path / "result.json").write_text(json.dumps(result()))
        np.savez(path / "simulation.npz", **simulation())
        write_truth(path / "truth.bin")
    manifest = {
        "format": 1, "pipeline": "pendulum", "stage": stage, "status": status, "started": "2026-11-21T08:26:16+00:00",
        "duration_s": 6.875, "config": {"seed": 7, "gate": {"limit": 2.0}}, "inputs": {},
        "outputs": {n: {"path": f, "sha256": "ab" * 32} for n, f in outputs.get(stage, {}).items()},
        "summary": {"lost replies": 3}, "versions": {"sim2real": "0.1.0"},
    }  # fmt: skip
    (path / "manifest.json").write_text(json.dumps(manifest))
    return path


def write_run(root: Path) -> Path:
    """Write a run with all four stages, and a later attempt at identify that failed."""
    run = root / "pendulum" / "20261121-082616-360"
    for stage in ("record", "identify", "train", "deploy"):
        write_stage(run, stage)
    return run
