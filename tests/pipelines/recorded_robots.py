"""What the tests of recorded robots share: episodes from arrays, public recordings, checks of their tables."""

import os
from pathlib import Path
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

from sim2real.graph.base import GraphState
from sim2real.graph.episode import Episode, Steps
from sim2real.identification.predictions import samples
from sim2real.log.importing.importer import import_file
from sim2real.log.importing.mapping import load_mapping

REPOSITORY = Path(__file__).resolve().parent.parent.parent
DATA = Path(os.environ.get("SIM2REAL_DATA", REPOSITORY.parent / "shared" / "data"))


def episode(stamps_s, **outputs):
    """Return a recording in which every node stepped at the same stamps."""
    at = np.round(np.asarray(stamps_s) * 1e6).astype(np.int64)
    none = np.full(len(at), -1)
    steps = {n: Steps(scheduled=at, start=at, woken=at, ts_overwrite=none, end=at, drift=0 * at) for n in outputs}
    return Episode(steps=steps, messages={}, outputs=outputs)


def public(pipeline, pattern, part=None):
    """Return files of a public data set as episodes, by name; without them the test is skipped."""
    files = sorted(DATA.glob(pattern))
    if not files:
        pytest.skip(f"no {pattern} in {DATA}; SIM2REAL_DATA names the folder of the public recordings")
    mapping = load_mapping(REPOSITORY / "pipelines" / pipeline / "import.toml")
    return {f.stem: import_file(f, mapping, part) for f in files}


def predictions(problem, values, settle_s=0.0):
    """Return times after settling, measurements and predictions, ``(N,)``, ``(N, channels)`` twice, a recording each.

    Args:
        problem: One segment a recording.
        values: Of all parameters.
        settle_s: What the initial state is estimated from [s].
    """
    columns = samples(problem, {"model": fixed(problem.table) | values}, settle_s)
    names = [c.position if c.index is None else f"{c.position}[{c.index}]" for c in problem.channels]
    found = []
    for r in np.unique(columns["recording"]):
        pick = (columns["recording"] == r) & (columns["into"] > settle_s)
        both = (np.stack([columns[f"{n}_{k}"][pick] for n in names], axis=1) for k in ("measured", "model"))
        found.append((columns["into"][pick] - settle_s, *both))
    return found


def fixed(table):
    """Return what no identification moves, by name: the tick that a sensor needs to interpolate."""
    return {p.name: p.nominal for p in table if not p.free}


def rmse(error):
    return np.sqrt(np.mean(np.square(error), axis=0))


def effects(problem, values, factor=0.1):
    """Return by how much each parameter moves the predictions [deviations], from values to ``factor`` of its bounds."""
    table = problem.table
    values = fixed(table) | values
    names = [n for n in values if table[n].free]
    rows = {n: np.full(len(names) + 1, v, np.float32) for n, v in values.items()}
    for i, n in enumerate(names):
        p = table[n]
        step = factor * (p.high - p.low)
        rows[n][i + 1] += step if values[n] + step <= p.high else -step
    copies, every = len(names) + 1, np.arange(problem.segments)
    spread = {n: np.repeat(r, len(every)) for n, r in rows.items()}
    still = np.zeros((copies * len(every), 2 * len(problem.channels)))
    residuals = problem.errors(spread, np.tile(every, copies), still)
    residuals = residuals.reshape(copies, len(every), *residuals.shape[1:])
    moved = np.abs(residuals[1:] - residuals[0]).reshape(len(names), -1).max(axis=1)
    return dict(zip(names, moved, strict=True))


class RecordedRobotConformance:
    """Tests of every robot that its recordings alone describe.

    A module inherits it with its pipeline, a state to start from, and a fixture ``problem``: of a recording that is
    simulated at its true values, ``truth``.
    """

    pipeline, start, truth = None, (0.7, -4.0), None

    def model(self):
        delay_s = self.pipeline.defaults.identify.max_delay_s
        return self.pipeline.identifiable(delay_s), delay_s

    def check_state(self, state, params):
        """Compare the world's first state with the measured one, which is the joints' own unless an encoder is off."""
        np.testing.assert_allclose(np.ravel([state.position, state.velocity]), self.start, rtol=1e-6)

    def test_the_sensor_reads_the_measured_start(self):
        model, delay_s = self.model()
        nodes = model.nodes(delay_s)
        values = {p.name: jnp.float32(p.low + 0.37 * (p.high - p.low)) for p in model.parameters}
        params = model.params(values, jnp.asarray(self.start))
        gs = GraphState(params=params)
        first = {-1: SimpleNamespace(data=nodes["world"].init_output(graph_state=gs))}
        _, read = nodes[model.sensor].step(SimpleNamespace(params=params.get(model.sensor), inputs={"world": first}))
        read = np.ravel(getattr(read, model.channels[0].position))
        np.testing.assert_allclose(read, self.start[: len(model.channels)], atol=2e-6)
        self.check_state(nodes["world"].init_state(graph_state=gs), params)

    def test_every_parameter_acts(self, problem):
        moved = effects(problem, self.truth)
        assert not {n: m for n, m in moved.items() if m < 1.0}
