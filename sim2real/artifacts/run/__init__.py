"""The run folder: manifests, locks, the status of stages, iterations."""
