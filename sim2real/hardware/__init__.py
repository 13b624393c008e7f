"""Servos on a bus: driver, emulator with any plant, safety gate and guardian."""
