"""Recordings of real motors, and all tools that fit them."""
