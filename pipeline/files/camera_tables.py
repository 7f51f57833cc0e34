"""Tables of camera.toml: keys with type, unit, default and meaning, and values that need special checks."""

import re
from collections.abc import Mapping
from dataclasses import field
from functools import partial
from typing import Annotated, Any, cast, get_args

from pydantic import Field

from adjust.functional_model.families import FAMILY_NAMES, family
from adjust.functional_model.lens import Decentering
from measure.marks import shapes
from pipeline.files.mark_table import LearnedFrom
from pipeline.text import table_models as models
from pipeline.text.table_models import text

DEFAULT_SIGMA_MM = 1.0  # Torlegård's a-priori standard deviation for a prior that only fixes the datum
READS: Mapping[str, str] = {"rightward": "0", "upward": "90", "leftward": "180", "downward": "270"}  # poses
_WRITTEN = re.compile(
    rf"(?P<side>{'|'.join(get_args(shapes.Side))})(?::(?P<plate> plate)?(?: reads (?P<reads>{'|'.join(READS)}))?)?"
)


def _frame(value: Any) -> shapes.Point:
    width, height = models.pair(value)
    if min(width, height) <= 0.0:
        raise ValueError(f"must be two positive lengths, [width, height], not {[width, height]}.")
    return width, height


def _number(value: Any) -> str:
    if text(value) and not value.isdigit():
        raise ValueError(f'must be digits in quotes, as the plate has them: "13182", not {value!r}.')
    return str(value)


def _writing(value: Any) -> tuple[shapes.WrittenPlace, ...]:
    """Places such as "left: reads upward", "right: plate reads downward", or "left" where the direction is unknown."""
    places = []
    for place in models.texts(value):
        match = _WRITTEN.fullmatch(place.strip())
        if match is None:
            raise ValueError(
                f"has {place!r}. A place is a side of the frame (left, right, top, bottom), or one with the direction "
                '(rightward, upward, leftward, downward), as "left: reads upward", or "right: plate reads downward".'
            )
        pose = READS[match["reads"]] if match["reads"] else None
        places.append(shapes.WrittenPlace(cast(shapes.Side, match["side"]), pose, bool(match["plate"])))
    return tuple(places)


def written_place_text(place: shapes.WrittenPlace) -> str:
    """Text of a place in a camera file."""
    direction = [word for word, pose in READS.items() if pose == place.pose]
    parts = [*(["plate"] if place.plate else []), *(f"reads {word}" for word in direction)]
    return f"{place.side}: {' '.join(parts)}" if parts else place.side


def _fiducial_id(value: Any) -> str:
    if not text(value) or value != value.strip() or not value.isprintable():
        raise ValueError(f"must be text on one line without blanks at its ends, not {value!r}.")
    return str(value)


@models.table_model
class Source:
    """[source] of a camera file: where its numbers come from, and the number of calibration reports or frames behind
    them."""

    text: Annotated[str, "Where the numbers come from."]
    reports: Annotated[int, "How many calibration reports."] = 0
    frames: Annotated[int, "How many frames were adjusted."] = 0
    scanners: Annotated[int, "Of how many scanners."] = 0
    archives: Annotated[int, "In how many projects."] = 0
    spread_mm: Annotated[Mapping[str, models.NotNegative], "Standard deviation between archives, beyond their own."] = (
        field(default_factory=dict)
    )


@models.table_model
class SigmaTable:
    """[sigma] of a camera file."""

    principal_distance_mm: Annotated[models.Sigma | None, "Absent: 1 with fiducials, else free."] = None
    principal_point_mm: Annotated[models.SigmaPair | None, "Absent: as the principal distance."] = None
    calibration: Annotated[
        models.FilePath | None, "adjustment.json of an earlier calibration, with its covariance."
    ] = None
    calibration_fiducials: Annotated[bool, "Whether the earlier calibration says where the fiducials are."] = True


_FAMILY = models.Key("name of a family", partial(models.known_name, find=family, names=FAMILY_NAMES))


@models.table_model
class DistortionTable:
    """[distortion] of a camera file."""

    family: Annotated[str, _FAMILY, "Distortion model."] = "none"
    decentering: Annotated[Decentering, "Decentering terms of torlegard."] = "reduced"
    r0_mm: Annotated[models.NotNegative, "Radius of no distortion."] = 0.0
    r0_dm: Annotated[models.Positive | None, "The same of juhl."] = None
    half_mm: Annotated[
        models.NumberOrPair | None, "Unit of length of self-calibration sets; absent: half of frame_mm."
    ] = None
    value: Annotated[Mapping[str, float], "Values of the parameters; absent: 0."] = field(default_factory=dict)
    sigma: Annotated[Mapping[str, models.Sigma], "Of the parameters; absent: fixed; all: of every parameter."] = field(
        default_factory=dict
    )

    def __post_init__(self) -> None:
        """Raises WrongKey for settings that the family does not have, or that are not positive."""
        in_dm = self.family == "juhl"  # Juhl uses decimetres
        has_half = family(self.family).needs == "half_mm"
        for key, is_wrong in (("r0_mm", in_dm), ("r0_dm", not in_dm), ("half_mm", not has_half)):
            if is_wrong and getattr(self, key):
                raise models.WrongKey(key, f"is no key of this table where the family is {self.family}. Take it out.")
        if in_dm and self.r0_dm is None:
            raise models.WrongKey("r0_dm", "is missing. Add it.")
        if self.half_mm is not None and min(self.half_mm) <= 0.0:
            raise models.WrongKey("half_mm", f"must be positive, not {list(self.half_mm)}.")


@models.table_model
class FiducialTable:
    """[[fiducial]] of a camera file."""

    id: Annotated[str, models.Key("text", _fiducial_id), "Name of the mark."]
    xy_mm: Annotated[shapes.Point, "Given coordinates."]
    sigma_mm: Annotated[models.SigmaPair, "Of the given coordinates."] = (DEFAULT_SIGMA_MM, DEFAULT_SIGMA_MM)
    mark: Annotated[str | None, 'Name of a table [mark.NAME], or "none" to pass it over.'] = None
    template_origin_mm: Annotated[
        shapes.Point | None, Field(alias="seen_mm"), "Of a learned mark: where its template has its origin."
    ] = None


@models.table_model
class FiducialDistanceTable:
    """[[fiducial_distance]] of a camera file."""

    start: Annotated[str, Field(alias="from"), "Name of a mark."]
    end: Annotated[str, Field(alias="to"), "Name of another."]
    mm: Annotated[models.Positive, "Distance between them."]
    sigma_mm: Annotated[models.Positive, "Its standard deviation."]


@models.table_model
class ClicksTable:
    """[clicks] of a camera file."""

    scan: Annotated[str, "Name of the scan."]
    px: Annotated[Mapping[str, tuple[float, float]], "Columns and rows by fiducial."]


@models.table_model
class CameraTable:
    """camera.toml."""

    name: Annotated[str | None, "Absent: as the file."] = None
    frame_mm: Annotated[shapes.Point | None, models.Key("[width, height]", _frame), "Of the exposed frame."] = None
    principal_distance_mm: Annotated[models.Positive | None, "Absent: found from the points."] = None
    principal_point_mm: Annotated[shapes.Point | None, "Absent: the origin, where fiducials lie about it."] = None
    number: Annotated[str, models.Key("digits", _number), "Of the camera or its cone, as its plate has it."] = ""
    writing: Annotated[
        tuple[shapes.WrittenPlace, ...],
        models.Key("list of places", _writing),
        'Where the camera writes on its film, as "left: reads upward".',
    ] = ()
    sigma: Annotated[SigmaTable, "Prior standard deviations."] = SigmaTable()
    distortion: Annotated[DistortionTable, "Distortion of the lens."] = DistortionTable()
    fiducial: Annotated[tuple[FiducialTable, ...], "Fiducial marks, one table each."] = ()
    fiducial_distance: Annotated[
        tuple[FiducialDistanceTable, ...], "Measured distances between fiducials: from, to, mm, sigma_mm."
    ] = ()
    mark: Annotated[models.Values, "Drawings of the marks."] = field(default_factory=dict)
    source: Annotated[Source | None, "Where the numbers come from."] = None
    clicks: Annotated[ClicksTable | None, "Clicked places of marks to be learned."] = None
    learned_from: Annotated[LearnedFrom | None, "As the program writes it with learned marks."] = None
