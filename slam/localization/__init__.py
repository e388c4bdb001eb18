"""Localisation in a known map: global search, tracking, loss and recovery."""
