"""What the page says of the servos, in words."""

from types import SimpleNamespace

from sim2real.view.page.servos import servo_blocks


def episode(end, dry=False):
    return SimpleNamespace(metadata={"dry_run": dry, "log": {"session_end": end}})


def end(late=0, suspects=(), **other):
    answers = {"transactions": 400, "lost_replies": 3, "late_replies": late, "late_s": [0.0001, 0.0035, 0.02]}
    return {**answers, "suspects": list(suspects), **other}


def test_a_log_that_tells_nothing_of_servos_has_no_block():
    assert servo_blocks([episode(None), episode({"timing": {}})]) == []
    assert servo_blocks([episode({"transactions": 0, "late_replies": 0, "late_s": [None] * 3})]) == []


def test_answers_are_told_in_words():
    (block,) = servo_blocks([episode(end())])
    assert list(block.items) == [
        "400 answers came; 3 were lost, and requested again.",
        "No answer came so late that the sample's time is uncertain.",
        "Beyond the time that its bytes take, half of the answers took 0.10 ms or less, 99 % 3.50 ms or less, the "
        "slowest 20.00 ms.",
        "No measurement was suspicious: no joint stood still under load.",
    ]
    (block,) = servo_blocks([episode(end(late=8))])
    assert block.items[1] == (
        "8 answers (2.0%) came so late that the sample's time is uncertain: set the adapter's latency timer to 1 ms, "
        "and close other programs."
    )


def test_what_was_odd_is_told_of_each_episode():
    odd = "joint 'tilt' has read 0.1 rad for 2.00 s, though it is pushed with 40% of its torque"
    (block,) = servo_blocks([episode(end(suspects=[odd])), episode(end())])
    assert block.items[-1] == f"Suspicious, but no reason to stop, in episode 0: {odd}."
    (block,) = servo_blocks([episode(end(suspects=[odd]))])
    assert block.items[-1] == f"Suspicious, but no reason to stop: {odd}."


def test_what_was_sent_is_a_table_and_of_a_dry_run_what_would_have_been():
    row = {"name": "tilt", "unit": "rad", "commands": 50, "low": -0.5, "mean": 0.1, "high": 1.0, "cut": 5}
    assert servo_blocks([episode({"sent": [row]})])[0].caption == "Commands to the motors"
    (table,) = servo_blocks([episode({"sent": [row]}, dry=True)] * 2)
    assert table.caption == "Commands to the motors, which were not sent"
    assert table.rows[1] == ["episode 1: tilt", "rad", "50", "\N{MINUS SIGN}0.5000", "0.1000", "1.000", "5", "10.0%"]
