"""Places known before a log is mapped: tags, surveyed points, the initial pose."""

from __future__ import annotations

from typing import TypeAlias

from pydantic import Field, model_validator

from slam.config.files import StrictModel

# Next to a recording, it is found automatically.
FILE_NAME = "tags.yaml"
Place: TypeAlias = tuple[float, float] | tuple[float, float, float]


class SurveyedPlace(StrictModel):
    """A point with known coordinates: the centre of a tag, or the position of the base at a given time."""

    tag: int | None = Field(default=None, ge=0, description="number of the tag at this point")
    stamp_s: float | None = Field(default=None, description="when the base stood there, by the log's clock")
    at_m: Place = Field(description="x, y and optionally z in the surveyor's frame, whose z is up")
    sigma_m: float = Field(default=0.005, gt=0, description="standard deviation of each coordinate")
    check: bool = Field(default=False, description="not used for mapping, but compared with the finished map")

    @model_validator(mode="after")
    def _one_of_both(self) -> SurveyedPlace:
        """Check that either a tag or a time is given."""
        if (self.tag is None) == (self.stamp_s is None):
            raise ValueError("a surveyed place has either a tag or a stamp_s")
        return self


class KnownStart(StrictModel):
    """Position and heading of the base at the beginning of the log."""

    at_m: Place = Field(description="x, y and optionally z in the surveyor's frame")
    yaw_deg: float = Field(description="heading from the x axis, counter-clockwise")
    sigma_m: float = Field(default=0.05, gt=0, description="standard deviation of each coordinate")
    sigma_deg: float = Field(default=2.0, gt=0, description="standard deviation of the heading")


class KnownPlaces(StrictModel):
    """Tags and surveyed points."""

    family: str = Field(
        default="36h11",
        pattern=r"^(16h5|25h9|36h10|36h11|mip_36h12|original|[4-7]x[4-7]_(50|100|250|1000))$",
        description="tag family: AprilTag 16h5, 25h9, 36h10, 36h11; ArUco 4x4_50 to 7x7_1000, original, "
        "mip_36h12",
    )
    size_m: float | None = Field(
        default=None, gt=0, description="side of the black square of a tag; null: tags are not detected"
    )
    sizes_m: dict[int, float] = Field(default={}, description="side of tags of another size, by number")
    surveyed: tuple[SurveyedPlace, ...] = Field(default=(), description="points with known coordinates")
    start: KnownStart | None = Field(default=None, description="initial pose of the base")

    def plain(self) -> dict[str, object]:
        """Return plain values, without defaults."""
        return self.model_dump(mode="json", exclude_defaults=True)
