"""The four stages, their configuration, run folders, and what a pipeline provides."""
