"""What was identified, in the terms of other simulators: MJCF, mjlab, Isaac Lab, and a JSON document."""
