"""Builds the mesh of a street from boxes, prisms and leaves, with label and brightness of each."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from slam.measurements import Float32Array, FloatArray
from slam.simulation.home_model import BOX_TRIANGLES


class Label(IntEnum):
    """Class of a point, with the numbers of SemanticKITTI."""

    CAR = 10
    ROAD = 40
    PAVEMENT = 48
    BUILDING = 50
    LEAVES = 70
    TRUNK = 71
    POLE = 80
    MOVING_CAR = 252
    MOVING_CYCLIST = 253
    MOVING_PERSON = 254


@dataclass(frozen=True, slots=True)
class StreetMesh:
    """The static scene.

    Attributes
    ----------
    vertices, triangles
        (V, 3) map frame, (T, 3).
    label
        (T,) `Label`.
    brightness
        (T,) share of the light that is reflected at normal incidence.
    """

    vertices: Float32Array
    triangles: NDArray[np.int32]
    label: NDArray[np.uint32]
    brightness: Float32Array


class MeshBuilder:
    """Collects triangles."""

    def __init__(self) -> None:
        self._vertices: list[FloatArray] = []
        self._triangles: list[NDArray[np.int32]] = []
        self._marks: list[tuple[int, Label, float]] = []
        self._count = 0

    def add(
        self, vertices: FloatArray, triangles: NDArray[np.int32], label: Label, brightness: float
    ) -> None:
        """Add vertices (V, 3) and triangles (T, 3) of one class."""
        self._vertices.append(vertices)
        self._triangles.append(triangles + self._count)
        self._marks.append((len(triangles), label, brightness))
        self._count += len(vertices)

    def box(
        self,
        centre_m: tuple[float, float],
        size_m: tuple[float, float],
        height_m: tuple[float, float],
        yaw_rad: float,
        label: Label,
        brightness: float,
    ) -> None:
        """Add an upright box: its centre, length, width, lowest and highest z."""
        half = 0.5 * np.array(size_m)
        corners = np.array([(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)]) * half
        cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
        flat = corners @ np.array([[cos, sin], [-sin, cos]]) + centre_m
        vertices = np.vstack([np.column_stack([flat, np.full(4, z)]) for z in height_m])
        self.add(vertices, BOX_TRIANGLES, label, brightness)

    def prism(
        self,
        centre_m: tuple[float, float],
        radius_m: float,
        height_m: tuple[float, float],
        label: Label,
        brightness: float,
    ) -> None:
        """Add a pole or a trunk with eight sides and open ends."""
        turn = np.linspace(0.0, 2.0 * np.pi, 8, endpoint=False)
        flat = radius_m * np.column_stack([np.cos(turn), np.sin(turn)]) + centre_m
        vertices = np.vstack([np.column_stack([flat, np.full(8, z)]) for z in height_m])
        self.add(vertices, _strip(8, closed=True), label, brightness)

    def sheet(self, lower: FloatArray, upper: FloatArray, label: Label, brightness: float) -> None:
        """Add a strip of quadrangles between two lines of points (N, 3) each."""
        triangles = _strip(len(lower), closed=False)
        self.add(np.vstack([lower, upper]), triangles, label, brightness)

    def leaves(self, centre_m: FloatArray, radius_m: float, rng: np.random.Generator) -> None:
        """Add a tree crown: small triangles in a ball, most of them near its surface."""
        count = 220
        outward = rng.normal(size=(count, 3))
        outward *= (rng.uniform(0.3, 1.0, count) ** (1.0 / 3.0) / np.linalg.norm(outward, axis=1))[:, None]
        corners = centre_m + radius_m * outward[:, None] + rng.normal(0.0, 0.12, (count, 3, 3))
        triangles = np.arange(3 * count, dtype=np.int32).reshape(-1, 3)
        self.add(corners.reshape(-1, 3), triangles, Label.LEAVES, rng.uniform(0.2, 0.5))

    def built(self) -> StreetMesh:
        """Return the whole mesh."""
        counts = [count for count, _, _ in self._marks]
        return StreetMesh(
            np.vstack(self._vertices).astype(np.float32),
            np.vstack(self._triangles).astype(np.int32),
            np.repeat([int(label) for _, label, _ in self._marks], counts).astype(np.uint32),
            np.repeat([brightness for _, _, brightness in self._marks], counts).astype(np.float32),
        )


def _strip(count: int, *, closed: bool) -> NDArray[np.int32]:
    """Triangles between two rows of ``count`` vertices, the second behind the first."""
    first = np.arange(count if closed else count - 1, dtype=np.int32)
    second = (first + 1) % count
    lower = np.column_stack([first, second, second + count])
    return np.vstack([lower, np.column_stack([first, second + count, first + count])]).astype(np.int32)
