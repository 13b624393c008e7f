"""Simulated worlds: graph nodes that integrate a robot's dynamics."""
