"""A robot described by an MJCF or URDF with a drive on each joint; it was only recorded."""
