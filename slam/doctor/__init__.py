"""What the sensors of a log say of each other: mistakes of units, signs, mountings, clocks."""
