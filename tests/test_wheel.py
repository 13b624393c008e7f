"""The built wheel: what is in it, and that it runs where no checkout is near."""

import os
import site
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[1]


def call(*command, cwd, env=None):
    done = subprocess.run([str(c) for c in command], cwd=cwd, env=env, capture_output=True, text=True, timeout=240)
    assert done.returncode == 0, f"{command} ended with {done.returncode}:\n{done.stdout}\n{done.stderr}"
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wheel")
    call(sys.executable, "-m", "build", "--wheel", "--outdir", folder, REPOSITORY, cwd=folder)
    (path,) = folder.glob("*.whl")
    return path


@pytest.fixture(scope="module")
def environment(wheel, tmp_path_factory):
    """A new environment with the wheel; its dependencies are borrowed from this one, the checkout is not."""
    folder = tmp_path_factory.mktemp("environment")
    call(sys.executable, "-m", "venv", "--without-pip", folder, cwd=folder)
    python = folder / "bin" / "python"
    install = ["install", "--quiet", "--no-deps", "--no-index", wheel]
    call(sys.executable, "-m", "pip", "--python", python, *install, cwd=folder)
    (packages,) = (folder / "lib").glob("python*/site-packages")
    # Folders named in a .pth file come after the environment's own, and .pth files in them (such as the one of the
    # editable installation) are not read.
    (packages / "borrowed.pth").write_text("\n".join(site.getsitepackages()))
    return folder


@pytest.fixture
def outside(tmp_path):
    """An empty folder and a process environment without paths of the checkout."""
    return {"cwd": tmp_path, "env": {k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "VIRTUAL_"))}}


@pytest.mark.night
def test_the_wheel_carries_the_pipelines_and_runs(wheel, environment, outside):
    names = zipfile.ZipFile(wheel).namelist()
    assert {"sim2real/_pipelines/pendulum/__init__.py", "sim2real/cli.py", "sim2real/SKILL.md"} <= set(names)
    assert {top for name in names if not (top := name.split("/")[0]).endswith(".dist-info")} == {"sim2real"}
    command, python = environment / "bin" / "sim2real", environment / "bin" / "python"
    assert "exit codes" in call(command, "--help", **outside)
    assert "swing it up" in call(command, "info", **outside)
    assert "--duration-s" in call(command, "record", "pendulum", "--help", **outside)
    code = "import sim2real, sim2real.stages.load as p; print(sim2real.__file__, p.load_robot('pendulum'))"
    assert call(python, "-c", code, **outside).startswith(str(environment))
    code = "from sim2real.stages.load import available; print(available()['pendulum'])"
    assert "site-packages/sim2real/_pipelines/pendulum" in call(python, "-c", code, **outside)
