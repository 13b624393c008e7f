"""Feetech STS servos (STS3215, the SO-101's): driver, emulator, and LeRobot's calibration file."""
