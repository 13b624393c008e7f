"""Policies from graphs: the environment that PPO trains on, PPO, the policy."""

from sim2real import callable_package

callable_package(__name__)
