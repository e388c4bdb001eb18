"""Files that Scanweave writes and reads: ``map.db``, and the formats of other programs."""
