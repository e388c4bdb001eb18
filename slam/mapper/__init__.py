"""From measurements to a map: the main loop and what it feeds."""
