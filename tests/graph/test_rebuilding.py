"""A graph is built again with other node classes, and its timing is what it was."""

from functools import partial

import pytest
from oracles.hash_nodes import HashInPython, random_graph

from sim2real.errors import UsageError
from sim2real.graph import BaseNode, BaseWorld, Jitter, Scheduling, TrainableDist
from sim2real.graph.rebuilding import rebuild
from sim2real.graph.schedule import draw


class Replay(BaseNode):
    def __init__(self, name, rate, outputs=None, **options):
        super().__init__(name, rate, **options)
        self.outputs_given = outputs


class Bare(BaseNode):
    def __init__(self, name, rate):
        super().__init__(name, rate)


class OtherWorld(BaseWorld):
    pass


def graph():
    sensor = BaseNode("sensor", 50, delay_dist=0.002, color="teal", order=1)
    agent = BaseNode("agent", 50, delay_dist=0.003, delay=0.004, scheduling=Scheduling.PHASE)
    world = BaseWorld("world", 100)
    agent.connect(sensor, blocking=True, window=3, delay_dist=0.001)
    sensor.connect(world, delay_dist=0.005, name="truth")
    world.connect(agent, skip=True, delay_dist=0.01, delay=0.02, jitter=Jitter.BUFFER)
    return {n.name: n for n in (sensor, agent, world)}


def options(node):
    own = {n: getattr(node, n) for n in ("rate", "delay", "advance", "scheduling", "color", "order")}
    names = ("blocking", "delay", "window", "skip", "jitter", "name")
    return own, {i: {n: getattr(c, n) for n in names} for i, c in node.inputs.items()}


@pytest.mark.parametrize("sensor", [partial(Replay, outputs=3), Bare, BaseNode, lambda name, rate: Bare(name, rate)])
def test_rates_delays_and_connections_are_those_of_the_graph(sensor):
    old = graph()
    new = rebuild(old, {"sensor": sensor, "world": OtherWorld})
    assert {n: options(x) for n, x in new.items()} == {n: options(x) for n, x in old.items()}
    assert isinstance(new["world"], OtherWorld)
    assert not {id(n) for n in new.values()} & {id(n) for n in old.values()}
    assert all(c.output_node is new[c.output_node.name] for n in new.values() for c in n.inputs.values())
    assert [len(n.inputs) for n in old.values()] == [1, 1, 1], "the graph stays as it is"
    for name, vertex in draw(new, 0.5).vertices.items():
        assert (vertex.start == draw(old, 0.5).vertices[name].start).all()


def test_timelines_of_any_graph_stay_as_they_were():
    for seed in range(30, 50):
        old = random_graph(seed)
        others = {n: HashInPython for n, x in old.items() if not isinstance(x, BaseWorld)}
        one, two = draw(old, 0.3, 2, 7), draw(rebuild(list(old.values()), others), 0.3, 2, 7)
        assert all((one.vertices[n].end == two.vertices[n].end).all() for n in old)
        assert all((one.edges[k].seq_in == two.edges[k].seq_in).all() for k in one.edges)


def test_nodes_are_left_out_and_delays_are_replaced():
    old = graph()
    old["world"].inputs["agent"].jitter = Jitter.LATEST
    dist = TrainableDist.create(0.01, 0.0, 0.1)
    new = rebuild(old, {"sensor": None}, {("world", "agent"): dist})
    assert (list(new), new["agent"].inputs) == (["agent", "world"], {})
    assert new["world"].inputs["agent"].delay_dist is dist
    assert new["world"].inputs["agent"].delay == pytest.approx(0.01)


@pytest.mark.parametrize(
    ("others", "delays", "said"),
    [
        ({"sensors": BaseNode}, {}, "no node 'sensors'. Nodes: sensor, agent, world"),
        ({}, {("agent", "world"): 0.1}, r"no input \('agent', 'world'\). Inputs: "),
        ({"sensor": BaseNode("eye", 50)}, {}, "is called 'eye'"),
        ({"sensor": graph()["sensor"]}, {}, "is connected already"),
        ({"sensor": lambda name: 3}, {}, "a node was expected in its place, got 3"),
        ({}, {("agent", "sensor"): TrainableDist.create(0.0, 0.0, 0.1)}, "a trainable delay cannot move"),
    ],
)
def test_what_does_not_fit_is_named(others, delays, said):
    with pytest.raises(UsageError, match=said):
        rebuild(graph(), others, delays)
