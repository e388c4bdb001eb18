"""Trajectories: a pose for every reading."""
