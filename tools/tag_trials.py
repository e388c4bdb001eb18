"""What tags are worth: tours of offices by wheels and one camera, no loop closed, with tags and without.

    python tools/tag_trials.py FOLDER HOME [...] [--lidar] [--seconds 90] [--only three]

Each office has tags on many walls; its drive, a few images a second, is kept in FOLDER. It is mapped without
tags, with the three that hang best (seen over the longest time), with all, every second of them surveyed and
the others checks, and with three of which one is wrong: moved half-way, the number of two, or read where
nothing hangs.
A line each: how far the way from the first pose to the end of the first lap is off, the error as laid on the
truth, how often the 95 % ellipses hold it, the checks in units of their sigmas (NEES a degree of freedom).
"""

from __future__ import annotations

import time
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from unittest import mock

import gtsam
import numpy as np

import slam
import slam.mapper.tags as tags_of_keyframes
from slam.config import load_config
from slam.config.tags import KnownPlaces
from slam.estimates import Trajectory
from slam.evaluation.coverage import coverage, truth_at
from slam.evaluation.trajectory_error import absolute_error
from slam.measurements import CameraIntrinsics, ColorImage, RgbdFrame
from slam.simulation.drive_faults import FAULT_PRESETS
from slam.simulation.home import generate_home
from slam.simulation.record import record_drive
from slam.simulation.rigs import RIGS, Rig
from slam.simulation.tour import plan_tour
from slam.simulation.wall_tags import known_places, place_tags
from slam.storage.tum import read_tum
from slam.vision.tags import TagView, find_tags

_IMAGES_HZ = 4.0
Alter = Callable[[list[TagView], int], list[TagView]]


def rig_of(*, lidar: bool) -> Rig:
    """The robot of Yang2021, its camera slower; perhaps with its lidar."""
    rig = RIGS["yang2021_lidar" if lidar else "yang2021"]
    slow = [replace(one, model=replace(one.model, rate_hz=_IMAGES_HZ)) for one in rig.cameras]
    return replace(rig, cameras=tuple(slow))


def drive_of(
    folder: Path, home: int, rig: Rig, tags: int, duration_s: float
) -> tuple[Path, KnownPlaces, float]:
    """A drive on disk, drawn where it is missing; all its tags, and when its first lap ends."""
    building = generate_home(home, "office")
    tour = plan_tour(building, rig.robot_radius_m, rig.robot_height_m, home, duration_s)
    building = place_tags(building, tags, home, tour.poses_xyt)
    log, lap = folder / f"{rig.name}-{home}", folder / f"{rig.name}-{home}.lap"
    if not log.exists():
        made = record_drive(building, rig, home, log, FAULT_PRESETS["usual"], duration_s, formats=("folder",))
        (log / "tags.yaml").unlink()
        lap.write_text(str(made.lap_s))
    return log, known_places(building.tags), float(lap.read_text())


def best_of(log: Path, places: KnownPlaces) -> list[int]:
    """Numbers of tags, those seen over the longest time first."""
    times = dict[int, list[float]]()
    for one in slam.open_dataset(log):
        if isinstance(one, RgbdFrame):
            for view in find_tags(one.color, one.intrinsics, places):
                times.setdefault(view.number, []).append(one.stamp_s)
    return sorted(times, key=lambda number: times[number][0] - times[number][-1])


class Altered:
    """Finds tags, and makes something else of them."""

    def __init__(self, alter: Alter) -> None:
        self._alter, self._images = alter, 0

    def __call__(self, color: ColorImage, lens: CameraIntrinsics, places: KnownPlaces) -> list[TagView]:
        """As `find_tags`."""
        self._images += 1
        return self._alter(find_tags(color, lens, places), self._images)


def variants(best: list[int]) -> dict[str, Alter]:
    """What is made of the tags of an image, which has a number."""
    three, other = best[:3], best[3:]

    def only(numbers: list[int]) -> Alter:
        return lambda views, _: [view for view in views if view.number in numbers]

    def moved(views: list[TagView], image: int) -> list[TagView]:
        kept = [
            view for view in views if view.number in three and not (view.number == three[0] and image > 80)
        ]
        late = [view for view in views if view.number in other[:2] and image > 80]
        return kept + [replace(view, number=three[0]) for view in late]

    def twins(views: list[TagView], _: int) -> list[TagView]:
        names = dict.fromkeys(three, None) | dict.fromkeys(other[:2], three[0])
        return [
            replace(view, number=names[view.number] or view.number) for view in views if view.number in names
        ]

    def false(views: list[TagView], image: int) -> list[TagView]:
        found = [view for view in views if view.number in three]
        if image % 10 == 0:
            rng = np.random.default_rng(image)
            pose = gtsam.Pose3(gtsam.Rot3.RzRyRx(rng.uniform(-1, 1, 3)), rng.uniform([-1, -1, 1], [1, 1, 3]))
            information = np.diag([1e5] * 3 + [1e6] * 3)
            found.append(TagView(three[image // 10 % 3], pose, information, 0.01, np.inf))
        return found

    return {
        "none": lambda views, _: [],
        "three": only(three),
        "all": only(best),
        "moved": moved,
        "twins": twins,
        "false": false,
    }


def lap_error_m(way: Trajectory, truth: Trajectory, lap_s: float) -> float:
    """By how much the way from the first pose to the end of the first lap is off, at the same two stamps."""
    ends = [0, int(np.abs(way.stamps_s - way.stamps_s[0] - lap_s).argmin())]
    true, known = truth_at(truth, way.stamps_s[ends], 0.05)
    assert len(known) == 2
    moved = [
        np.asarray(two[0].between(two[1]).translation())
        for two in (way[np.array(ends)].poses(), true.poses())
    ]
    return float(np.linalg.norm(moved[0] - moved[1]))


def main() -> None:
    """Map every drive in every way."""
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("homes", nargs="+", type=int)
    parser.add_argument("--lidar", action="store_true", help="with the lidar")
    parser.add_argument("--seconds", type=float, default=90.0)
    parser.add_argument("--tags", type=int, default=12, help="on the walls of each office")
    parser.add_argument("--only", nargs="+", help="these variants")
    arguments = parser.parse_args()
    config = load_config(overrides=["loops.enabled=false", "dense_map.enabled=false", "fusion.enabled=false"])
    for home in arguments.homes:
        rig = rig_of(lidar=arguments.lidar)
        log, places, lap_s = drive_of(arguments.folder, home, rig, arguments.tags, arguments.seconds)
        best, truth = best_of(log, places), read_tum(log / "groundtruth.txt")
        for name, alter in variants(best).items():
            if arguments.only and name not in arguments.only:
                continue
            known = places if name == "all" else places.model_copy(update={"surveyed": ()})
            sensors = config.sensors.model_copy(update={"tags": known})
            begun = time.process_time()
            with mock.patch.object(tags_of_keyframes, "find_tags", Altered(alter)):
                made = slam.map_log(log, config.model_copy(update={"sensors": sensors}))
            error = absolute_error(made.trajectory, truth).translation_m
            assert made.covariances is not None
            held = coverage(made.trajectory, made.covariances, truth, 0.02)
            lap = lap_error_m(made.trajectory, truth, lap_s) if np.isfinite(lap_s) else np.nan
            length = np.linalg.norm(np.diff(made.trajectory.positions_m, axis=0), axis=1).sum()
            print(
                f"office {home} {rig.name} {name}: {length:.0f} m, lap ends {lap:.3f} m off; "
                f"{error.rmse:.4f} m RMSE, worst {error.max:.3f}; covered {held.position:.2f}; "
                f"{time.process_time() - begun:.0f} CPU s",
                flush=True,
            )
            for line in [*made.notes, *made.warnings]:
                if "tag" in line.lower() or line.startswith("survey"):
                    print("   ", line, flush=True)
            made.close()


if __name__ == "__main__":
    main()
