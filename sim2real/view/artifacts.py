"""What train and deploy write, read and checked: from here on nothing has to doubt its input."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sim2real.view.files import blaming, check, read_arrays, read_json, read_number, read_numbers
from sim2real.view.run import Artifact
from sim2real.view.signals import Recording, Series, components, read_recording

_GAP = ("real", "simulation", "gap")


@dataclass(frozen=True)
class Training:
    """Learning curves: ``steps`` ``(K,)``; returns and success ``(K, seeds)``; ``seconds`` ``(K,)``.

    ``best_seed`` is the one whose policy was kept, if told.
    """

    steps: np.ndarray
    returns: np.ndarray
    success: np.ndarray
    seconds: np.ndarray
    best_seed: int | None


@dataclass(frozen=True)
class Deployment:
    """Episodes on the robot beside the same policy in simulation.

    Attributes:
        episodes: The robot's logs.
        simulated: For each episode the simulation's series, ``command`` among them; empty where nothing was simulated.
        scores: For each episode what ``result.json`` says of it: ``real`` and ``simulation``, empty likewise.
        gap: Rows with quantity, real, simulation and gap.
        units: Field or quantity -> unit, where told.
    """

    episodes: list[Recording]
    simulated: list[list[Series]]
    scores: Sequence[Mapping[str, Mapping[str, Any]]]
    gap: Sequence[Mapping[str, Any]]
    units: Mapping[str, str]


def read_training(artifact: Artifact) -> Training:
    """Read ``history.json``.

    Raises:
        Sim2RealError: When it is missing or not as it should be.
    """
    path = artifact.need("history", "history.json")
    with blaming(path, artifact):
        data = read_json(path)
        steps = read_numbers(data["steps"])
        returns, success = (read_numbers(data[name]).reshape(len(steps), -1) for name in ("return", "success"))
        seconds = read_numbers(data["seconds"]).reshape(len(steps))
        check(len(steps) > 0, "no evaluation")
        best = None if data.get("best_seed") is None else int(data["best_seed"])
        check(best is None or 0 <= best < returns.shape[1], f"no curve of seed {best}")
    return Training(steps, returns, success, seconds, best)


def read_deployment(artifact: Artifact) -> Deployment:
    """Read the logs, ``simulation.npz`` and ``result.json``; of a dry run there is no simulation.

    Raises:
        Sim2RealError: When one is missing or not as it should be.
    """
    path = artifact.need("result", "result.json")
    with blaming(path, artifact):
        data = read_json(path)
        if artifact.dry:  # nothing was moved: there is nothing to judge or to compare
            data = {**data, "episodes": [{"real": {}, "simulation": None} for _ in data["timing"]]}
        scores = [{"real": dict(e["real"]), "simulation": dict(e["simulation"] or {})} for e in data["episodes"]]
        check(bool(scores), "no episode")
        gap = [
            {"quantity": str(r["quantity"]), **{k: read_number(r[k]) for k in _GAP}, **_unit(r)} for r in data["gap"]
        ]
        units = {str(k): str(v) for k, v in data.get("units", {}).items()}
    simulated: list[list[Series]] = [[] for _ in scores]
    if not artifact.dry:
        path = artifact.need("simulation", "simulation.npz")
        with blaming(path, artifact):
            arrays = read_arrays(path)
            simulated = [_of_episode(arrays, i) for i in range(len(scores))]
    # The embedded robot may run on from one episode to the next: then one account holds the truth of all.
    truths = [artifact.output(f"truth_{i}", f"truth_{i}.bin") for i in range(len(scores))]
    common = artifact.output("truth", "truth.bin")
    episodes = [
        read_recording(artifact.need(f"log_{i}", f"episode_{i}.mcap"), truths[i] or common) for i in range(len(scores))
    ]
    return Deployment(episodes, simulated, scores, gap, units)


def _unit(row: Mapping[str, Any]) -> dict[str, str]:
    return {"unit": str(row["unit"])} if row.get("unit") else {}


def _of_episode(arrays: Mapping[str, np.ndarray], number: int) -> list[Series]:
    """Return the series of one simulated episode: fields ``NAME_i`` at times ``t_NAME_i``, else ``t_i``."""
    suffix = f"_{number}"
    own = {n.removesuffix(suffix): v for n, v in arrays.items() if n.endswith(suffix)}
    found: list[Series] = []
    for name, values in own.items():
        if name == "t" or name.startswith("t_"):
            continue
        t_s = own.get(f"t_{name.partition('[')[0]}", own["t"])  # a vector's entries share their times
        if len(t_s) != len(values):
            # Commands have a rate of their own: evenly over the same time, if nothing says when they were sent.
            t_s = np.arange(len(values)) * (float(own["t"][-1]) / len(values))
        found += components(name, "simulation", t_s, values)
    return found
