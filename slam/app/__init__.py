"""Use cases: what the commands, comparisons and programs do with a log or a map, each one call."""
