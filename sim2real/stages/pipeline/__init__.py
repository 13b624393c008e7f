"""Logs, parameters and runs of a robot, as stages open them."""
