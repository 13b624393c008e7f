"""Lateness on a page: measured in real time, and none in the virtual time of an embedded robot."""

from dataclasses import replace

import pytest
import synthetic_run

from sim2real.log.reader import read_log
from sim2real.view.timing import schedule, timing_tiles


@pytest.mark.parametrize(("port", "value", "late"), [("/dev/ttyUSB0", " ms", True), ("embedded", "none", False)])
def test_lateness_is_shown_only_where_it_was_measured(tmp_path, port, value, late):
    synthetic_run.write_log(tmp_path / "session.mcap")
    episode = read_log(tmp_path / "session.mcap")
    episode = replace(episode, metadata={**episode.metadata, "port": port})
    tile = next(iter(timing_tiles([episode])))
    assert tile.value.endswith(value)
    assert ("latest wake-up" in schedule(episode, "record")) is late
