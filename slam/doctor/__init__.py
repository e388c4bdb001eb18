"""Compares the sensors of a log to find wrong units, signs, mountings and clocks."""
