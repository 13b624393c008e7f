"""The turntable keeps what sim2real asks of a robot."""

from sim2real.robots.testing import check_robot
from sim2real.stages.load import load_robot


def test_the_turntable_is_a_robot(tmp_path):
    pipeline = load_robot("turntable")
    check_robot(pipeline, tmp_path, pipeline.defaults.record.gate)
