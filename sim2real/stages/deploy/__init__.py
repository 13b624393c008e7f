"""The stage deploy: the policy on the robot, beside the same policy in simulation."""
