"""The estimates in the terms of other simulators: MJCF, mjlab, Isaac Lab, a JSON document, and a model card."""
