"""Servos on a bus: the owner of the port, an emulator that takes any plant, and the safety gate for commands."""
