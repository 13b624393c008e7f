"""Policies from graphs: the environment that PPO trains on, PPO, the policy."""

from sim2real import room

room(__name__)
