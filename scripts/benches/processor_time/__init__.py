"""Processor time of the tests and of an identification."""
