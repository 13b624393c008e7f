"""Robots made of servos on a bus: everything that the stages need except the robot's model and its task."""
