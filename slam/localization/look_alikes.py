"""Check if places of a map look alike, so that a search without initial pose may find the wrong one."""

from __future__ import annotations

from fusion.estimation import FEWEST
from slam.config.localization import LocalizationConfig
from slam.localization.global_search import at_once, search_map
from slam.localization.known_map import Walls
from slam.localization.planar_sensor import PlanarSensor
from slam.localization.poses import same_place
from slam.localization.scan_view import first_in_cells
from slam.measurements import pose2_from_row


def look_alikes(walls: Walls, sensor: PlanarSensor, settings: LocalizationConfig) -> float:
    """Return the share of a map's own scans, sampled along its path, that also fit elsewhere in it.

    Such a scan has more evidence there than a place needs to exceed the outside of the map. 0 for a map
    without scans, and if at most one in ten do: some places look alike in most maps.
    """
    sampled = list(walls.sampled(FEWEST))
    elsewhere = 0
    for scan_pose, view in sampled:
        novel = sensor.novel(view, scan_pose, None)
        points = view.points.points_base
        points = points[first_in_cells(points, settings.novel_cell_m)[0]]
        for place in at_once(search_map(walls.field, points, settings, settings.hypotheses)):
            guess = pose2_from_row(place.pose)
            motion = sensor.align(view, guess)
            pose = guess if motion is None else motion.T_reference_base
            if not same_place(scan_pose, pose) and sensor.weigh(pose, novel) > settings.nowhere_nats:
                elsewhere += 1
                break
    return elsewhere / len(sampled) if 10 * elsewhere > len(sampled) else 0.0
