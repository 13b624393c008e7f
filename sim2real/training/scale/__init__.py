"""Training over several devices and hosts, checkpoints, and compilation on GPUs."""
