"""Excitation signals, and the log that they would give if the robot were its model."""
