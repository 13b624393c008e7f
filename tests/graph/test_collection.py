"""The nodes of a graph: what is refused, and in which words."""

import numpy as np
import pytest

from sim2real.errors import UsageError
from sim2real.graph import BaseNode, DelayDistribution
from sim2real.graph.node import by_name, check_senders
from sim2real.graph.schedule import draw


def pair():
    sensor, agent = BaseNode("sensor", 10), BaseNode("agent", 10)
    agent.connect(sensor)
    return sensor, agent


def test_a_list_of_nodes_is_as_good_as_a_dictionary():
    sensor, agent = pair()
    assert by_name([sensor, agent]) == by_name({"sensor": sensor, "agent": agent})
    listed, named = draw([sensor, agent], 1.0), draw({"sensor": sensor, "agent": agent}, 1.0)
    np.testing.assert_array_equal(listed.edges["agent", "sensor"].seq_in, named.edges["agent", "sensor"].seq_in)


@pytest.mark.parametrize(
    ("nodes", "words"),
    [
        ("sensor", "nodes of a graph were expected, got 'sensor'"),
        (None, "nodes of a graph were expected, got None"),
        (["sensor"], "made of nodes, got 'sensor'"),
        ([BaseNode("a", 1), BaseNode("a", 2)], "two nodes are called 'a'"),
        ({"b": BaseNode("a", 1)}, "key 'b' stands for a node that is called 'a'"),
    ],
)
def test_what_is_no_collection_of_nodes_is_refused(nodes, words):
    with pytest.raises(UsageError, match=words):
        by_name(nodes)


def test_a_sender_is_the_node_itself():
    """A sensor that was replaced, while the agent still listens to the old one: its rate and delays would be wrong."""
    sensor, agent = pair()
    other = BaseNode("sensor", 50)
    with pytest.raises(UsageError, match=r"'agent' listens to another object called 'sensor' \(.*rate=10\)") as error:
        draw([other, agent], 1.0)
    assert "connect 'agent' to the new node" in (error.value.hint or "")
    with pytest.raises(UsageError, match="'agent' listens to 'sensor', which is not in the graph"):
        check_senders({"agent": agent})
    check_senders({"agent": agent}, among={})
    check_senders({"sensor": sensor, "agent": agent})


class Odd(DelayDistribution):
    """Draws what it is told to."""

    def __init__(self, drawn):
        self.drawn = drawn

    def sample(self, rng, shape):
        return self.drawn(shape)

    def quantile(self, q):
        return 0.0


@pytest.mark.parametrize(
    "drawn",
    [lambda s: np.full(s, np.nan), lambda s: np.full(s, -0.1), lambda s: np.zeros(3)],
    ids=["nan", "<0", "shape"],
)
def test_a_distribution_that_draws_no_delays_is_named(drawn):
    with pytest.raises(UsageError, match=r"node 'n': .*Odd.* draws invalid delays"):
        draw([BaseNode("n", 10, delay_dist=Odd(drawn))], 1.0)
    sensor, agent = BaseNode("sensor", 10), BaseNode("agent", 10)
    agent.connect(sensor, delay_dist=Odd(drawn))
    with pytest.raises(UsageError, match=r"'sensor' -> 'agent'.* draws invalid delays"):
        draw([sensor, agent], 1.0)


@pytest.mark.parametrize(("duration_s", "episodes"), [(float("nan"), 1), (float("inf"), 1), (1.0, 0)])
def test_timelines_have_a_length_and_a_number(duration_s, episodes):
    with pytest.raises(UsageError, match="cannot be drawn"):
        draw([BaseNode("n", 10)], duration_s, episodes)
