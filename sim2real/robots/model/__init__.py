"""A robot of an MJCF or URDF with a drive on each joint, and recordings."""
