"""Robots: what the stages need of a robot, and ready-made kinds (servo arms, walking robots, model and log)."""
