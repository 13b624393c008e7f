"""A graph as one XLA program: timelines as index tables, rows of world ticks, and the program that runs them."""
