"""Shows a run: figures, an HTML report that needs no network, and a Rerun recording."""
