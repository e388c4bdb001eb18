"""Find and follow a robot in a saved map, one measurement at a time.

The cells (``# %%``) run one after the other in a notebook or an editor, and the whole as a program:

    scanweave map monday.log -o house/
    python examples/localize_step_by_step.py house/ tuesday.log
"""

# %% A map that `scanweave map` has made, and a log of the same place on another day.
import itertools
import math
import sys

import numpy as np

import slam

MAP, LOG = sys.argv[1:3]
house = slam.load_map(MAP)
print(f"{house.path}: {len(house.keyframe_poses)} keyframes, {len(house.trajectory)} poses")

# %% The localiser knows the map, and not where the robot is. Any key of `scanweave config` can be set.
config = slam.load_config(overrides=["localization.confident_probability=0.99"])
localizer = slam.Localizer(house, config)

# %% Feed it what the sensors say, as it comes: from a log here, from a driver on a robot.
# A measurement of your own is a plain record, such as
# slam.LaserScan(stamp_s, ranges_m, start_angle_rad, step_rad, range_max_m) or
# slam.WheelOdometry(stamp_s, T_odom_base).
way = []
for measurement in slam.open_dataset(LOG):
    output = localizer.add(measurement)
    if output is None:  # wheels: kept, and used with the next scan
        continue
    if output.state is slam.State.TRACKING:
        way += [past.pose for past in output.recovered]  # known by now: where it was before it was found
        way.append(output.pose)
        newest = output
    if len(way) == 1 or output.recovered:
        pose, sigmas = output.pose, np.sqrt(np.diag(output.covariance))
        print(
            f"found at {output.stamp_s:.1f} s: x {pose.x():.2f} m, y {pose.y():.2f} m, "
            f"{math.degrees(pose.theta()):.0f} degrees, +- {100 * sigmas[:2].max():.0f} cm"
        )

# %% Where it went.
steps = [one.between(other) for one, other in itertools.pairwise(way)]
length_m = sum(math.hypot(step.x(), step.y()) for step in steps)
print(f"{len(way)} poses, {length_m:.1f} m; at the end {newest.confidence:.0%} sure" if way else "not found")
house.close()
