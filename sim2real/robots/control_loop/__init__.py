"""Robots in the loop of sensor, agent, actuator and world."""
