"""What a run leaves in its folder, by name."""

from __future__ import annotations

TRAJECTORY = "trajectory.tum"
MAPS = "maps.npz"  # cells of each map; NAME_at is resolution, x, y, yaw of its corner
ERRORS = "errors.npz"  # the trajectory laid over the truth
MEASURED = "measured.json"
FAILURE = "failure.json"
JOB = "job.json"
LOG = "log.txt"
RESULT = "result.json"
