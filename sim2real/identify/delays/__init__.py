"""Distributions of delays that no time stamp shows: jitter, losses and clock drift of links."""
