"""Another log of the same place joined to a saved map: find where it belongs, join the graphs, rebuild."""
