"""Readers of other recorders' files: tables, arrays, ROS bags, LeRobot data sets."""
