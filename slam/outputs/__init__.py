"""A finished map, and its files."""
