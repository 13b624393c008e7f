"""Policies from graphs: the environment that PPO trains on, PPO, the policy."""
