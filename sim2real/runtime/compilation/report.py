"""The figures of a compiled graph."""

import jax

from sim2real.runtime.compilation.walk import Walk
from sim2real.types import Json, PyTree


def report_of(walk: Walk, state: PyTree) -> dict[str, Json]:
    """Return the result of ``CompiledGraph.report``; ``state`` is the carried state, or its shapes."""
    program, w = walk.program, walk.program.wiring
    windows = {(n, i): program.nodes[n].inputs[i].total_window for n, i in w.bursts}
    return {
        "episodes": program.episodes,
        "rows": w.rows,
        "ticks_per_row": w.ticks,
        "slots": list(w.slots),
        "supervisor_slots": len(walk.turns),
        "supervisor_steps": int(walk.counts.min()) if walk.turns else 0,
        "longest_gap": walk.longest_gap,
        "discarded": w.discarded,
        "rings": dict(w.rings),
        "bursts": {f"{n}/{i}": {"burst": b, "window": windows[n, i]} for (n, i), b in w.bursts.items()},
        "bytes_per_copy": sum(x.size * x.dtype.itemsize for x in jax.tree_util.tree_leaves(state)),
    }
