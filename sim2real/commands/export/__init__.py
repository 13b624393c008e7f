"""``sim2real export``: the estimates for other simulators, a model card, and a policy for another machine."""
