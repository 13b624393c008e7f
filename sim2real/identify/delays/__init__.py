"""Distributions of delays that no time stamp shows: deviations, losses and clock drift of links."""
