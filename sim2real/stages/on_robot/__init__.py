"""Stages that move the robot: open it, run one episode, let it come to rest."""
