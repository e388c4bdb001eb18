"""Drawing of maps: grids and their layers, clouds, coloured surfaces, rooms, paths on the floor."""
