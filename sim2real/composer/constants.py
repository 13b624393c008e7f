"""Numbers that worlds agree on."""

SENSOR_SITES_GROUP = 4
"""The group of sites that sensors are attached to."""
