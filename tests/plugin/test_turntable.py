"""The turntable keeps what sim2real asks of a robot."""

from sim2real.robots.testing import check_robot
from sim2real.stages.pipeline.pipeline import load_pipeline


def test_the_turntable_is_a_robot(tmp_path):
    pipeline = load_pipeline("turntable")
    check_robot(pipeline.load(), tmp_path, pipeline.record.gate)
