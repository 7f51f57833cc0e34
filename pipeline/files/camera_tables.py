"""Tables of camera.toml: keys with type, unit, default and meaning, and values that need special checks."""

import re
from collections.abc import Mapping
from typing import Annotated, cast, get_args

from pydantic import Field
from pydantic.dataclasses import dataclass

from adjust.functional_model.families import FAMILY_NAMES, family
from adjust.functional_model.lens import Decentering
from measure.marks import shapes
from pipeline.files.mark_table import Drawing, LearnedFrom, read_marks
from pipeline.text.table_models import (
    FLAG,
    NOT_NEGATIVE,
    NUMBER_OR_PAIR,
    PAIR,
    PATH,
    POSITIVE,
    SIGMA,
    SIGMA_PAIR,
    TABLE,
    TEXT,
    Key,
    choice,
    subtable,
    subtables,
    whole,
)
from pipeline.text.tables import Table
from pipeline.text.wording import did_you_mean

DEFAULT_SIGMA_MM = 1.0  # Torlegård's a-priori standard deviation for a prior that only fixes the datum
READS: Mapping[str, str] = {"rightward": "0", "upward": "90", "leftward": "180", "downward": "270"}  # poses
_WRITTEN = re.compile(
    rf"(?P<side>{'|'.join(get_args(shapes.Side))})(?::(?P<plate> plate)?(?: reads (?P<reads>{'|'.join(READS)}))?)?"
)


@dataclass(frozen=True, config=TABLE)
class Source:
    """[source] of a camera file: where its numbers come from, and the number of calibration reports or frames behind
    them."""

    text: Annotated[str, TEXT] = Field(description="Where the numbers come from.")
    reports: Annotated[int, whole()] = Field(default=0, description="How many calibration reports.")
    frames: Annotated[int, whole()] = Field(default=0, description="How many frames were adjusted.")
    scanners: Annotated[int, whole()] = Field(default=0, description="Of how many scanners.")
    archives: Annotated[int, whole()] = Field(default=0, description="In how many projects.")
    spread_mm: Annotated[
        Mapping[str, float], Key("numbers by quantity", lambda table, key: _numbers(table.table(key)))
    ] = Field(default_factory=dict, description="Standard deviation between archives, beyond their own.")


def _numbers(table: Table) -> dict[str, float]:
    return {name: table.number(name, least=0.0) for name in table.names()}


@dataclass(frozen=True, kw_only=True, config=TABLE)
class SigmaTable:
    """[sigma] of a camera file."""

    principal_distance_mm: Annotated[float | None, SIGMA] = Field(
        default=None, description="Absent: 1 with fiducials, else free."
    )
    principal_point_mm: Annotated[shapes.Point | None, SIGMA_PAIR] = Field(
        default=None, description="Absent: as the principal distance."
    )
    calibration: Annotated[str | None, PATH] = Field(
        default=None, description="adjustment.json of an earlier calibration, with its covariance."
    )
    calibration_fiducials: Annotated[bool, FLAG] = Field(
        default=True, description="Whether the earlier calibration says where the fiducials are."
    )


@dataclass(frozen=True, kw_only=True, config=TABLE)
class DistortionTable:
    """[distortion] of a camera file."""

    family: Annotated[str, Key("name of a family", lambda table, key: _family(table))] = Field(
        default="none", description="Distortion model."
    )
    decentering: Annotated[Decentering, choice("reduced", "paper")] = Field(
        default="reduced", description="Decentering terms of torlegard."
    )
    r0_mm: Annotated[float, NOT_NEGATIVE] = Field(default=0.0, description="Radius of no distortion.")
    r0_dm: Annotated[float | None, POSITIVE] = Field(default=None, description="The same of juhl.")
    half_mm: Annotated[shapes.Point | None, NUMBER_OR_PAIR] = Field(
        default=None, description="Unit of length of self-calibration sets; absent: half of frame_mm."
    )
    value: Annotated[object, Key("numbers by parameter", Table.table)] = Field(
        default=None, description="Values of the parameters; absent: 0."
    )
    sigma: Annotated[object, Key("standard deviations by parameter", Table.table)] = Field(
        default=None, description="Of the parameters; absent: fixed; all: of every parameter."
    )


@dataclass(frozen=True, kw_only=True, config=TABLE)
class FiducialTable:
    """[[fiducial]] of a camera file."""

    id: Annotated[str, Key("text", lambda table, key: _fiducial_id(table))] = Field(description="Name of the mark.")
    xy_mm: Annotated[shapes.Point, PAIR] = Field(description="Given coordinates.")
    sigma_mm: Annotated[shapes.Point, SIGMA_PAIR] = Field(
        default=(DEFAULT_SIGMA_MM, DEFAULT_SIGMA_MM), description="Of the given coordinates."
    )
    mark: Annotated[str | None, TEXT] = Field(
        default=None, description='Name of a table [mark.NAME], or "none" to pass it over.'
    )
    seen_mm: Annotated[shapes.Point | None, PAIR] = Field(
        default=None, description="Of a learned mark: where its template has its origin."
    )


@dataclass(frozen=True, kw_only=True, config=TABLE)
class CameraTable:
    """camera.toml."""

    name: Annotated[str | None, TEXT] = Field(default=None, description="Absent: as the file.")
    frame_mm: Annotated[shapes.Point | None, Key("[width, height]", lambda table, key: _frame(table))] = Field(
        default=None, description="Of the exposed frame."
    )
    principal_distance_mm: Annotated[float | None, POSITIVE] = Field(
        default=None, description="Absent: found from the points."
    )
    principal_point_mm: Annotated[shapes.Point | None, PAIR] = Field(
        default=None, description="Absent: the origin, where fiducials lie about it."
    )
    number: Annotated[str, Key("digits", lambda table, key: _number(table))] = Field(
        default="", description="Of the camera or its cone, as its plate has it."
    )
    writing: Annotated[tuple[shapes.WrittenPlace, ...], Key("list of places", lambda table, key: _writing(table))] = (
        Field(default=(), description='Where the camera writes on its film, as "left: reads upward".')
    )
    sigma: Annotated[SigmaTable, subtable(SigmaTable)] = Field(
        default=SigmaTable(), description="Prior standard deviations."
    )
    distortion: Annotated[DistortionTable, subtable(DistortionTable)] = Field(
        default=DistortionTable(), description="Distortion of the lens."
    )
    fiducial: Annotated[tuple[FiducialTable, ...], subtables(FiducialTable)] = Field(
        default=(), description="Fiducial marks, one table each."
    )
    fiducial_distance: Annotated[object, Key("tables", Table.tables)] = Field(
        default=(), description="Measured distances between fiducials: from, to, mm, sigma_mm."
    )
    mark: Annotated[Mapping[str, Drawing], Key("tables by name", lambda table, key: read_marks(table.table(key)))] = (
        Field(default_factory=dict, description="Drawings of the marks.")
    )
    source: Annotated[Source | None, subtable(Source)] = Field(default=None, description="Where the numbers come from.")
    clicks: Annotated[object, Key("table", Table.table)] = Field(
        default=None, description="scan and px, columns and rows by fiducial, of marks to be learned."
    )
    learned_from: Annotated[LearnedFrom | None, subtable(LearnedFrom)] = Field(
        default=None, description="As the program writes it with learned marks."
    )


def _frame(table: Table) -> shapes.Point:
    frame = table.pair("frame_mm")
    if min(frame) <= 0.0:
        raise table.error("frame_mm", f"must be two positive lengths, [width, height], not {list(frame)}.")
    return frame


def _number(table: Table) -> str:
    number = table.text("number")
    if number and not number.isdigit():
        raise table.error("number", f'must be digits in quotes, as the plate has them: "13182", not {number!r}.')
    return number


def _writing(table: Table) -> tuple[shapes.WrittenPlace, ...]:
    """Places such as "left: reads upward", "right: plate reads downward", or "left" where the direction is unknown."""
    places = []
    for text in table.texts("writing"):
        match = _WRITTEN.fullmatch(text.strip())
        if match is None:
            raise table.error(
                "writing",
                f"has {text!r}. A place is a side of the frame (left, right, top, bottom), or one with the direction "
                '(rightward, upward, leftward, downward), as "left: reads upward", or "right: plate reads downward".',
            )
        pose = READS[match["reads"]] if match["reads"] else None
        places.append(shapes.WrittenPlace(cast(shapes.Side, match["side"]), pose, bool(match["plate"])))
    return tuple(places)


def written_place_text(place: shapes.WrittenPlace) -> str:
    """Text of a place in a camera file."""
    direction = [word for word, pose in READS.items() if pose == place.pose]
    parts = [*(["plate"] if place.plate else []), *(f"reads {word}" for word in direction)]
    return f"{place.side}: {' '.join(parts)}" if parts else place.side


def _fiducial_id(table: Table) -> str:
    id = table.text("id")
    if not id or id != id.strip() or not id.isprintable():
        raise table.error("id", f"must be text on one line without blanks at its ends, not {id!r}.")
    return id


def _family(table: Table) -> str:
    name = table.text("family")
    try:
        family(name)
    except ValueError as error:
        raise table.error("family", f"{error}.{did_you_mean(name, FAMILY_NAMES)}") from None
    return name
