"""One module a bench; ``scripts/bench.py`` runs them."""
