"""A policy that leaves one machine and arrives on another."""

import contextlib
import dataclasses
import functools
import hashlib
import json
import subprocess
import sys

import numpy as np
import pytest
import safetensors.numpy

from sim2real.errors import SafetyStop, Sim2RealError, UsageError
from sim2real.policy import (
    BlendedRunner,
    PolicyReference,
    PolicyRunner,
    UprightRunner,
    load_bundle,
    read_weights,
    save_bundle,
)
from sim2real.policy.bundle import sealed


@pytest.fixture
def bundle(tmp_path, weights, contract, observations):
    return save_bundle(tmp_path / "bundle", weights, contract, observations)


@pytest.fixture(params=["numpy", "onnx"])
def runner(request, bundle):
    if request.param == "onnx":
        pytest.importorskip("onnxruntime")
    return load_bundle(bundle, request.param)


def test_actions_equal_the_jax_policy(runner, weights, observations):
    import jax

    from sim2real.training.networks.policy import Policy

    reference = np.asarray(jax.vmap(Policy.from_weights(weights).get_action)(observations))
    found = np.stack([runner.act(observation) for observation in observations])
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, reference, atol=2e-6)
    assert len(np.unique(found[:, 0])) > 100, "most actions are at their bounds: this tests too little"


def test_the_bundle_says_how_well_its_runner_agrees_with_jax(tmp_path, weights, contract, observations):
    import jax

    from sim2real.training.networks.policy import Policy

    actions = np.asarray(jax.vmap(Policy.from_weights(weights).get_action)(observations))
    references = {"log": PolicyReference(observations[:200], actions[:200])}
    folder = save_bundle(tmp_path / "same", weights, contract, references=references)
    parity = json.loads((folder / "policy.json").read_text())["parity"]["log"]
    assert parity["samples"] == 200
    assert 0.0 < parity["largest"] < 1e-5
    off = PolicyReference(observations, actions + np.float32([0.001, 0.0]))  # of a range of 4 V
    with pytest.raises(Sim2RealError, match=r"(?s)disagrees with JAX by 2.5.e-04 .* of the training.*hint: "):
        save_bundle(tmp_path / "other", weights, contract, references={"training": off})
    assert not (tmp_path / "other").exists()


def test_a_policy_is_let_in_slowly_in_every_episode(bundle, observations):
    policy = load_bundle(bundle)
    assert np.array_equal(BlendedRunner(policy, 0.0)(observations[0]), policy.act(observations[0]))
    blended = BlendedRunner(policy, blend_s=0.08)  # four steps at 50 Hz
    expected = policy.act(observations[0])
    for _ in range(2):
        blended.reset()
        shares = [blended(observations[0]) / expected for _ in range(6)]
        np.testing.assert_allclose(shares, np.outer([0.0, 0.25, 0.5, 0.75, 1.0, 1.0], [1.0, 1.0]), rtol=1e-6)


def test_a_simulated_deployment_lets_the_policy_in_as_the_robot_does(bundle, weights, observations):
    from sim2real.training.networks.policy import BlendedPolicy, Policy

    on_robot, simulated = BlendedRunner(load_bundle(bundle), 0.08), BlendedPolicy(Policy.from_weights(weights), 4.0)
    carry = simulated.initial_carry()
    for observation in observations[:7]:
        carry, action = simulated.step(carry, observation)
        np.testing.assert_allclose(action, on_robot(observation), atol=2e-6)


def test_a_robot_that_leans_too_far_is_stopped(bundle, observations):
    policy = load_bundle(bundle)
    leaning = UprightRunner(policy, lambda seen: float(seen[0]), 0.5)
    leaning.reset()
    upright, policy_says = np.zeros(5, np.float32), policy.act(np.zeros(5, np.float32))
    np.testing.assert_array_equal(leaning(upright), policy_says)
    for tilt, said in ((0.6, "0.6 rad"), (-0.6, "-0.6 rad"), (np.nan, "nan rad")):
        with pytest.raises(SafetyStop, match=f"leans by {said}, more than the 0.5 rad that are allowed"):
            leaning(np.array([tilt, 0, 0, 0, 0], np.float32))


def test_actions_stay_within_the_contract(runner):
    rng = np.random.default_rng(2)
    actions = np.stack([runner.act(1e6 * rng.normal(size=5)) for _ in range(100)])
    for i, term in enumerate(runner.contract.action):
        assert actions[:, i].min() >= np.float32(term.low)
        assert actions[:, i].max() <= np.float32(term.high)


def test_onnx_carries_the_contract(tmp_path, contract, weights, observations):
    """Names with commas stay apart."""
    onnx = pytest.importorskip("onnx")
    terms = [dataclasses.replace(term, name=f"cos, sin, {term.name}") for term in contract.observation]
    renamed = dataclasses.replace(contract, observation=tuple(terms))
    folder = save_bundle(tmp_path / "renamed", weights, renamed, observations)
    assert load_bundle(folder).contract == renamed
    assert all(np.array_equal(value, weights[name]) for name, value in read_weights(folder).items())
    model = onnx.load(folder / "policy.onnx")
    properties = {entry.key: entry.value for entry in model.metadata_props}
    assert properties["action_names"] == "voltage,brake"
    names = [name.replace(";", ",") for name in properties["observation_names"].split(",")]
    assert names == renamed.observation_names
    assert [d.dim_value for d in model.graph.input[0].type.tensor_type.shape.dim] == [1, 5]


def test_wrong_observations_are_refused(runner):
    with pytest.raises(Sim2RealError, match=r"shape \(4,\), the policy expects \(5,\): pendulum 1x3[\s\S]*hint: "):
        runner.act(np.zeros(4))
    with pytest.raises(SafetyStop, match=r"observation pendulum\[0\]\[2\], past_actions\[1\]\[0\] is not finite"):
        runner.act(np.array([0.0, 0.0, np.nan, 0.0, np.inf]))


@pytest.mark.parametrize(("name", "backend"), [("policy.safetensors", "numpy"), ("policy.onnx", "onnx")])
def test_damaged_files_are_refused(bundle, name, backend):
    content = bytearray((bundle / name).read_bytes())
    content[-3] ^= 1
    (bundle / name).write_bytes(bytes(content))
    with pytest.raises(Sim2RealError, match=rf"{name} is not what was exported[\s\S]*hint: "):
        load_bundle(bundle, backend)
    with pytest.raises(Sim2RealError, match="is a file; a policy bundle is a folder"):
        load_bundle(bundle / name)
    with pytest.raises(UsageError, match="no policy backend 'torch'; available: numpy, onnx"):
        load_bundle(bundle, "torch")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda about: about | {"format_version": 99}, "has format version 99, this sim2real reads 1"),
        (
            lambda about: {k: v for k, v in about.items() if k != "rate_hz"},
            "contract is incomplete or wrong: .*`rate_hz`",
        ),
        (
            lambda about: about | {"observation": about["observation"][:1]},
            r"mean has shape \(5,\), the contract asks for",
        ),
        (lambda about: [about], "has format version None"),
    ],
)
def test_a_contract_that_does_not_fit_is_refused(bundle, change, message):
    path = bundle / "policy.json"
    path.write_text(json.dumps(change(json.loads(path.read_text()))))
    with pytest.raises(Sim2RealError, match=message):
        load_bundle(bundle)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        (
            "layers.1.kernel",
            np.zeros((3, 64)),
            r"layers\.1\.kernel has shape \(3, 64\), the contract asks for \(64, 64\)",
        ),
        ("high", np.array([2.0, 0.2], np.float32), "high bounds are"),
        ("std", np.nan, "std has values that are not finite"),
        ("std", 0.0, "standard deviations down to 0"),
        ("std", -1.0, "standard deviations down to -1"),
        ("layers.1.kernel", 1e38, r"layers\.1\.kernel holds values up to 1e\+38"),
        ("layers.0.bias", -1e9, r"layers\.0\.bias holds values up to 1e\+09"),
        ("mean", 3e38, "mean holds values up to 3e"),
    ],
)
def test_absurd_weights_are_refused(bundle, tmp_path, weights, contract, name, value, message):
    bent = {n: v.copy() for n, v in weights.items()}
    if np.ndim(value):
        bent[name] = value
    else:
        bent[name].flat[0] = value
    with pytest.raises(Sim2RealError, match=message):
        save_bundle(tmp_path / "a", bent, contract)
    assert not (tmp_path / "a").exists()
    content = safetensors.numpy.save(bent)  # and a bundle that was made by hand, with the right hash
    (bundle / "policy.safetensors").write_bytes(content)
    about = json.loads((bundle / "policy.json").read_text())
    about["files"]["policy.safetensors"] = hashlib.sha256(content).hexdigest()
    (bundle / "policy.json").write_text(json.dumps(about))
    with pytest.raises(Sim2RealError, match=message):
        load_bundle(bundle)


def test_a_graph_that_breaks_the_contract_is_held_to_it(contract):
    runner = PolicyRunner(contract, lambda observation: np.array([[1e9, -1e9]], np.float32))
    np.testing.assert_array_equal(runner.act(np.zeros(5)), np.array([2.0, 0.0], np.float32))


def places(value, path=()):
    """Yield the path of each entry of a JSON document, of lists the first two."""
    yield path
    entries = value.items() if isinstance(value, dict) else enumerate(value[:2]) if isinstance(value, list) else ()
    for key, entry in entries:
        yield from places(entry, (*path, key))


def changed(about, path, value):
    about = json.loads(json.dumps(about))
    place = functools.reduce(lambda entry, key: entry[key], path[:-1], about)
    place[path[-1]] = value
    return about


def test_every_entry_is_covered_by_the_hash(bundle):
    path = bundle / "policy.json"
    whole = json.loads(path.read_text())
    path.write_text(json.dumps(whole, indent=7, sort_keys=True))  # another layout is the same content
    load_bundle(bundle)
    for place in places(whole):
        for value in (None, -1, 1e308, float("nan"), "x", [], {}, True, "../../etc/passwd", 10**400):
            if place and changed(whole, place, value) != whole:
                path.write_text(json.dumps(changed(whole, place, value)))
                with pytest.raises(Sim2RealError):
                    load_bundle(bundle)
    for name in whole:
        path.write_text(json.dumps({key: value for key, value in whole.items() if key != name}))
        with contextlib.nullcontext() if name == "sha256" else pytest.raises(Sim2RealError):
            load_bundle(bundle)  # bundles of older versions have no hash of their own


@pytest.mark.parametrize(
    ("path", "value"),
    [
        (("rate_hz",), 1e308), (("rate_hz",), 1e-9), (("rate_hz",), "50"), (("rate_hz",), True),
        (("delays_s", "sensor -> agent"), 1e6), (("delays_s", "sensor -> agent"), "0.01"),
        (("trained_s", "round_trip_delay"), [0.0, 1e9]), (("trained_s", "round_trip_delay"), "12"),
        (("limits", "thdot_rad_s"), 1e300), (("limits", "thdot_rad_s"), float("inf")),
        (("limits", "thdot_rad_s"), None),
        (("action", 0, "low"), -1e300), (("action", 0, "unit"), 5), (("action", 0, "name"), ""),
        (("observation", 0, "history"), 1.5), (("observation", 0, "history"), 10**9),
        (("observation", 0, "units"), "rad"),
        (("hashes", "log"), 7),
    ],
)  # fmt: skip
def test_values_that_no_policy_has_are_refused_though_the_hash_is_right(bundle, path, value):
    file = bundle / "policy.json"
    file.write_text(json.dumps(sealed(changed(json.loads(file.read_text()), path, value))))
    with pytest.raises(Sim2RealError, match=r"hint: |must be|is no"):
        load_bundle(bundle)


def test_running_a_bundle_imports_neither_jax_nor_onnx(bundle):
    code = f"""
import sys, numpy
from sim2real.policy import load_bundle
load_bundle({str(bundle)!r}).act(numpy.zeros(5))
print(sorted({{"jax", "flax", "onnx", "onnxruntime", "torch"}} & set(sys.modules)))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
