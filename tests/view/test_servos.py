"""What the page says of the servos' answers, in words."""

from types import SimpleNamespace

from sim2real.view.sections import record_banner


def verdict(port, late):
    end = {"transactions": 100, "late_replies": late, "lost_replies": 0}
    episode = SimpleNamespace(metadata={"port": port, "log": {"session_end": end}}, duration_s=1.0)
    return str(record_banner(SimpleNamespace(episode=episode, dry=False, warnings=())))


def test_late_answers_of_an_emulated_robot_are_not_those_of_an_adapter():
    assert "close what else runs" not in verdict("/dev/ttyUSB0", 0)
    advised = [verdict(port, 30) for port in ("/dev/ttyUSB0", "embedded")]
    assert ["latency timer" in text for text in advised] == [True, False]
    assert all("close what else runs" in text for text in advised)
