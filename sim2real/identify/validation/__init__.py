"""Errors on held-out parts, the choice of optional terms on them, and the verdict."""
