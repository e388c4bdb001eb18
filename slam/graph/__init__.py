"""The factor graph, loop closure and refinement."""
