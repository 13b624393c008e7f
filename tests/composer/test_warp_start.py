"""How MJX-Warp starts and what it refuses before a kernel is compiled: tests that need no Warp."""

from types import SimpleNamespace

import jax
import pytest

from sim2real import composer
from sim2real.composer import mjcf
from sim2real.composer.physics.mjx.warp import warp
from sim2real.errors import UsageError

BALL = '<mujoco><worldbody><body><freejoint/><geom size=".1"/></body></worldbody></mujoco>'


@pytest.fixture
def stub(monkeypatch):
    """MJX behaves as if Warp were installed."""
    monkeypatch.setattr("mujoco.mjx.warp.WARP_INSTALLED", True)
    monkeypatch.setattr("mujoco.mjx.warp.mujoco_warp", SimpleNamespace())


@pytest.fixture
def task():
    return composer.NullTask(composer.ModelWrapperEntity(mjcf.from_xml_string(BALL)))


@pytest.mark.parametrize("chosen", [None, "cpu", "device"])
def test_it_starts_on_the_device_that_jax_computes_on(stub, chosen):
    cpu = jax.devices("cpu")[0]
    with jax.default_device(cpu if chosen == "device" else chosen):
        assert warp.find_device() == cpu


def test_a_device_that_warp_does_not_know_is_refused(stub, monkeypatch):
    monkeypatch.setattr(warp.jax, "devices", lambda kind=None: [SimpleNamespace(platform="tpu")] if not kind else [])
    with pytest.raises(UsageError, match="Warp runs on CUDA devices and on the CPU"):
        warp.find_device()


def test_without_the_package_the_hint_names_what_to_install(task, monkeypatch):
    monkeypatch.setattr("mujoco.mjx.warp.WARP_INSTALLED", False)
    with pytest.raises(UsageError, match="mujoco-mjx"):
        composer.MjxEnvironment(task, impl="warp")


@pytest.mark.parametrize("name", ["nconmax", "njmax"])
def test_no_room_at_all_is_refused(task, name):
    with pytest.raises(UsageError, match=f"{name} is a number of at least 1, got 0"):
        composer.MjxEnvironment(task, impl="warp", **{name: 0})


def test_other_implementations_and_misplaced_options_are_refused(task):
    with pytest.raises(UsageError, match="no implementation 'cpp'"):
        composer.MjxEnvironment(task, impl="cpp")
    with pytest.raises(UsageError, match="nconmax and njmax are Warp's"):
        composer.MjxEnvironment(task, nconmax=10)
