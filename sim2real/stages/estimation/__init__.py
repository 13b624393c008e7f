"""Estimates, as the stages identify, validate, check and deploy share them: held-out parts, replays, free runs."""
