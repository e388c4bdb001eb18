"""Synthetic logs with exact ground truth."""
