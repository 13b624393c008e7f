"""Robots of LeRobot as devices."""
