"""Camera processing: surfaces, features, their alignment, place recognition."""
