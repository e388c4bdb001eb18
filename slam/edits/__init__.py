"""Rebuild a finished map from its file, with edits of the user or with other settings."""
