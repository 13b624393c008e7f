"""Emulated servos on an emulated bus, in a process of their own."""
