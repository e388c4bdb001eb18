"""Pure functions on sensor arrays: fusion of lidar and depth. Knows nothing of slam."""
