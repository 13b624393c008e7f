"""The stage record, and what moves the robot: excitation, open robot, episode."""
