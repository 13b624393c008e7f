"""The graph: compiled, on a simulated clock, on the wall clock."""
