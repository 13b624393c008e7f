"""Unitree's robots on their low-level interface: messages over DDS, and the device."""
