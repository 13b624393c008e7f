"""Why does a policy work in simulation and fail on the robot: contract, timing, plant, or none of these."""
