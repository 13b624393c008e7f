"""Pendulums drawn at random, whose parameters the stages do not get."""
