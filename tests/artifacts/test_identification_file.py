"""What identify leaves: there and back through its files, and what is refused."""

import json
from dataclasses import fields, is_dataclass, replace

import numpy as np
import pytest

from sim2real.artifacts.identification import (
    Determined,
    Estimate,
    FreeRun,
    HeldOut,
    HeldOutPart,
    Identification,
    Judgement,
    Matrix,
    Prediction,
    Quantity,
    Refinement,
    Search,
)
from sim2real.artifacts.posterior import Posterior
from sim2real.artifacts.run.run_folder import Source
from sim2real.errors import Sim2RealError


@pytest.fixture
def found():
    """An identification with something in every field."""
    ones = np.ones(4)
    columns = {n: ones * i for i, n in enumerate(("t", "into", "segment", "recording", "held_out", "th_measured"))}
    return Identification(
        pipeline="pendulum",
        logs=(Source("record/session.mcap", "ab" * 32),),
        verdict=Judgement("accepted", ("because",), "sim2real train pendulum"),
        parameters=(Estimate("gain", "1", "dynamics", "about", 2.0, 0.1 + 0.2, "accepted", np.inf, None, 1e-300),),
        search=Search("cma", np.array([3.0, np.nan, 1.0]), 12, (Refinement(1.0, 0.5, 3),), 4.5),
        covariance=Matrix(("gain",), np.array([[1e-9]])),
        correlation=Matrix(("gain",), np.ones((1, 1))),
        residual_inflation=1.5,
        misfit=1.1,
        check=Determined(12.0, (("a", "b"),), ("only a + b",), {"gain": 0.1}),
        prediction=(Prediction("nominal", 0.5, True, {"th": np.nan}, {"th": 0.1}),),
        held_out=(HeldOut("tilt", "th", "rad", 1.0, {"identified": 0.1}, ("hold",)),),
        free_run=(FreeRun("hold", 0, 3.0, 9.0, True, "th", 0.2, 0.1),),
        aggregate=(Quantity("gain", "1", ones, ones, 1.0, 0.1, 0.2, 0.8, 1.2, True),),
        left_out=(HeldOutPart("0 to 9 s", ("drag",), {"gain": 0.3}, {"gain": 0.4}, {"th": 0.1}, {"th": np.inf}),),
        terms=("drag",),
        segments=4,
        held_out_from_s=30.0,
        settle_s=0.3,
        sigma={"th": 0.002},
        units={"th": "rad"},
        posterior=Posterior(("gain",), ("log",), np.zeros(1), np.eye(1), -np.ones(1), np.ones(1)),
        samples=columns,
        free={n: v[:2] for n, v in columns.items()},
    )


def same(a, b):
    """Whether two values are the same, where a file has null for what is infinite or no number."""
    if is_dataclass(a):
        return all(same(getattr(a, f.name), getattr(b, f.name)) for f in fields(a))
    if isinstance(a, dict | tuple):
        pairs = zip(a.values(), b.values(), strict=True) if isinstance(a, dict) else zip(a, b, strict=True)
        return len(a) == len(b) and all(same(x, y) for x, y in pairs)
    if isinstance(a, np.ndarray):
        return np.array_equal(np.where(np.isfinite(a), a, np.nan), b, equal_nan=True)
    return b is None if isinstance(a, float) and not np.isfinite(a) else a == b


def test_everything_comes_back_to_the_last_bit(found, tmp_path):
    assert found.save(tmp_path) == {
        "parameters": "parameters.json", "predictions": "predictions.npz", "free_runs": "free_runs.npz",
    }  # fmt: skip
    assert same(found, Identification.load(tmp_path))
    assert same(found, Identification.load(tmp_path / "parameters.json"))


def test_parameters_may_stand_alone(found, tmp_path):
    found.write(tmp_path / "mine.json")
    alone = Identification.load(tmp_path / "mine.json")
    assert (alone.samples, alone.free, alone.replays, alone.timing) == ({}, {}, {}, None)
    assert alone.values == {"gain": 0.1 + 0.2}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format": 2}, "has format 2, this version reads 3"),
        ({"parameters": [{"name": "gain"}]}, r"missing required field `unit` - at `\$.parameters\[0\]`"),
        ({"posterior": {"names": []}}, "posterior"),
        ({"correlation": {"names": ["a", "b"], "matrix": [[1.0]]}}, r"a matrix of \(1, 1\) for 2 names"),
        (
            {"held_out": [{"name": "x", "column": "x", "unit": "", "horizon_s": 1.0, "rmse": {}}]},
            "no error of the identified model",
        ),
        ({"verdict": None}, "Expected `object`, got `null`"),
    ],
)
def test_what_is_not_as_it_should_be_is_named(found, tmp_path, change, message):
    path = tmp_path / "parameters.json"
    found.write(path)
    path.write_text(json.dumps({**json.loads(path.read_text()), **change}))
    with pytest.raises(Sim2RealError, match=message) as caught:
        Identification.load(path)
    assert "parameters.json" in str(caught.value)
    assert caught.value.hint


def test_columns_of_mixed_lengths_are_refused(found, tmp_path):
    replace(found, samples={**found.samples, "th_nominal": np.ones(3)}).save(tmp_path)
    with pytest.raises(Sim2RealError, match="not one value a sample: th_nominal"):
        Identification.load(tmp_path)
