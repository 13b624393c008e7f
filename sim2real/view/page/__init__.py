"""The report of a run: one HTML page with a section for each stage."""
