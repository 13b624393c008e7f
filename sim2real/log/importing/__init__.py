"""Imports of other recorders' files: a table of signals and an explicit mapping become a log."""
