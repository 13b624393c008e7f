"""Whether a later log is still of the robot that was identified."""
