"""For tests of nodes and runtimes: conformance suites, hash nodes, random graphs and a reference of the rules."""

from sim2real.graph.testing.conformance import NodeConformance as NodeConformance
from sim2real.graph.testing.conformance import Played as Played
from sim2real.graph.testing.conformance import RuntimeConformance as RuntimeConformance
from sim2real.graph.testing.nodes import HashInJax as HashInJax
from sim2real.graph.testing.nodes import HashInPython as HashInPython
from sim2real.graph.testing.nodes import Value as Value
from sim2real.graph.testing.nodes import hash_node as hash_node
from sim2real.graph.testing.nodes import jax_hash_node as jax_hash_node
from sim2real.graph.testing.nodes import random_graph as random_graph
from sim2real.graph.testing.reference import Reference as Reference
