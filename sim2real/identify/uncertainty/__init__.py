"""How well recordings determine parameters: covariance, intervals, profiles, alternative models, noise."""
