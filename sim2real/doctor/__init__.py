"""Finds out why a policy works in simulation and fails on the robot: contract, timing, plant, or none of these."""
