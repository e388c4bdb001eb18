"""Matching of scans and clouds: points, surfels, planes, Gauss-Newton and correlative search."""
