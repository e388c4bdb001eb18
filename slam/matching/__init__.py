"""Scan matching kernels: points, surfels, Gauss-Newton and correlative search."""
