"""Loads Open3D on demand: it takes most of a second, and needs system libraries."""

from __future__ import annotations

from typing import Any

from slam.errors import LibraryError


def load_open3d() -> Any:
    """The module.

    Raises
    ------
    LibraryError
        It is not installed, or a system library that it needs is missing.
    """
    try:
        import open3d
    except ModuleNotFoundError as error:
        raise LibraryError(f"{error.name} is not installed: pip install 'scanweave[compare]'") from error
    except (ImportError, OSError) as error:
        raise LibraryError(
            f"Open3D does not load ({error}); on Debian: apt-get install libegl1 libgl1 libx11-6 libusb-1.0-0"
        ) from error
    return open3d
