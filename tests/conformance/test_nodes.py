"""Nodes under the suite that any node can inherit."""

from oracles.conformance import NodeConformance

from sim2real.stages.load import load_robot


class TestPendulumSensor(NodeConformance):
    def graph(self):
        return load_robot("pendulum").identifiable(0.06).nodes(0.06), "sensor"


class TestPendulumWorld(NodeConformance):
    def graph(self):
        return load_robot("pendulum").identifiable(0.06).nodes(0.06), "world"
