"""Fixtures of a comparison that several files look at."""

from tiny_comparison import tiny

__all__ = ["tiny"]
