"""Readers: one a file format, all behind open_dataset."""
