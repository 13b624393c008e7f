"""A signal that comes where Python drops exceptions must stop the robot all the same."""

import signal
import subprocess
import sys

import pytest

pytestmark = pytest.mark.realtime

FINALISER = """
import gc, sys, time
from types import ModuleType
from sim2real import cli
from sim2real.stages import runs

class Slow:
    def __del__(self):
        print("finalising", flush=True)
        time.sleep(0.5)

def collecting(phase, info):
    if phase == "stop":
        Slow()

def run(pipeline, config, root, run_dir):
    with runs.open_stage(root, pipeline.name, "record", config, run_dir=run_dir):
        try:
            if {by_collector}:
                gc.callbacks.append(collecting)
                gc.collect()
                gc.callbacks.clear()
            else:
                Slow()
            time.sleep(20)
        except KeyboardInterrupt:
            raise ImportError("initialising an extension failed") from None  # as some do
        finally:
            print("torque off", flush=True)

module = ModuleType("sim2real.stages.record")
module.run = run
sys.modules[module.__name__] = module
sys.exit(cli.main(["record", "pendulum"]))
"""


@pytest.mark.parametrize("by_collector", [False, True])
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
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
    out, err = process.communicate(timeout=10)
    assert process.returncode == code
    assert "torque off" in out
    assert "Traceback" not in err
