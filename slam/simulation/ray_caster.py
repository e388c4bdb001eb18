"""Casts rays at triangles with Embree."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from slam.errors import LibraryError
from slam.measurements import Float32Array


class RayCaster:
    """A mesh in Embree's tree, built once.

    Parameters
    ----------
    vertices
        (V, 3).
    triangles
        (T, 3) indices of vertices.

    Raises
    ------
    LibraryError
        Embree's Python binding cannot be loaded.
    """

    def __init__(self, vertices: Float32Array, triangles: NDArray[np.int32]) -> None:
        try:
            from embreex.mesh_construction import TriangleMesh
            from embreex.rtcore_scene import EmbreeScene
        except (ImportError, OSError) as error:
            raise LibraryError(
                f"no ray casting: embreex does not load ({error}); it has wheels for Linux and Windows on "
                "x86-64 and for macOS; simulate there, the recorded log maps anywhere"
            ) from error
        # Robust: no ray slips through the edge that two triangles share.
        self._scene = EmbreeScene(robust=True)
        TriangleMesh(self._scene, vertices.astype(np.float32), triangles.astype(np.int32))

    def cast(self, rays: Float32Array) -> tuple[Float32Array, NDArray[np.int32], Float32Array]:
        """Find the first triangle along each ray.

        Parameters
        ----------
        rays
            (N, 6) origin and direction.

        Returns
        -------
        (N,) distance in lengths of the direction, (N,) index of the triangle, (N, 3) its normal, not unit,
        by the right hand about its corners. Without a hit: ``inf``, -1 and zero.
        """
        origins, directions = rays[:, :3], rays[:, 3:]
        hits = self._scene.run(origins, directions, dists=np.inf, query="DISTANCE", output=True)
        return hits["tfar"], hits["primID"], hits["Ng"]
