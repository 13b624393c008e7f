"""The stage validate: an identification scored on later logs."""
