"""Composed tasks as the environments of other libraries."""
