"""Map a log, look at the map as arrays, draw it, and localise in it.

The cells (``# %%``) run one after the other in a notebook or an editor, and the whole as a program:

    python examples/map_step_by_step.py monday.log house/
"""

# %% A log of any known format, and the folder for the map with all its files.
import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import slam

LOG, MAP = sys.argv[1:3]
house = slam.map_log(LOG, out=MAP)
print(house)

# %% The saved map, today or another day; what it holds are arrays and small records.
house = slam.load_map(MAP)
poses = house.keyframe_poses  # (K, 3) x, y, yaw
way = house.trajectory.positions_m  # (N, 3), one for every reading
loops = [loop for loop in house.loops if loop.accepted]
print(f"{len(poses)} keyframes, {len(way)} poses, {len(loops)} loops of {len(house.loops)} that were tried")

# %% A picture: the grid with the way on it, and a line for every loop.
figure = Figure(figsize=(8, 8))
axes = figure.subplots()
if house.grid is not None:  # a camera alone has none
    cells = house.grid.states()  # (rows, cols) of 100 occupied, 0 free, -1 unknown; row 0 lies lowest
    corner, size_m = house.grid.T_map_grid, house.grid.resolution_m * np.array(cells.shape)
    extent = (corner.x(), corner.x() + size_m[1], corner.y(), corner.y() + size_m[0])
    axes.imshow(np.where(cells < 0, 50, cells), cmap="Greys", origin="lower", extent=extent)
axes.plot(way[:, 0], way[:, 1], linewidth=1)
for loop in loops:
    axes.plot(*poses[[loop.place, loop.keyframe], :2].T, color="tab:red")
axes.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")
figure.savefig(Path(MAP) / "map.png")

# %% The same log again, as if it were another day: where is the robot, from no start pose?
found = slam.localize_log(house, LOG).trajectory
error_m = slam.evaluate(found, groundtruth=house.trajectory)["ate"]["translation_m"]["rmse"]
print(f"localised at {len(found)} readings, {1000 * error_m:.0f} mm from the way in the map")
house.close()
