"""Values of requests to the review page, checked by pydantic."""

import json
from collections.abc import Mapping
from typing import Annotated, Any, TypeVar

from pydantic import Field, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass

from pipeline.errors import InputError
from pipeline.text.files import refuse_constant

_MOST_PX = 1e7  # larger than any scan
Pixels = Annotated[float, Field(strict=True, gt=-_MOST_PX, lt=_MOST_PX)]
Places = dict[str, tuple[Pixels, Pixels]]  # columns and rows by fiducial
Value = TypeVar("Value")
Query = Mapping[str, str]  # parameters of a request


@dataclass(frozen=True)
class ClickedPlace:
    """Click on a named mark."""

    point: str
    col_px: Pixels
    row_px: Pixels


@dataclass(frozen=True)
class Decide:
    """Decisions to append. key: of a question about several frames."""

    decisions: Annotated[list[dict[str, Any]], Field(min_length=1)]
    key: str = ""


@dataclass(frozen=True)
class MeasureFrame:
    """Trial measurement of a frame from clicks."""

    image: str
    clicks: Annotated[tuple[ClickedPlace, ...], Field(min_length=3)]


@dataclass(frozen=True)
class ShownMarks:
    """Clicked marks of a scan, from which templates are learned. of: scan to measure by them; file: of the camera."""

    image: str
    px: Places
    of: str = ""
    file: str = ""


@dataclass(frozen=True)
class DrawnCamera:
    """Drawing of a camera, as `CameraDrawing` reads it. step: to apply; file: of the camera."""

    drawing: Any
    step: dict[str, Any] | None = None
    file: str = ""


def parse_values(kind: type[Value], given: Any, what: str = "the request") -> Value:
    """Check values of a request. Raises InputError with the first wrong one."""
    try:
        return TypeAdapter(kind).validate_python(given)
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False, include_input=False)[0]
        where = f"{what}'s {'.'.join(map(str, first['loc']))}" if first["loc"] else what
        raise InputError(f"{where}: {first['msg']}.") from None


def whole(query: Query, name: str, least: int, most: int) -> int:
    """Whole number between least and most. Raises InputError otherwise."""
    try:
        value = round(float(query.get(name, "0")))
    except (ValueError, OverflowError):
        value = least - 1
    if not least <= value <= most:
        raise InputError(f"{name} must be a whole number from {least} to {most}.")
    return value


def parse_json(text: str | bytes) -> Any:
    """Parse JSON with finite numbers only. Raises InputError for anything else."""
    try:
        return json.loads(text, parse_constant=refuse_constant)
    except (ValueError, RecursionError):
        raise InputError("that is no JSON.") from None
