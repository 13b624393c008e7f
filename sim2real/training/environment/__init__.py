"""Environments for PPO: episodes on a compiled graph, with random robots, timelines and pushes."""
