"""The parts of report.html that only runs with cameras or with a ground truth have."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from slam.evaluation.camera_figures import side_png, tracking_png, truth_png
from slam.evaluation.cloud_picture import CloudPicture
from slam.evaluation.page_parts import image, paragraph, section, table
from slam.evaluation.report_figures import map_png
from slam.evaluation.truth_comparison import TruthComparison
from slam.mapper.scan_record import CameraRecord
from slam.measurements import FloatArray


@dataclass(frozen=True, slots=True)
class CameraRow:
    """A camera and what became of its frames.

    Attributes
    ----------
    registration
        Whether its colour is registered to its depth, in one line with the reason.
    """

    name: str
    record: CameraRecord
    registration: str


def camera_sections(cameras: Sequence[CameraRow]) -> Iterator[str]:
    """A table of all cameras, and how the frames of each fitted."""
    if not cameras:
        return
    heads = (
        "camera",
        "frames",
        "lost",
        "degenerate",
        "motions",
        "refused",
        "overlap",
        "features",
        "px",
        "mm",
    )
    counts = table(heads, map(_counts, cameras), css_class="numbers")
    registrations = ((camera.name, camera.registration) for camera in cameras)
    colors = table(("camera", "its colour camera"), registrations, css_class="notes")
    told = paragraph(
        "Motions are what a robot's camera told from moment to moment and from keyframe to keyframe; refused "
        "ones left the floor. Overlap, agreeing features, reprojection and distance to the surface are "
        "medians over the frames."
    )
    yield section("Cameras", counts + told + colors)
    for camera in cameras:
        plots = image(tracking_png(camera.record.frames), f"tracking of {camera.name} over time", "plot")
        yield section(f"Tracking: {camera.name}", plots)


def truth_section(truth: TruthComparison, *, spatial: bool) -> str:
    """The trajectory over its truth."""
    shift, turn = truth.error.translation_m, truth.error.rotation_rad
    text = (
        f"Absolute trajectory error after rigid alignment over {truth.error.count:,} poses: RMSE "
        f"{shift.rmse:.4f} m, mean {shift.mean:.4f}, median {shift.median:.4f}, greatest {shift.max:.4f}; "
        f"rotation RMSE {math.degrees(turn.rmse):.2f} degrees."
    )
    picture = image(
        truth_png(truth, spatial=spatial), "trajectory and truth, and the error over time", "plot"
    )
    return section("Against the ground truth", paragraph(text) + picture)


def cloud_section(cloud: CloudPicture) -> str:
    """The coloured map from above, with the trajectory."""
    png = map_png(
        cloud.path_xy,
        np.empty((0, 4)),
        image=cloud.image,
        resolution_m=cloud.resolution_m,
        origin_xy=cloud.origin_xy,
    )
    text = paragraph("Of surfaces above each other the highest is shown; ceilings are looked through.")
    return section("Coloured map from above", text + image(png, "coloured point cloud from above"))


def side_view(trajectory_m: FloatArray) -> str:
    """The trajectory from the side."""
    return image(side_png(trajectory_m), "trajectory from the side")


def _counts(camera: CameraRow) -> tuple[str, ...]:
    """The numbers of one camera as text; what was never measured is a dash."""
    record, frames = camera.record, camera.record.frames
    medians = [
        (frames.overlaps, "{:.2f}"),
        (frames.feature_counts, "{:.0f}"),
        (frames.residuals_px, "{:.2f}"),
        (1000.0 * frames.residuals_m, "{:.1f}"),
    ]
    return (
        camera.name,
        f"{frames.stamps_s.size:,}",
        f"{np.count_nonzero(frames.unmatched):,}",
        f"{np.count_nonzero(frames.degenerate):,}",
        f"{record.motions:,}" if record.motions else "–",
        f"{record.refused_motions:,}" if record.motions else "–",
        *(_median(values, style) for values, style in medians),
    )


def _median(values: FloatArray, style: str) -> str:
    """Median of what was measured."""
    known = values[np.isfinite(values)]
    return style.format(float(np.median(known))) if known.size else "–"
