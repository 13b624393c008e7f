"""What a test of nodes and runtimes needs: nodes that give wrong messages away, the rules by the letter, suites."""

from sim2real.graph.testing.conformance import NodeConformance as NodeConformance
from sim2real.graph.testing.conformance import Played as Played
from sim2real.graph.testing.conformance import RuntimeConformance as RuntimeConformance
from sim2real.graph.testing.nodes import HashInJax as HashInJax
from sim2real.graph.testing.nodes import HashInPython as HashInPython
from sim2real.graph.testing.nodes import Value as Value
from sim2real.graph.testing.nodes import contracting_node as contracting_node
from sim2real.graph.testing.nodes import hash_node as hash_node
from sim2real.graph.testing.nodes import jax_hash_node as jax_hash_node
from sim2real.graph.testing.nodes import random_graph as random_graph
from sim2real.graph.testing.reference import Reference as Reference
