"""A signal that comes where Python drops exceptions must stop the robot all the same."""

import json
import signal
import subprocess
import sys

import pytest

pytestmark = pytest.mark.process

FINALISER = """
import gc, sys, time
from types import ModuleType
from sim2real import cli
from sim2real.artifacts import run as run_folder

class Slow:
    def __del__(self):
        print("finalising", flush=True)
        time.sleep(0.5)

def collecting(phase, info):
    if phase == "stop":
        Slow()

def run(pipeline, config, root, run_dir):
    with run_folder.open_stage(root, pipeline.name, "record", config, run_dir=run_dir):
        try:
            if {by_collector}:
                gc.callbacks.append(collecting)
                gc.collect()
                gc.callbacks.clear()
            else:
                Slow()
            for _ in range(200):
                time.sleep(0.1)
        except KeyboardInterrupt:
            raise ImportError("initialising an extension failed") from None  # as some do
        finally:
            print("torque off", flush=True)

module = ModuleType("sim2real.stages.session.record")
module.run = run
sys.modules[module.__name__] = module
sys.exit(cli.main(["record", "pendulum"]))
"""


@pytest.mark.parametrize(
    ("number", "code", "by_collector"),
    [pytest.param(signal.SIGINT, 130, False, marks=pytest.mark.night), (signal.SIGTERM, 143, True)],
)
def test_a_signal_inside_a_finaliser_is_not_lost(tmp_path, number, code, by_collector):
    process = subprocess.Popen(
        [sys.executable, "-c", FINALISER.replace("{by_collector}", str(by_collector))],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "finalising\n"
    process.send_signal(number)
    out, err = process.communicate(timeout=30)
    assert process.returncode == code
    assert "torque off" in out
    assert "Traceback" not in err


AT_WORK = """
import sys, time
from types import ModuleType
import jax, jax.numpy as jnp
from sim2real import cli
from sim2real.artifacts import run as run_folder

def run(pipeline, config, root, run_dir):
    with run_folder.open_stage(root, pipeline.name, "train", config, run_dir=run_dir):
        work = jax.jit(lambda x: jax.lax.fori_loop(0, 10**9, lambda i, y: jnp.tanh(y @ y), x), donate_argnums=0)
        work(jnp.ones((300, 300)))  # comes back at once: XLA goes on by itself
        print("started", flush=True)
        for _ in range(3000):  # not one sleep of 300 s: a signal that another thread receives does not end a sleep
            time.sleep(0.1)

module = ModuleType("sim2real.stages.train.stage")
module.run = run
sys.modules[module.__name__] = module
sys.argv[1:] = ["train", "pendulum"]
sys.exit(cli.main())
"""


@pytest.mark.night
def test_a_command_that_is_interrupted_while_xla_is_at_work_ends_in_order(tmp_path):
    process = subprocess.Popen(
        [sys.executable, "-c", AT_WORK], cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "started\n"
    process.send_signal(signal.SIGINT)
    try:
        _, err = process.communicate(timeout=100)  # on a busy machine; by itself it goes on for longer
    finally:
        process.kill()
    assert process.returncode == 130
    assert err == "interrupted\n"
    (manifest,) = tmp_path.glob("runs/pendulum/*/train/manifest.json")
    assert json.loads(manifest.read_text())["status"] == "interrupted"
