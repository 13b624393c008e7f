"""Export of an identification: MJCF, mjlab, Isaac Lab, a JSON document, and a model card."""
