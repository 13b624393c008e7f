"""Contracts that cannot be kept are refused."""

import json

import pytest

from sim2real.errors import UsageError
from sim2real.policy import ActionTerm, ObservationTerm, PolicyContract


def test_sizes_and_names_follow_the_terms(contract):
    assert contract.observation_size == 5
    assert contract.observation_names == [
        "pendulum[0][0]", "pendulum[0][1]", "pendulum[0][2]", "past_actions[0][0]", "past_actions[1][0]",
    ]  # fmt: skip


def test_json_round_trip(contract):
    assert PolicyContract.from_dict(json.loads(json.dumps(contract.to_dict()))) == contract


SEEN, DONE = (ObservationTerm("x", ("m",)),), (ActionTerm("u", "V", -1.0, 1.0),)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ObservationTerm("x", ()), "'x' needs at least one unit"),
        (lambda: ObservationTerm("x", "rad/s"), "one unit per entry"),
        (lambda: ObservationTerm("x", ("m",), history=0), "one step of history"),
        (lambda: ObservationTerm("x", ("m",), low=(0.0,)), r"has bounds low=\(0.0,\), high=\(\)"),
        (lambda: ObservationTerm("x", ("m",), low=(1.0,), high=(0.0,)), "finite and with low < high"),
        (lambda: ObservationTerm("x", ("m",), low=(0.0,), high=(float("inf"),)), "finite and with low < high"),
        (lambda: ActionTerm("u", "V", 1.0, 1.0), "low < high"),
        (lambda: ActionTerm("u", "V", 0.0, float("inf")), "finite bounds"),
        (lambda: PolicyContract((), DONE, 50.0), "at least one observation term"),
        (lambda: PolicyContract(SEEN * 2, DONE, 50.0), "observation term x appears more than once"),
        (lambda: PolicyContract(SEEN, DONE, 0.0), "rate_hz must be above 0"),
        (lambda: PolicyContract(SEEN, DONE, 50.0, delays_s={"a": -0.1}), "delay 'a' must be finite"),
    ],
)
def test_impossible_contracts_are_refused(make, message):
    with pytest.raises(UsageError, match=message):
        make()
