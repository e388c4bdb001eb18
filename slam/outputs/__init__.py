"""A finished map, and the files of it."""
