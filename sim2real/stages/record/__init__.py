"""The stage record: the robot under an excitation."""
