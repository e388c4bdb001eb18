"""File formats that leave or enter the project: nav2, TUM, g2o."""
