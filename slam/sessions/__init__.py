"""Join another log of the same place to a saved map: find its pose, join the graphs, rebuild the map."""
