"""Occupancy grids."""
