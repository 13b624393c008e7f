"""Robots of position-controlled servos."""
