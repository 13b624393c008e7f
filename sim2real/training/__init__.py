"""Trains policies: environments made of graphs, PPO, and networks."""
