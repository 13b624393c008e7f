"""A graph on the wall clock: one thread for each node."""
