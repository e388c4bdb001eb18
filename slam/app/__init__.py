"""Use cases: what commands, comparisons and programs do with a log or a map, one function each."""
