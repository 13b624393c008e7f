"""An emulated robot's plant, its settings, and its account of what was true."""

import subprocess
import sys

import pytest
from families import VOLTS

from sim2real.emulation.truth import Kind, TruthLog, read_truth
from sim2real.errors import Sim2RealError


def test_the_account_of_a_robot_can_be_cut_anywhere(tmp_path):
    robot = VOLTS.robot(ids=[1, 2], time_constant_s=0.03)
    robot.sleep(0.8)
    truth = robot.truth()
    assert truth.parameters == {"time_constant_s": 0.03, "top_speed_rad_s": 6.0}
    assert truth.header["config"]["baud_rate"] == 1_000_000
    t_ns, states = truth.states()
    assert list(states) == ["q1", "dq1", "q2", "dq2"]
    assert (t_ns[-1] - t_ns[0]) * 1e-9 == pytest.approx(0.8, abs=0.01)
    whole = robot.truth_path.read_bytes()
    cut = tmp_path / "cut.bin"
    cut.write_bytes(whole[:-13])
    assert len(read_truth(cut).rows) == len(truth.rows) - 1
    cut.write_bytes(whole[:10])
    with pytest.raises(Sim2RealError, match="no header"):
        read_truth(cut)
    with pytest.raises(Sim2RealError, match="no truth file"):
        read_truth(tmp_path / "none.bin")


def test_an_emulator_needs_neither_jax_nor_mujoco():
    code = (
        "import sys, sim2real.emulation.bus;"
        "import sim2real.hardware.safety.gate;"
        "print([m for m in ('jax', 'mujoco', 'serial', 'sim2real.graph', 'sim2real.log') if m in sys.modules])"
    )
    assert subprocess.check_output([sys.executable, "-c", code], text=True).strip() == "[]"


def test_a_truth_that_cannot_be_written_does_not_stop_the_robot(tmp_path):
    log = TruthLog(tmp_path / "truth.bin", {"state_names": ["q"]})
    log.write(Kind.STATE, 0, 0, 1, 0, 0, (1.0,))
    log.flush()
    log._file.close()
    log._file = open("/dev/full", "wb")  # noqa: SIM115 - the log closes it
    for second in range(2, 5):
        log.write(Kind.STATE, 0, 0, second, 0, 0, (1.0,))
        log.flush()
    log.close()
    assert read_truth(tmp_path / "truth.bin").rows["t_ns"].tolist() == [1]
