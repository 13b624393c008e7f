"""Emulated robots: servos on buses, and legs, with firmware, physics, faults and true states."""
