"""Recordings of real motors, fitted and predicted."""
