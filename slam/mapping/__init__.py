"""What is drawn of a map: grids and their layers, clouds, coloured surfaces, rooms, ways over the floor."""
