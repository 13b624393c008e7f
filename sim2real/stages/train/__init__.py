"""The stage train: a policy on the identified model, with the robot's timing."""
