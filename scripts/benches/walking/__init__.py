"""Trainings of a walking robot on a GPU."""
