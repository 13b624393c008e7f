"""What the page says of the servos, in words."""

from types import SimpleNamespace

from sim2real.view.sections import servo_blocks


def episode(end, dry=False, port="/dev/ttyUSB0"):
    return SimpleNamespace(metadata={"dry_run": dry, "port": port, "log": {"session_end": end}})


def test_a_log_that_tells_nothing_of_servos_has_no_block():
    assert servo_blocks([episode(None), episode({"timing": {}})]) == []
    assert servo_blocks([episode({"transactions": 0, "late_replies": 0, "late_s": [None] * 3})]) == []


def test_late_answers_of_an_emulated_robot_are_not_those_of_an_adapter():
    late = {"transactions": 100, "late_replies": 30, "late_s": [0.0, 0.01, 0.02]}
    advised = {port: str(servo_blocks([episode(late, port=port)])[0]) for port in ("/dev/ttyUSB0", "embedded")}
    assert ["latency timer" in text for text in advised.values()] == [True, False]
    assert all("close what else runs" in text for text in advised.values())
