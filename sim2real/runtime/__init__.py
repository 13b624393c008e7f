"""Three ways to run a graph, by one set of timing rules (docs/timing.md); docs/graph.md shows each on an example.

- ``asynchronous.AsyncGraph`` on the wall clock: a thread for each node, measured times.
- ``asynchronous.AsyncGraph`` on a simulated clock: drawn delays, steps in the order of time.
- ``compiled.graph.CompiledGraph``: timelines are data of one XLA program, for ``jit``, ``vmap`` and ``grad``.

The last two give the same numbers for the same timeline.
"""
