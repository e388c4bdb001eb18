"""What a person knows of places before a log is mapped: tags that hang, surveyed places, where it begins."""

from __future__ import annotations

from typing import TypeAlias

from pydantic import Field, model_validator

from slam.config.strict import StrictModel

# Beside a recording, it is found by itself.
FILE_NAME = "tags.yaml"
Place: TypeAlias = tuple[float, float] | tuple[float, float, float]


class SurveyedPlace(StrictModel):
    """A place whose coordinates are known: the middle of a tag, or where the base stood at a time."""

    tag: int | None = Field(default=None, ge=0, description="number of the tag that hangs there")
    stamp_s: float | None = Field(default=None, description="when the base stood there, by the log's clock")
    at_m: Place = Field(description="x, y and perhaps z in the surveyor's frame, whose z is up")
    sigma_m: float = Field(default=0.005, gt=0, description="of each coordinate")
    check: bool = Field(default=False, description="not used, but compared with the map when it is done")

    @model_validator(mode="after")
    def _one_of_both(self) -> SurveyedPlace:
        """A tag, or a time."""
        if (self.tag is None) == (self.stamp_s is None):
            raise ValueError("a surveyed place has either a tag or a stamp_s")
        return self


class KnownStart(StrictModel):
    """Where the base stands when the log begins, and where it looks."""

    at_m: Place = Field(description="x, y and perhaps z in the surveyor's frame")
    yaw_deg: float = Field(description="from the x axis, counter-clockwise")
    sigma_m: float = Field(default=0.05, gt=0, description="of each coordinate")
    sigma_deg: float = Field(default=2.0, gt=0, description="of the heading")


class KnownPlaces(StrictModel):
    """Tags, and places that were surveyed."""

    family: str = Field(
        default="36h11",
        pattern=r"^(16h5|25h9|36h10|36h11|mip_36h12|original|[4-7]x[4-7]_(50|100|250|1000))$",
        description="of the tags: AprilTag 16h5, 25h9, 36h10, 36h11; ArUco 4x4_50 to 7x7_1000, "
        "original, mip_36h12",
    )
    size_m: float | None = Field(
        default=None, gt=0, description="side of their black squares; none: tags are not looked for"
    )
    sizes_m: dict[int, float] = Field(default={}, description="of tags of another size, by number")
    surveyed: tuple[SurveyedPlace, ...] = Field(default=(), description="places whose coordinates are known")
    start: KnownStart | None = Field(default=None, description="where the log begins")

    def plain(self) -> dict[str, object]:
        """As plain values, without what is as by default."""
        return self.model_dump(mode="json", exclude_defaults=True)
