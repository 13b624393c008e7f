"""The stage deploy: runs the policy on the robot, and compares with the same policy in simulation."""
