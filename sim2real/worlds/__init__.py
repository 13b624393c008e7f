"""Simulated worlds as nodes of a graph."""
