"""Pictures of graphs and timelines."""

import numpy as np
import pytest

import sim2real
from sim2real.errors import UsageError
from sim2real.graph import BaseNode, BaseWorld
from sim2real.graph.schedule import draw


def robot():
    agent, world = BaseNode("agent", 25, color="teal"), BaseWorld("w", 100)
    sensor = BaseNode("sensor", 50, delay_dist=0.002)
    agent.connect(sensor, blocking=True, window=3, delay_dist=0.004)
    sensor.connect(world, delay_dist=0.001)
    world.connect(agent, skip=True)
    return {n.name: n for n in (agent, sensor, world)}


def test_a_timeline_shows_each_step_and_each_message_that_is_used(tmp_path):
    timeline = draw(robot(), 0.4, 2)
    picture = sim2real.plot_timeline(timeline, 1, 0.0, 0.2, order=("sensor", "agent"))
    (axes,) = picture.figure.axes
    bars = [len(c.get_paths()) for c in axes.collections]
    assert bars == [int((timeline.vertices[n].start[1] <= 200_000).sum()) for n in ("sensor", "agent")]
    edge, sent = timeline.edges["agent", "sensor"], timeline.vertices["sensor"].end[1]
    lines = [line for line in axes.lines if line.get_linestyle() == "-"]
    used = (edge.seq_in[1] >= 0) & (sent <= 200_000)
    assert [round(line.get_xdata()[0] * 1e6) for line in lines] == sent[used].tolist()
    np.testing.assert_allclose([line.get_xdata()[1] - line.get_xdata()[0] for line in lines], 0.004)
    picture.save(tmp_path / "timeline.png")
    assert (tmp_path / "timeline.png").stat().st_size > 2000
    assert "<svg" in picture._repr_svg_()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"episode": 2}, "no episode 2: the timeline has 2"),
        ({"begin_s": 1.0, "end_s": 0.5}, "interval from 1.0 to 0.5 s is empty"),
        ({"order": ["eye"]}, "no node eye"),
    ],
)
def test_what_is_not_there_is_named(options, said):
    with pytest.raises(UsageError, match=said):
        sim2real.plot_timeline(draw(robot(), 0.4, 2), **options)
