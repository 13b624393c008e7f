"""Feetech STS servos (STS3215, the SO-101's): tables of registers and models, device, emulation, calibration file."""
