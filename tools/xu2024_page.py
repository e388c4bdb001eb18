"""The page of the reproduction: one HTML file with embedded pictures."""

from __future__ import annotations

import io
import math
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from layer_page import table, write_parts
from xu2024_drive import DriveResult

import fusion
from fusion.panorama import join
from slam.evaluation.pages import parts


def write_page(
    path: Path, drives: list[DriveResult], results: dict[str, Any], details: dict[str, Any]
) -> None:
    """Write the page."""
    pieces = [
        _source_note(results["source"]),
        _homes_note(drives),
        "<h2>Figures against the goals</h2>",
        _goals(results),
        "<h2>Table 1: pairs by grade and room</h2>",
        *_table_1(drives),
    ]
    for drive in drives:
        if drive.pictures:
            pieces += _pictures(drive)
    pieces += ["<h2>Fig. 6: recall against eps</h2>", _recall(details)]
    pieces += ["<h2>By rig</h2>", _rigs(details), "<h2>Which model repairs better</h2>", _models(details)]
    pieces += ["<h2>Maps by home</h2>", _maps(details)]
    if details["half_real"]:
        pieces += [
            "<h2>Half real: a real Kinect, a virtual lidar</h2>",
            "<p class=note>The lidar here is virtual: a curve cast through the mesh of all frames (7-Scenes "
            "RedKitchen), 0.25 m below the camera, with 1 % of noise. The depth is a real Kinect's."
            "</p>",
            table(["", "value"], [[name, _number(value)] for name, value in details["half_real"].items()]),
        ]
    write_parts(path, "Xu2024: lidar curves and depth images repair each other", pieces)


def _source_note(source: str) -> str:
    """Where the data come from, before anything else."""
    if source == "simulator":
        text = (
            "Source: <b>the simulator</b>, not Robot@Home and not the paper's robot. Homes, sensors and"
            " faults are made up after data sheets; in exchange every fault is known. Scans and images come"
            " at the sensors' own times; wheels tell the turn in between."
        )
    else:
        text = "Source: <b>Robot@Home</b>, recorded. There is no truth: figures that need one are empty."
    return f"<p class=note>{text}</p>"


def _homes_note(drives: list[DriveResult]) -> str:
    """Which homes these are, and where the thresholds come from."""
    homes = sorted({drive.home for drive in drives})
    if homes == [0]:
        return ""
    return (
        f"<p>Homes {', '.join(map(str, homes))}. Every threshold of the repair was chosen on homes 11 to 18"
        " (<code>--first-home 11</code>), never on homes 1 to 5, which are the ones to score.</p>"
    )


def _goals(results: dict[str, Any]) -> str:
    """The headline, flat."""
    rows = []
    for group in ("registration", "repair", "map"):
        rows += [[f"{group}.{name}", _number(value)] for name, value in results[group].items()]
    return table(["figure", "value"], rows)


def _table_1(drives: list[DriveResult]) -> list[str]:
    """Grades by room: all drives of a home together, as published (rows, PCC) and ours."""
    pieces = []
    first_home = min(drive.home for drive in drives)
    for kind, title in (
        ("rows", "image rows, PCC, as published"),
        ("heights", "height slices, likelihood, ours"),
    ):
        rows = []
        rooms = dict.fromkeys(
            (d.rig, room) for d in drives if d.home == first_home for room, _ in sorted(d.grades[kind])
        )
        for rig, room in rooms:
            own = [d for d in drives if d.rig == rig and d.home == first_home]
            counts = [sum(d.grades[kind][(room, g.name)] for d in own) for g in fusion.Grade]
            share = f"{100.0 * counts[2] / max(sum(counts), 1):.1f} %"
            rows.append([f"{rig}, {room}", *map(str, counts), share])
        pieces += [f"<h3>{title}</h3>", table(["room (first home)", "low", "middle", "high", "high"], rows)]
    return pieces


def _pictures(drive: DriveResult) -> list[str]:
    """Fig. 4, 7 and 9 of one drive."""
    pieces = [f"<h2>{escape(drive.rig)}</h2>", "<h3>Fig. 4: score maps over (u, v), and the curves</h3>"]
    pieces += [_fig_4(drive.pictures), "<h3>Fig. 7: before and after</h3>", _fig_7(drive.pictures)]
    if "states" in drive.pictures:
        pieces += ["<h3>Fig. 9: the map before and after</h3>", _fig_9(drive.pictures["states"])]
    return pieces


def _fig_4(pictures: dict[str, Any]) -> str:
    """Three maps; rows and height slices side by side under them."""
    figure, axes = _figure(2, 3, (13.0, 7.0))
    for axis, (name, scores) in zip(axes[0], pictures["maps"].items(), strict=True):
        image = axis.imshow(scores, aspect="auto", cmap="viridis")
        v, u = np.unravel_index(np.argmax(scores), scores.shape)
        axis.plot(u, v, "r+")
        shown = "1 - inv_cos" if name == "inv_cos" else name
        axis.set(title=f"{shown}, peak ({u}, {v})", xlabel="u", ylabel="v (row)")
        figure.colorbar(image, ax=axis)
    for axis, (title, key) in zip(axes[1], (("row", "rows"), ("height slice", "heights")), strict=False):
        found: fusion.Registration = pictures[key]
        stack = join(found.stacks)
        angles = np.degrees(found.curve.bearings_rad())
        axis.plot(angles, found.curve.ranges_m, "r.", ms=3, label="lidar")
        camera = np.degrees(stack.bearings_rad() + found.yaw_rad)
        axis.plot(camera, stack.ranges_m[found.v], "b.", ms=3, label="image")
        where = f"v = {found.v}" if np.isnan(found.height_m) else f"h = {found.height_m:.2f} m"
        axis.set(title=f"{title}: u = {found.u}, {where}, PCC {found.pcc:.2f}", xlabel="bearing, degrees")
        axis.legend()
    found = pictures["heights"]
    image = axes[1, 2].imshow(found.score_map, aspect="auto", cmap="viridis", origin="lower")
    axes[1, 2].set(title="likelihood ratio of height slices, nats", xlabel="u", ylabel="height")
    figure.colorbar(image, ax=axes[1, 2])
    return _inline(figure)


def _fig_7(pictures: dict[str, Any]) -> str:
    """Each camera's depth before and after; the lidar curve with what was filled."""
    images, repaired = pictures["images"], pictures["repaired"]
    figure, axes = _figure(2, len(images) + 1, (5.0 * (len(images) + 1), 7.0))
    for column, (image, depth, source) in enumerate(
        zip(images, repaired.depth_m, repaired.depth_source, strict=True)
    ):
        turn = 1 if image.R_level_camera[2, 0] ** 2 > 0.5 else 0
        for axis, shown, title in (
            (axes[0, column], image.depth_m, "depth"),
            (axes[1, column], depth, "repaired"),
        ):
            axis.imshow(np.rot90(np.where(shown > 0.0, shown, np.nan), turn), vmin=0.5, vmax=5.0)
            axis.set(title=title, xticks=[], yticks=[])
        filled = np.rot90(source == fusion.Provenance.FILLED, turn)
        row, col = np.nonzero(filled)
        axes[1, column].plot(col, row, "r,")
    scan, last = pictures["scan"], axes[:, -1]
    bearings = scan.bearings_rad()
    for axis, ranges in zip(last, (scan.ranges_m, repaired.ranges_m), strict=True):
        _points(axis, bearings, ranges, np.ones(ranges.size, dtype=bool), "r", "lidar")
        axis.set_aspect("equal")
    for kind, color in ((fusion.Provenance.FILLED, "b"), (fusion.Provenance.INTERPOLATED, "c")):
        _points(last[1], bearings, repaired.ranges_m, repaired.lidar_source == kind, color, kind.name.lower())
    last[1].legend()
    return _inline(figure)


def _points(axis: Any, bearings: Any, ranges: Any, chosen: Any, color: str, label: str) -> None:
    """Some readings as points of the plane, forward up."""
    kept = chosen & np.isfinite(ranges)
    axis.plot(
        -ranges[kept] * np.sin(bearings[kept]),
        ranges[kept] * np.cos(bearings[kept]),
        color + ".",
        ms=2,
        label=label,
    )


def _fig_9(states: tuple[Any, Any]) -> str:
    """Two maps side by side."""
    figure, axes = _figure(1, 2, (13.0, 6.0))
    for axis, grid, title in zip(axes[0], states, ("lidar as it is", "repaired"), strict=True):
        axis.imshow(np.where(grid < 0, 35, grid), origin="lower", cmap="gray_r", vmin=0, vmax=100)
        axis.set(title=title, xticks=[], yticks=[])
    return _inline(figure)


def _recall(details: dict[str, Any]) -> str:
    """Recall of good, noise and burr pairs; the band is the paper's."""
    titles = {
        "zeros": "E over all pairs, a hole reads 0 (as published)",
        "smooth": "E over pairs with both readings, lidar smoothed",
        "raw": "E over pairs with both readings",
    }
    figure, axes = _figure(len(details["rigs"]), 3, (13.0, 3.6 * len(details["rigs"])))
    for row, (rig, found) in zip(axes, details["rigs"].items(), strict=True):
        for axis, (name, title) in zip(row, titles.items(), strict=True):
            curves = found["recall_variants"][name]
            for kind in ("good", "noise", "burr"):
                axis.plot(curves["eps_over_E"], curves[kind], "o-", ms=3, label=kind)
            axis.axvspan(1.0, math.sqrt(2.0), alpha=0.2)
            axis.axhline(0.9, color="gray", lw=0.8)
            axis.set(ylim=(0.3, 1.01), title=f"{rig}\n{title}", xlabel="eps / E")
            axis.legend()
    return _inline(figure)


def _rigs(details: dict[str, Any]) -> str:
    """Everything counted, rig by rig."""
    rigs = details["rigs"]
    rows = []
    for name in ("u_within_2_pair", "u_within_1_rig", "height_within_10cm_rig"):
        rows.append([name, *(_number(found["registration"][name]) for found in rigs.values())])
    first = next(iter(rigs.values()))
    for name in first["shares"]:
        if not name.startswith(("homography", "magsac", "rig_", "rigid")):
            cells = [
                f"{_number(found['shares'][name][0])} of {found['shares'][name][1]}"
                for found in rigs.values()
            ]
            rows.append([name, *cells])
    for name in first["medians"]:
        if not name.startswith(("homography", "magsac", "rig_", "rigid")):
            rows.append([f"median {name}", *(_number(found["medians"][name]) for found in rigs.values())])
    return table(["", *rigs], rows)


def _models(details: dict[str, Any]) -> str:
    """The same high-grade pairs repaired by each model."""
    rows = []
    for rig, found in details["rigs"].items():
        for model in ("homography", "magsac", "rigid", "rig"):
            cells = []
            for side in ("lidar", "depth"):
                for kind in ("hole", "burr", "worse"):
                    cells.append(_number(found["shares"][f"{model}_{side}_{kind}"][0]))
                cells.append(_number(found["medians"][f"{model}_{side}_hole_error"]))
            rows.append([f"{rig}, {model if model != 'rig' else 'rigid over the drive'}", *cells])
    heads = [
        f"{side} {kind}" for side in ("lidar", "depth") for kind in ("holes", "burrs", "worse", "error m")
    ]
    return table(["by one pair alone, high grade", *heads], rows)


def _maps(details: dict[str, Any]) -> str:
    """Fig. 9 as numbers."""
    rows = []
    keys = ("completeness_before", "completeness_after", "false_occupied_before", "false_occupied_after")
    for rig, found in details["rigs"].items():
        for home, scores in found["map_by_home"].items():
            rows.append([f"{rig}, home {home}", *(_number(scores[key]) for key in keys)])
    return table(["", *(key.replace("_", " ") for key in keys)], rows)


def _number(value: float | None) -> str:
    """Four digits, or a dash."""
    return "–" if value is None or not math.isfinite(value) else f"{value:.4g}"


def _figure(rows: int, columns: int, size: tuple[float, float]) -> Any:
    """A figure without a window."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False)


def _inline(figure: Any) -> str:
    """The figure as a PNG inside the page."""
    held = io.BytesIO()
    figure.savefig(held, format="png", dpi=80)
    return str(parts().image(held.getvalue(), "figure", "plot"))
