"""Robots with a floating base that follow a commanded velocity."""
