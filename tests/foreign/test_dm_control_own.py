"""dm_control's own tests of elements and of files, with our ``mjcf`` in place of its own: what fails is on the page.

The page is "Differences from dm_control"; each test that fails has its row there.
"""

import importlib.util
import re
import sys
import unittest
from pathlib import Path

import pytest

PAGE = Path(__file__).parents[2] / "docs" / "reference" / "differences.md"
IMPORTS = {
    "from dm_control import mjcf": "from sim2real.composer import mjcf",
    "from dm_control.mjcf import element": "from sim2real.composer.mjcf import element",
    "from dm_control.mjcf import parser": "from sim2real.composer import mjcf as parser",
}
FAILS = {
    "element_test": {"testActuatorReordering": "tree_surgery", "testProperties": "tree_surgery"},
    "export_with_assets_test": {"test_model_with_separators": "names_with_slashes"},
}  # fmt: skip
"""Module -> test that fails -> the row that says why."""


def with_our_imports(name, folder):
    """Return a module of dm_control's tests with other import lines, and nothing else changed."""
    spec = importlib.util.find_spec(f"dm_control.mjcf.{name}")
    text = Path(spec.origin).read_text()
    for theirs, ours in IMPORTS.items():
        text = re.sub(rf"^{re.escape(theirs)}$", ours, text, flags=re.MULTILINE)
    (folder / "test_assets").symlink_to(Path(spec.origin).with_name("test_assets"))  # which it looks for beside itself
    path = folder / f"{name}_with_ours.py"
    path.write_text(text)
    made = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(made)
    sys.modules[path.stem] = module
    made.loader.exec_module(module)
    return module


@pytest.mark.parametrize("name", FAILS)
def test_every_failure_is_on_the_page(name, tmp_path):
    pytest.importorskip("dm_control", reason="the oracle: pip install dm-control==1.0.50")
    flags = importlib.import_module("absl.flags").FLAGS
    if not flags.is_parsed():
        flags(["test"])
    suite = unittest.defaultTestLoader.loadTestsFromModule(with_our_imports(name, tmp_path))
    result = unittest.TestResult()
    suite.run(result)
    failed = {re.match(r"\w+", test.id().rsplit(".", 1)[1])[0] for test, _ in result.failures + result.errors}
    assert failed == FAILS[name].keys()
    assert result.testsRun >= 6
    for row in FAILS[name].values():
        assert f"| {row} |" in PAGE.read_text()
