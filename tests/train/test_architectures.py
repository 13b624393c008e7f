"""Networks of a user: trained, exported, and refused where no robot could run them."""

import dataclasses
import json
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from environments import Bandit
from flax import linen

from sim2real.errors import Sim2RealError, UsageError
from sim2real.policy import ActionTerm, NetworkSpec, ObservationTerm, PolicyContract, load_bundle, save_bundle
from sim2real.training.config import PPOConfig
from sim2real.training.networks.architectures import make_network
from sim2real.training.networks.onnx_export import compare, export_graph
from sim2real.training.networks.policy import Policy
from sim2real.training.ppo.trainer import train

CONFIG = PPOConfig(
    num_envs=64, minibatches=4, rollout_steps=8, total_steps=20_000, hidden=(8,), evaluations=1, eval_steps=20,
    gamma=0.9, learning_rate=5e-3, reward_scale=1.0,
)  # fmt: skip
CONTRACT = PolicyContract(
    (ObservationTerm("wanted", ("1", "1")),), (ActionTerm("a", "1", -1.0, 3.0), ActionTerm("b", "1", 0.0, 10.0)), 50.0
)


EXTRA = "the extra network"


def importorskip():
    """Skip a test of what is exported where one of the packages is missing."""
    pytest.importorskip("jax2onnx", reason=EXTRA)
    pytest.importorskip("onnxruntime")


class Normalised(linen.Module):
    outputs: int

    @linen.compact
    def __call__(self, x):
        return linen.Dense(self.outputs)(linen.elu(linen.LayerNorm()(linen.Dense(32)(x))))


class Remembering(linen.Module):
    outputs: int

    @linen.compact
    def __call__(self, carry, x):
        first, x = linen.GRUCell(4)(carry[0], x)
        second, x = linen.LSTMCell(3)(carry[1], x)
        return (first, second), linen.Dense(self.outputs)(x)

    def initialize_carry(self, rng, shape):
        return jnp.full(4, 0.3), (jnp.zeros(3), jnp.ones(3))


@pytest.fixture(scope="module")
def learnt():
    importorskip()
    config = dataclasses.replace(CONFIG, network=f"{__name__}:Normalised", critic="mlp")
    return train(Bandit(), config, jax.random.key(0))


@pytest.mark.night
def test_its_bundle_runs_without_jax_and_without_its_code(learnt, tmp_path):
    policy = learnt.best
    assert learnt.history["success"][-1, 0] > 0.6
    folder = save_bundle(tmp_path, policy.to_weights(), CONTRACT, spec=policy.spec, graph=export_graph(policy))
    code = f"""
import json, sys
from sim2real.policy import load_bundle
runner = load_bundle({str(folder)!r})
print(json.dumps([runner.act([x, -x]).tolist() for x in (-0.7, 0.1, 2.0)]))
assert not {{"jax", "flax", "onnx"}} & set(sys.modules)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    expected = [policy.get_action(jnp.array([x, -x])) for x in (-0.7, 0.1, 2.0)]
    np.testing.assert_allclose(json.loads(done.stdout), expected, atol=1e-4)
    assert json.loads((folder / "policy.json").read_text())["format_version"] == 2
    with pytest.raises(UsageError, match=r"numpy does not run network[\s\S]*hint: backend='onnx'"):
        load_bundle(folder, "numpy")


@pytest.mark.night
def test_its_weights_make_the_same_policy(learnt):
    weights = learnt.best.to_weights()
    assert learnt.best.spec == NetworkSpec(f"{__name__}:Normalised")
    again = Policy.from_weights(weights, learnt.best.spec)
    assert jax.tree.structure(again) == jax.tree.structure(learnt.best)
    np.testing.assert_array_equal(again.params["Dense_0"]["kernel"], weights["network.Dense_0.kernel"])
    with pytest.raises(Sim2RealError, match=r"network.Dense_0.bias has shape \(3,\), that of .* has \(2,\)"):
        Policy.from_weights(weights | {"network.Dense_0.bias": np.zeros(3)}, learnt.best.spec)
    with pytest.raises(Sim2RealError, match=r"lack network.Dense_0.bias"):
        Policy.from_weights({n: a for n, a in weights.items() if n != "network.Dense_0.bias"}, learnt.best.spec)


def drawn(factory, seed=0, squash=False, inputs=6, outputs=2):
    rng, one = np.random.default_rng(seed), np.ones(outputs, np.float32)
    network = make_network(factory, (), inputs, outputs)
    mean, std = rng.normal(size=inputs).astype(np.float32), rng.uniform(0.5, 2.0, inputs).astype(np.float32)
    spec = NetworkSpec("a.user:Own", squash)
    return Policy(network.init(rng, inputs, 1.0), 0 * one, mean, std, -one, 2 * one, network, spec)


BLOCKS = {
    "tanh": jnp.tanh, "relu": linen.relu, "leaky": linen.leaky_relu, "elu": linen.elu, "selu": linen.selu,
    "swish": linen.swish, "gelu": linen.gelu, "exact gelu": lambda x: linen.gelu(x, approximate=False),
    "softplus": linen.softplus, "softmax": linen.softmax, "sigmoid": linen.sigmoid, "hard": linen.hard_tanh,
    "layer norm": lambda x: linen.LayerNorm()(x), "rms norm": lambda x: linen.RMSNorm()(x),
    "group norm": lambda x: linen.GroupNorm(2)(x), "dense": lambda x: linen.Dense(8)(x),
    "heads": lambda x: linen.MultiHeadDotProductAttention(2)(x.reshape(-1, 4)).ravel(),
    "residual": lambda x: x + linen.Dense(8)(x), "gated": lambda x: x * linen.sigmoid(linen.Dense(8)(x)),
    "parts": lambda x: jnp.concatenate([x[1::2], jnp.abs(x[:2]), -x[:2]]), "squares": lambda x: (x**2 - 1.0) / 4.0,
    "cubes": lambda x: jnp.sin(x) ** 3, "larger": lambda x: jnp.where(x > 0.1, x, jnp.max(x)),
    "sum": lambda x: x - jnp.mean(x),
    "turned": lambda x: x.reshape(2, 4).T.ravel(), "clip": lambda x: jnp.clip(x, -1, 1),
}  # fmt: skip


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.night)])
def test_what_is_exported_acts_as_in_jax(seed):
    """All blocks in pairs, drawn at random, one after the other; the export compares with JAX on 64 observations."""
    importorskip()
    drawn_blocks = np.random.default_rng(seed).permutation(sorted(BLOCKS))
    pairs = list(zip(drawn_blocks[::2], drawn_blocks[1::2], strict=True))

    class Module(linen.Module):
        outputs: int

        @linen.compact
        def __call__(self, x):
            x = linen.Dense(8)(x)
            return linen.Dense(self.outputs)(jnp.concatenate([BLOCKS[b](jnp.tanh(BLOCKS[a](x))) for a, b in pairs]))

    assert export_graph(drawn(Module, seed, squash=seed == 1)) is not None


@pytest.mark.night
def test_what_remembers_is_exported_with_what_it_begins_with(tmp_path):
    importorskip()
    policy = drawn(Remembering, inputs=2)
    contract = dataclasses.replace(CONTRACT, action=tuple(ActionTerm(name, "1", -1.0, 2.0) for name in "ab"))
    folder = save_bundle(tmp_path, policy.to_weights(), contract, spec=policy.spec, graph=export_graph(policy))
    runner = load_bundle(folder)
    x = np.random.default_rng(3).normal(size=(5, 2)).astype(np.float32)
    expected = jax.lax.scan(policy.step, policy.initial_carry(), x)[1]
    for _ in range(2):
        np.testing.assert_allclose([runner.act(row) for row in x], expected, atol=1e-5)
        runner.reset()


def test_an_export_that_differs_from_jax_is_refused():
    importorskip()
    model = export_graph(drawn(Normalised, 1))
    with pytest.raises(Sim2RealError, match=r"JAX and ONNX disagree by .* of the action range"):
        compare(drawn(Normalised, 0), model)


class Decomposed(linen.Module):
    outputs: int

    @linen.compact
    def __call__(self, x):
        return linen.Dense(self.outputs)(jnp.linalg.svd(jnp.outer(x, x))[1])


class Averaged(linen.Module):
    outputs: int

    @linen.compact
    def __call__(self, x):
        return linen.Dense(self.outputs)(linen.BatchNorm(use_running_average=True)(x))


class Wrong:
    """A network by itself, without flax."""

    def __init__(self, outputs, carry=(), shape=None):
        self.outputs, self.first, self.shape = outputs, carry, shape

    def init(self, rng, inputs, gain):
        return rng.normal(size=(inputs, self.shape or self.outputs)).astype(np.float32)

    def initial_carry(self):
        return self.first

    def apply(self, params, carry, x):
        return carry, x @ params


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        (Decomposed, r"Decomposed is not exported to ONNX, so no robot could run it: svd[\s\S]*hint: use layers that"),
        (Averaged, r"Averaged has variables besides its parameters: batch_stats[\s\S]*hint: .*LayerNorm"),
        (lambda n: Wrong(n, shape=5), r"returns float32 of shape \(5,\) for an input of shape \(3,\), .*\(2,\)"),
        (lambda n: Wrong(n, carry=np.int32(0)), "must keep the form of its initial carry, arrays of float32"),
        (lambda n, more: n, "cannot be made of its number of outputs alone: .*'more'"),
        (lambda n: n, "makes a int, neither a flax.linen.Module nor a Network"),
        ("transformer", "there is no network 'transformer'"),
        ("nowhere:Net", "cannot be imported: No module named 'nowhere'"),
        (f"{__name__}:CONFIG", "is a PPOConfig, no class"),
        ("os:_exit", "is a builtin_function_or_method, no class"),
    ],
)
def test_what_cannot_be_trained_or_exported_is_refused_before(kind, message):
    if kind is Decomposed:
        pytest.importorskip("jax2onnx", reason=EXTRA)
    with pytest.raises(UsageError, match=message):
        make_network(kind, (8,), 3, 2)


def test_without_jax2onnx_a_network_is_refused_before_training(monkeypatch):
    monkeypatch.setitem(sys.modules, "jax2onnx", None)
    with pytest.raises(
        UsageError, match=r"Normalised is exported to ONNX by jax2onnx, which is not installed[\s\S]*hint: pip"
    ):
        make_network(Normalised, (8,), 3, 2)
    assert make_network("gru", (8,), 3, 2).widths == (8, 2), "networks of this package need none"


def test_networks_without_flax_without_an_export_and_of_the_current_directory(tmp_path, monkeypatch):
    assert make_network(Decomposed, (), 3, 1, exported=False).initial_carry() == (), "a value function is not exported"
    (tmp_path / "my_nets.py").write_text("from flax import linen\nActor = linen.Dense\n")
    monkeypatch.chdir(tmp_path)
    assert make_network("my_nets:Actor", (), 3, 2).init(np.random.default_rng(0), 3, 1.0)["kernel"].shape == (3, 2)
    importorskip()
    assert export_graph(drawn(Wrong)) is not None
