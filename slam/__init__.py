"""Scanweave: offline SLAM from lidar and RGB-D logs."""
