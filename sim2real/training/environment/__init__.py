"""Environments for PPO: episodes on a compiled graph, with drawn robots, timelines and pushes."""
