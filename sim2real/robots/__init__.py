"""Robots of servos on a bus: what the stages need of one, but for its model and its task."""
