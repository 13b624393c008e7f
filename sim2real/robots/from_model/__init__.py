"""Robots from a model file and a recording, without Python of their own."""
