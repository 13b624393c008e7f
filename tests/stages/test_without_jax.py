"""sim2real on a robot's computer: what works without JAX, and what is refused in words."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from sim2real import errors

WITHOUT_JAX = (sys.executable, str(Path(__file__).with_name("without_jax.py")))
"""A command line that refuses what only the distribution sim2real brings."""


def call(command, folder, *arguments):
    """Run a command in a folder; return its exit code and its output."""
    outside = {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "VIRTUAL_"))}
    line = [*command, *map(str, arguments)]
    done = subprocess.run(line, cwd=folder, env=outside, capture_output=True, text=True, timeout=120)
    return done.returncode, done.stdout + done.stderr


def pipeline_of_module(folder, text):
    """Write a pipeline whose robot's module has a text; return its name."""
    pipeline = folder / "pipelines" / "mine"
    pipeline.mkdir(parents=True)
    (pipeline / "robot.py").write_text(text)
    (pipeline / "__init__.py").touch()
    return "mine"


def test_check_prints_a_recording_as_json_and_the_reason_why_it_ends_there(tmp_path):
    log = Path(__file__).resolve().parents[2] / "datasets" / "pendulum" / "multisine.mcap"
    command = [*WITHOUT_JAX, "check", "pendulum", "--json", "--log", str(log)]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert done.returncode == errors.USAGE
    (recording,) = json.loads(done.stdout)["recordings"]
    assert recording["samples"] > 1000
    assert "hint: copy it to a computer with sim2real" in done.stderr


def test_the_page_s_robot_runs_without_jax_and_trains_with_it(tmp_path):
    """Its features on both, its reward with JAX alone."""
    page = Path(__file__).resolve().parents[2] / "docs" / "guides" / "robot_computer.md"
    (code,) = re.findall(r"^```python\n(.*?)^```", page.read_text(), re.DOTALL | re.MULTILINE)
    seen: dict = {}
    exec(code, seen)
    message = seen["Measurement"](np.float64(np.pi))
    assert seen["features"](message) == pytest.approx([-1.0, 0.0])
    assert float(seen["reward"](message)) == pytest.approx(-1.0)
    mine = pipeline_of_module(tmp_path, f"{code}\nprint(features(Measurement(0.0)), type(Measurement).__module__)\n")
    code, said = call(WITHOUT_JAX, tmp_path, "record", mine)
    assert "[1. 0.] builtins" in said
    assert "ROBOT of pipeline 'mine'" in said


@pytest.mark.parametrize("command", ["train", "check"])
def test_a_command_that_needs_the_rest_says_so(tmp_path, command):
    code, said = call(WITHOUT_JAX, tmp_path, command, "pendulum")
    assert code == errors.USAGE
    assert "jax" in said.lower()
    assert "not installed" in said
    assert "hint: " in said


def test_a_robot_whose_module_imports_jax_is_named(tmp_path):
    mine = pipeline_of_module(tmp_path, "import math\nimport jax\n")
    code, said = call(WITHOUT_JAX, tmp_path, "record", mine)
    assert code == errors.USAGE
    assert f"(line 2 of {tmp_path / 'pipelines' / mine / 'robot.py'})" in said
    assert "from sim2real.later import jax, jnp" in said
