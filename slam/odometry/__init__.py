"""Motion from sensor readings, each with a covariance."""
