"""dm_control's own tests, with our ``mjcf`` and ``composer`` in place of its own: what fails is on the page.

The page is "Differences from dm_control"; each test that fails has its row there.
"""

import importlib.util
import re
import sys
import unittest
import unittest.mock
import warnings
from pathlib import Path

import pytest

PAGE = Path(__file__).parents[2] / "docs" / "reference" / "differences.md"
IMPORTS = {
    "from dm_control import mjcf": "from sim2real.composer import mjcf",
    "from dm_control.mjcf import element": "from sim2real.composer.mjcf import element",
    "from dm_control.mjcf import parser": "from sim2real.composer import mjcf as parser",
    "from dm_control.mjcf import physics as mjcf_physics": (
        "from sim2real.composer.physics.c import physics as mjcf_physics"
    ),
    "from dm_control import composer": "from sim2real import composer",
    "from dm_control.composer import define": "from sim2real.composer import define",
    "from dm_control.composer import entity": "from sim2real.composer import entity",
    "from dm_control.composer import environment": "from sim2real.composer import environment",
    "from dm_control.composer import arena": "from sim2real.composer import arena",
    "from dm_control.composer.observation import observable": "from sim2real.composer.observation import observable",
    "from dm_control.composer.observation import updater": "from sim2real.composer.observation import updater",
    "from dm_control.composer.observation.observable import base as observable": (
        "from sim2real.composer.observation.observable import base as observable"
    ),
    "from dm_control.composer.variation import deterministic": "from sim2real.composer.variation import deterministic",
    "from dm_control.composer.variation import noises": "from sim2real.composer.variation import noises",
    "from dm_control.composer import variation": "from sim2real.composer import variation",
    "from dm_control.composer.variation import base": "from sim2real.composer.variation import base",
}
FAILS = {
    "mjcf.element_test": {"testActuatorReordering": "tree_surgery", "testProperties": "tree_surgery"},
    "mjcf.export_with_assets_test": {"test_model_with_separators": "tree_surgery"},
    "mjcf.physics_test": {
        "test_bind_mocap_body": "", "test_error_when_pickling_synchronizing_array_wrapper": "", "test_exceptions": "",
    },
    "composer.entity_test": {}, "composer.environment_test": {}, "composer.observation.updater_test": {},
    "composer.variation.noises_test": {}, "composer.variation.variation_test": {},
    "mjcf.export_with_assets_as_zip_test": {},
}  # fmt: skip
"""Module -> test that fails -> the row that says why; none where more works here, or a private name is looked for."""


def with_our_imports(name, folder):
    """Return a module of dm_control's tests with other import lines, and nothing else changed."""
    spec = importlib.util.find_spec(f"dm_control.{name}")
    text = Path(spec.origin).read_text()
    for theirs, ours in IMPORTS.items():
        text = re.sub(rf"^{re.escape(theirs)}$", ours, text, flags=re.MULTILINE)
    if (assets := Path(spec.origin).with_name("test_assets")).exists():
        (folder / "test_assets").symlink_to(assets)  # which it looks for beside itself
    path = folder / f"{name.replace('.', '_')}_with_ours.py"
    path.write_text(text)
    made = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(made)
    sys.modules[path.stem] = module
    made.loader.exec_module(module)
    return module


@pytest.mark.parametrize("name", FAILS)
def test_every_failure_is_on_the_page(name, tmp_path, monkeypatch):
    pytest.importorskip("dm_control", reason="the oracle: pip install dm-control==1.0.50")
    monkeypatch.setitem(sys.modules, "mock", unittest.mock)
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warnings to a file there
    flags = importlib.import_module("absl.flags").FLAGS
    if not flags.is_parsed():
        flags(["test"])
    suite = unittest.defaultTestLoader.loadTestsFromModule(with_our_imports(name, tmp_path))
    result = unittest.TestResult()
    with warnings.catch_warnings(action="ignore"):
        suite.run(result)
    failed = {re.match(r"\w+", test.id().rsplit(".", 1)[1])[0] for test, _ in result.failures + result.errors}
    assert failed == FAILS[name].keys()
    assert result.testsRun >= 3
    for row in filter(None, FAILS[name].values()):
        assert f"| {row} |" in PAGE.read_text()
