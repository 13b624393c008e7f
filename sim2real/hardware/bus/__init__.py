"""Shared code of all half-duplex buses of servos: port, packets, registers, transactions."""
