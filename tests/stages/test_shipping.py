"""``sim2real export --to policy``: a bundle that runs where nothing but numpy is."""

import hashlib
import itertools
import json
import subprocess
import venv

import numpy as np
import pytest

from sim2real.commands import export
from sim2real.commands.export import ExportConfig
from sim2real.errors import UsageError
from sim2real.policy import ActionTerm, ObservationTerm, PolicyContract, load_bundle, save_bundle, standalone
from sim2real.policy.bundle import sealed
from sim2real.policy.contract import NetworkSpec

SAME = """
import json, sys
import numpy as np
from pathlib import Path
from run_policy import BarePolicy

policy = BarePolicy(Path("."))
observations = np.array(json.loads(sys.argv[1]), np.float32)
print(json.dumps([policy(o).tolist() for o in observations]))
print(sorted({name.partition(".")[0] for name in sys.modules} & {"jax", "sim2real", "safetensors", "flax"}))
"""


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A run's bundle, and observations."""
    rng = np.random.default_rng(0)
    terms = (ObservationTerm("angle", ("1", "1")), ObservationTerm("speed", ("rad/s",)))
    contract = PolicyContract(terms, (ActionTerm("voltage", "V", -2.0, 1.0),), 50.0)
    sizes, weights = (3, 16, 8, 1), {"mean": rng.normal(size=3), "std": np.array([1.0, 0.5, 3.0])}
    weights |= {"low": np.array([-2.0]), "high": np.array([1.0]), "log_std": np.zeros(1)}
    for i, (a, b) in enumerate(itertools.pairwise(sizes)):
        weights |= {f"layers.{i}.kernel": rng.normal(size=(a, b)), f"layers.{i}.bias": rng.normal(size=b)}
    bundle = save_bundle(tmp_path_factory.mktemp("train") / "bundle", weights, contract)
    return bundle, rng.normal(size=(50, 3)).astype(np.float32)


@pytest.fixture(scope="module")
def bare(tmp_path_factory):
    """A Python with nothing installed but numpy, which it takes from where this one has it."""
    folder = tmp_path_factory.mktemp("bare")
    venv.create(folder / "venv", with_pip=False, symlinks=True)
    (site,) = (folder / "venv").glob("lib/python*/site-packages")
    home = np.__path__[0].removesuffix("/numpy")
    for part in ("numpy", "numpy.libs"):
        (site / part).symlink_to(f"{home}/{part}")
    return folder / "venv" / "bin" / "python"


def ask(python, code, *arguments, cwd):
    done = subprocess.run(
        [python, "-I", "-c", f"import sys; sys.path.insert(0, '.')\n{code}", *arguments],
        cwd=cwd, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


def test_the_policy_runs_on_a_bare_machine(trained, bare, tmp_path):
    bundle, observations = trained
    out = export.run(ExportConfig(str(bundle.parent), "policy", tmp_path / "out"))
    assert np.array_equal(load_bundle(out).act(observations[0]), load_bundle(bundle).act(observations[0]))
    for missing in ("jax", "sim2real", "safetensors"):
        assert ask(bare, f"import importlib.util as u; print(u.find_spec('{missing}'))", cwd=out) == ["None"]
    actions, imported = ask(bare, SAME, json.dumps(observations.tolist()), cwd=out)
    expected = [load_bundle(bundle).act(o).tolist() for o in observations]
    np.testing.assert_allclose(json.loads(actions), expected, atol=1e-6)
    assert imported == "[]"
    assert len((out / "run_policy.py").read_text().splitlines()) <= 37
    said = subprocess.run([bare, "-I", out / "run_policy.py"], capture_output=True, text=True, check=True).stdout
    assert -2.0 <= json.loads(said)[0] <= 1.0


@pytest.mark.parametrize(
    ("file", "named"), [("policy.json", "policy.json was changed"), ("policy.safetensors", "safetensors was changed")]
)
def test_the_example_refuses_a_changed_bundle(trained, tmp_path, file, named):
    out = export.run(ExportConfig(str(trained[0]), "policy", tmp_path / "out"))
    path = out / file
    content = path.read_bytes()
    # A digit of the rate, or the last byte of the weights.
    path.write_bytes(content.replace(b"50.0", b"90.0", 1) if file == "policy.json" else content[:-1] + b"\x7f")
    with pytest.raises(ValueError, match=named):
        standalone.BarePolicy(out)


def test_a_policy_with_other_layers_is_not_run_as_if_it_had_none(trained, bare, tmp_path):
    import safetensors.numpy

    out = export.run(ExportConfig(str(trained[0]), "policy", tmp_path / "out"))
    weights = safetensors.numpy.load((out / "policy.safetensors").read_bytes())
    more = {**weights, "memory.kernel": np.zeros((2, 2), np.float32), "memory.bias": np.zeros(2, np.float32)}
    content = safetensors.numpy.save(more)
    (out / "policy.safetensors").write_bytes(content)
    about = json.loads((out / "policy.json").read_text())
    about["files"]["policy.safetensors"] = hashlib.sha256(content).hexdigest()
    (out / "policy.json").write_text(json.dumps(sealed(about)))
    code = f"import sys; sys.path.insert(0, {str(out)!r})\nimport run_policy as r; r.BarePolicy(r.Path('.'))"
    done = subprocess.run([bare, "-I", "-c", code], cwd=out, capture_output=True, text=True, check=False)
    assert done.returncode != 0
    assert "memory" in done.stderr


def test_an_example_that_would_run_another_policy_is_not_written(trained, tmp_path, capsys):
    """Nor does the example run such a bundle, should it come beside one: squashed and clipped have the same arrays."""
    import safetensors.numpy

    weights = safetensors.numpy.load((trained[0] / "policy.safetensors").read_bytes())
    squashed = save_bundle(
        tmp_path / "bundle", weights, load_bundle(trained[0]).contract, spec=NetworkSpec("mlp", True)
    )
    out = export.run(ExportConfig(str(squashed), "policy", tmp_path / "out"))
    assert sorted(path.name for path in out.iterdir()) == ["policy.json", "policy.onnx", "policy.safetensors"]
    assert "run policy.onnx with onnxruntime" in capsys.readouterr().err
    with pytest.raises(ValueError, match="clipped tanh layers"):
        standalone.BarePolicy(squashed)


def test_a_folder_that_holds_something_is_left_alone(trained, tmp_path):
    (tmp_path / "mine").write_text("x")
    with pytest.raises(UsageError, match=r"(?s)not empty.*hint: .*--out"):
        export.run(ExportConfig(str(trained[0]), "policy", tmp_path))


def test_a_policy_must_be_named():
    with pytest.raises(UsageError, match=r"(?s)Pipelines: .*pendulum.*hint: "):
        export.run(ExportConfig(to="policy"))
