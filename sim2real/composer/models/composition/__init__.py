"""Models that are attached to each other, compiled as one."""
