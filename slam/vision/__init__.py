"""What the camera sees: surfaces, features, their alignment, known places."""
