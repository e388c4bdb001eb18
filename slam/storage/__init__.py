"""Files that the product writes and reads: ``map.db``, and the formats of other programs."""
