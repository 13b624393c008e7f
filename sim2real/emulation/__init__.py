"""Emulated robots: servos on buses and legs, with firmware, physics, faults, truth. `hardware` never imports them."""
