"""What the tests of the composer share: dm_control as the oracle, where it is installed."""

import importlib
from types import SimpleNamespace

import pytest


@pytest.fixture(scope="module", autouse=True)
def elsewhere(tmp_path_factory):
    """Run in a folder of its own: MuJoCo writes its warnings to a file in the current one."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("composer"))
        yield


@pytest.fixture(scope="session")
def oracle():
    """dm_control's composer and PyMJCF; tests that compare with them are skipped where they are not installed."""
    pytest.importorskip("dm_control", reason="the oracle: pip install dm-control==1.0.50")
    names = {
        "composer": "dm_control.composer",
        "mjcf": "dm_control.mjcf",
        "observable": "dm_control.composer.observation.observable",
        "updater": "dm_control.composer.observation.updater",
        "variation": "dm_control.composer.variation",
    }
    return SimpleNamespace(**{key: importlib.import_module(name) for key, name in names.items()})


@pytest.fixture(scope="session")
def ours():
    """The same modules of this package."""
    names = {
        "composer": "sim2real.composer",
        "mjcf": "sim2real.composer.mjcf",
        "observable": "sim2real.composer.observation.observable",
        "updater": "sim2real.composer.observation.updater",
        "variation": "sim2real.composer.variation",
    }
    return SimpleNamespace(**{key: importlib.import_module(name) for key, name in names.items()})
