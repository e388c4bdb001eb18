"""Names of the files in the folder of a run."""

from __future__ import annotations

TRAJECTORY = "trajectory.tum"
MAPS = "maps.npz"  # cells of each map; NAME_at is resolution, x, y, yaw of its corner
ERRORS = "errors.npz"  # the trajectory aligned to the ground truth
MEASURED = "measured.json"
FAILURE = "failure.json"
JOB = "job.json"
LOG = "log.txt"
RESULT = "result.json"
