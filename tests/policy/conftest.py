"""A small policy without JAX."""

import itertools

import numpy as np
import pytest

from sim2real.policy import ActionTerm, ObservationTerm, PolicyContract


@pytest.fixture(scope="session")
def contract():
    return PolicyContract(
        observation=(
            ObservationTerm("pendulum", ("1", "1", "rad/s")),
            ObservationTerm("past_actions", ("V",), history=2),
        ),
        action=(ActionTerm("voltage", "V", -2.0, 2.0), ActionTerm("brake", "1", 0.0, 0.1)),
        rate_hz=50.0,
        delays_s={"sensor -> agent": 0.012},
        trained_s={"round_trip_delay": (0.04, 0.05)},
        limits={"thdot_rad_s": 40.0},
        hashes={"log": "ab" * 32, "parameters": "cd" * 32},
    )


@pytest.fixture(scope="session")
def weights():
    rng = np.random.default_rng(0)
    sizes = (5, 64, 64, 2)
    out = {
        "log_std": np.array([-0.5, -0.5]),
        "mean": np.array([0.0, 0.1, -2.0, 0.0, 0.0]),
        "std": np.array([0.7, 0.7, 8.0, 1.2, 1.2]),
        "low": np.array([-2.0, 0.0]),
        "high": np.array([2.0, 0.1]),
    }
    for i, (n_in, n_out) in enumerate(itertools.pairwise(sizes)):
        out |= {
            f"layers.{i}.kernel": rng.normal(size=(n_in, n_out)) / np.sqrt(n_in),
            f"layers.{i}.bias": 0.1 * rng.normal(size=n_out),
        }
    return {name: value.astype(np.float32) for name, value in out.items()}


@pytest.fixture(scope="session")
def observations():
    rng = np.random.default_rng(1)
    return (rng.normal(size=(300, 5)) * np.array([0.7, 0.7, 20.0, 1.2, 1.2])).astype(np.float32)
