"""Emulated links with known delays, and the methods that estimate them."""
