"""Robots that change, and the tests that notice it."""
