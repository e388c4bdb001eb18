"""A finished map made anew from what its file holds: with a person's edits, and with other settings."""
