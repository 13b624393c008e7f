"""Worlds from parts."""
