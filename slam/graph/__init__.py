"""The pose graph: its edges, loop closure, and the uncertainty of its poses."""
