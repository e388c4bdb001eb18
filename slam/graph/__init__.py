"""The pose graph: its edges, loop closure, and how sure its poses are."""
