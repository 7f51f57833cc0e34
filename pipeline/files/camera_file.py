"""camera.toml: the camera as it is given, for the measurement (its marks) and for the adjustment (its priors)."""

import dataclasses
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, cast, get_args

import numpy as np
from pydantic import Field
from pydantic.dataclasses import dataclass

from adjust.functional_model.families import FAMILY_NAMES, family, parameter_names
from adjust.functional_model.lens import Decentering, Distortion, Prior
from adjust.problem.camera import Camera, Fiducial, FiducialDistance
from measure.marks import shapes
from measure.marks.rendering import extent_px
from pipeline.errors import InputError
from pipeline.files.earlier_calibration import EarlierCalibration, read_calibration
from pipeline.files.mark_table import Clicks, Drawing, LearnedFrom, read_clicks, read_marks
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
    read_model,
    subtable,
    subtables,
    whole,
)
from pipeline.text.tables import Table, read_toml
from pipeline.text.text_file import SMALLEST_SIGMA
from pipeline.text.wording import did_you_mean

FIELD_RATIO = 50.0  # of principal distance and half the diagonal, either way: 2.3 degrees of field to 178

NO_MARK = "none"  # a fiducial that is not to be looked for in scans
CORNER_REACH = 1 / 6  # of half the frame: how far along its edges a corner is measured where nobody says
DEFAULT_SIGMA_MM = 1.0  # Torlegård's a-priori standard deviation where only a datum is wanted
_FEWEST_ABOUT_ORIGIN = 3  # fiducials that show where their middle is...
_OFF_MIDDLE = 0.25  # ...and how far the origin lies from it, in their extent, where it is none of their middle


def check_units(
    table: Table,
    frame_mm: tuple[float, float],
    distance_mm: float | None,
    fiducials: Sequence[tuple[Table, shapes.Point, shapes.Mark | shapes.LearnedMark | None]],
) -> None:
    """Raises InputError for lengths that are impossible in a frame of that size.

    distance_mm: the principal distance, None where it is not given. fiducials: each one's table, place and mark.
    """
    frame = f"the frame of {frame_mm[0]:g} x {frame_mm[1]:g} mm"
    half_diagonal = math.hypot(*frame_mm) / 2
    if distance_mm is not None and not 1 / FIELD_RATIO < distance_mm / half_diagonal < FIELD_RATIO:
        raise table.error("principal_distance_mm", f"{distance_mm:g} mm is impossible for {frame}. Give both in mm.")
    places = [xy for _, xy, _ in fiducials]
    apart_mm = float(np.ptp(places, axis=0).max()) if len(places) > 1 else math.inf
    for entry, xy, mark in fiducials:
        size_mm = _size_mm(mark)
        if max(map(abs, xy)) > 2 * max(frame_mm):
            raise entry.error("xy_mm", f"lies far outside of {frame}. Give mm from its middle.")
        if apart_mm < max(frame_mm) / FIELD_RATIO:
            raise entry.error("xy_mm", f"all fiducials lie within {apart_mm:.3g} mm, in {frame}. Give mm.")
        if size_mm > min(frame_mm) / 2:
            raise entry.error("mark", f"is drawn {size_mm:.4g} mm large, in {frame}. Give its sizes in mm.")


def _size_mm(mark: shapes.Mark | shapes.LearnedMark | None) -> float:
    """Width or height, whichever is larger; 0 where nothing is drawn, or the frame's edges themselves are."""
    if mark is None or isinstance(mark, shapes.FrameCorner):
        return 0.0
    if isinstance(mark, shapes.LearnedMark):
        return mark.size_mm
    return float(np.ptp(extent_px(mark, np.eye(2, 3)), axis=0).max())


@dataclasses.dataclass(frozen=True)
class GivenFiducial:
    """A fiducial of the camera file; mark None: it can be adjusted but not measured. passed_over: and need not be.
    seen_mm: where a learned mark's template has its origin in the scan that it was first cut from."""

    id: str
    xy_mm: shapes.Point
    sigma_mm: shapes.Point
    mark: shapes.Mark | shapes.LearnedMark | None
    passed_over: bool = False
    seen_mm: shapes.Point | None = None

    @property
    def prior_sigma_mm(self) -> tuple[float, float]:
        """For the adjustment: a learned mark is measured where its template has its origin, somewhere on the mark. What
        the file fixes stays fixed."""
        sx, sy = (sigma and math.hypot(sigma, shapes.LEARNED_ORIGIN * self.learned_mm) for sigma in self.sigma_mm)
        return sx, sy

    @property
    def learned_mm(self) -> float:
        """The size of a learned mark, or of one that is to be; 0 of others."""
        if isinstance(self.mark, shapes.MarkTemplate):
            return self.mark.learned_mm
        return self.mark.size_mm if isinstance(self.mark, shapes.LearnedMark) else 0.0


READS: Mapping[str, str] = {"rightward": "0", "upward": "90", "leftward": "180", "downward": "270"}  # by the pose
_WRITTEN = re.compile(
    rf"(?P<side>{'|'.join(get_args(shapes.Side))})(?::(?P<plate> plate)?(?: reads (?P<reads>{'|'.join(READS)}))?)?"
)


@dataclass(frozen=True, config=TABLE)
class Source:
    """[source] of a camera file: where its numbers come from, and how many reports or frames stand behind them."""

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


@dataclasses.dataclass(frozen=True)
class CameraFile:
    """A camera file as read: mm, a standard deviation of 0 fixes, inf frees.

    principal_distance_mm and principal_point_mm are None where the file leaves them to the points. number: of the
    camera or its lens cone, as its plate in the picture has it; "" where the file is of a type. writing: where the
    camera writes on its film, as far as the file says. calibration: an earlier one, which takes the place of the
    standard deviations of all that it gives. distances: observed between the fiducials. clicks: None where nobody has
    shown the learned marks; learned_from: None before they are learned.
    """

    path: Path
    name: str
    frame_mm: tuple[float, float] | None
    principal_distance_mm: float | None
    principal_point_mm: tuple[float, float] | None
    principal_distance_sigma_mm: float
    principal_point_sigma_mm: tuple[float, float]
    distortion: Distortion
    fiducials: tuple[GivenFiducial, ...]
    number: str = ""
    writing: tuple[shapes.WrittenPlace, ...] = ()
    calibration: EarlierCalibration | None = None
    source: Source | None = None
    clicks: Clicks | None = None
    learned_from: LearnedFrom | None = None
    distances: tuple[FiducialDistance, ...] = ()

    @property
    def learned(self) -> tuple[GivenFiducial, ...]:
        """The fiducials whose marks are yet to be learned from the scans."""
        return tuple(one for one in self.fiducials if isinstance(one.mark, shapes.LearnedMark))

    @property
    def is_asked(self) -> bool:
        """Whether a person may be asked where its marks are: they are to be learned, and its own file shows none."""
        return bool(self.learned) and (self.clicks is None or bool(self.clicks.who))

    @property
    def drawn(self) -> tuple[shapes.LayoutMark, ...]:
        """The fiducials that can be found in a scan."""
        return tuple(
            shapes.LayoutMark(one.id, one.seen_mm or one.xy_mm, one.sigma_mm, one.mark)
            for one in self.fiducials
            if isinstance(one.mark, shapes.Mark)
        )

    def layout(self) -> shapes.FiducialLayout:
        """The marks to be measured, those yet to be learned left out. Raises InputError where one has no drawing, and
        is not to be passed over, or the frame's size is missing."""
        if self.frame_mm is None:
            raise InputError(f"{self.path}: frame_mm is missing: the size of the exposed frame, [width, height] in mm.")
        for fiducial in self.fiducials:
            if fiducial.mark is None and not fiducial.passed_over:
                raise InputError(
                    f"{self.path}: fiducial {fiducial.id!r} has no mark, and so cannot be found in a scan. "
                    'Add mark = "NAME" to it and a table [mark.NAME] that draws it, or mark = "none" to pass it over; '
                    "a camera of the library is copied with `reseau cameras NAME` for that."
                )
        return shapes.FiducialLayout(self.drawn, self.frame_mm, self.writing)

    def camera(self, center_mm: tuple[float, float] = (0.0, 0.0)) -> Camera:
        """The camera for the adjustment. center_mm: where the principal point is sought when the file has none."""
        distance, point = self.principal_distance_mm, self.principal_point_mm
        sx, sy = self.principal_point_sigma_mm
        return Camera(
            name=self.name,
            principal_distance_mm=None if distance is None else Prior(distance, self.principal_distance_sigma_mm),
            x0_mm=None if point is None else Prior(point[0], sx),
            y0_mm=None if point is None else Prior(point[1], sy),
            distortion=self.distortion,
            fiducials={
                fiducial.id: Fiducial(
                    *(Prior(*pair) for pair in zip(fiducial.xy_mm, fiducial.prior_sigma_mm, strict=True))
                )
                for fiducial in self.fiducials
            },
            center_mm=center_mm,
            frame_mm=self.frame_mm or (0.0, 0.0),
            distances=tuple(
                one for one in self.distances if {one.start, one.end} <= {each.id for each in self.fiducials}
            ),
        )


def read_camera(path: Path) -> CameraFile:
    """Read camera.toml. Raises InputError naming file, line and key."""
    return parse_camera(read_toml(path))


def parse_camera(table: Table) -> CameraFile:
    """The camera that stands in a table: a whole camera file, or a part of another file in the same words."""
    if "data_strip" in table:
        raise table.error(
            "data_strip",
            'has become writing, which also says how it reads: writing = ["left: reads upward"], or "left".',
        )
    given = read_model(table, CameraTable)
    entries = table.tables("fiducial")
    fiducials = _fiducials(entries, given)
    default_sigma = DEFAULT_SIGMA_MM if fiducials else math.inf
    point, point_sigma = _default_principal_point(fiducials)
    if given.principal_point_mm is not None:
        point, point_sigma = given.principal_point_mm, default_sigma
    if given.frame_mm is not None:
        marks = [(entry, one.xy_mm, one.mark) for entry, one in zip(entries, fiducials, strict=True)]
        check_units(table, given.frame_mm, given.principal_distance_mm, marks)
    learned = [one.id for one in fiducials if isinstance(one.mark, shapes.LearnedMark)]
    distance_sigma = given.sigma.principal_distance_mm
    camera = CameraFile(
        path=table.file,
        name=table.file.stem if given.name is None else given.name,
        frame_mm=given.frame_mm,
        principal_distance_mm=given.principal_distance_mm,
        principal_point_mm=point,
        principal_distance_sigma_mm=default_sigma if distance_sigma is None else distance_sigma,
        principal_point_sigma_mm=given.sigma.principal_point_mm or (point_sigma, point_sigma),
        distortion=_distortion(table.table("distortion"), given),
        fiducials=fiducials,
        number=given.number,
        writing=given.writing,
        source=given.source,
        clicks=read_clicks(table.table("clicks"), learned) if given.clicks is not None else None,
        learned_from=given.learned_from,
        distances=read_fiducial_distances(table, [one.id for one in fiducials]),
    )
    return replace(camera, calibration=read_calibration(table.table("sigma"), camera.camera()))


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
    """Places as "left: reads upward", "right: plate reads downward", or "left" where the direction is not known."""
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
    """A place as a camera file has it."""
    direction = [word for word, pose in READS.items() if pose == place.pose]
    parts = [*(["plate"] if place.plate else []), *(f"reads {word}" for word in direction)]
    return f"{place.side}: {' '.join(parts)}" if parts else place.side


def _fiducial_id(table: Table) -> str:
    id = table.text("id")
    if not id or id != id.strip() or not id.isprintable():
        raise table.error("id", f"must be text on one line without blanks at its ends, not {id!r}.")
    return id


def _fiducials(entries: Sequence[Table], given: CameraTable) -> tuple[GivenFiducial, ...]:
    """The fiducials with their drawings. Raises InputError where two have one name or place, or none has a drawing."""
    fiducials: dict[str, GivenFiducial] = {}
    for entry, one in zip(entries, given.fiducial, strict=True):
        if one.id in fiducials:
            raise entry.error("id", f"fiducial {one.id!r} is given twice. Every mark has an id of its own.")
        if one.mark is not None:
            entry.text("mark", choices=(*given.mark, NO_MARK))
        if any(0.0 < sigma < SMALLEST_SIGMA for sigma in one.sigma_mm):
            raise entry.error(
                "sigma_mm", f"nothing is known to {min(one.sigma_mm):g} mm. Write 0 for what is to be fixed."
            )
        other = next((other for other in fiducials.values() if other.xy_mm == one.xy_mm), None)
        if other is not None:
            raise entry.error("xy_mm", f"fiducial {other.id!r} has the same place. Every mark has one of its own.")
        drawing = given.mark.get(one.mark or "")
        drawn = None if drawing is None else _placed(drawing.mark, drawing.is_radial, one.xy_mm)
        fiducials[one.id] = GivenFiducial(
            one.id, one.xy_mm, one.sigma_mm, drawn, one.mark == NO_MARK and drawn is None, one.seen_mm
        )
    return tuple(fiducials.values())


def read_fiducial_distances(table: Table, ids: Sequence[str]) -> tuple[FiducialDistance, ...]:
    """[[fiducial_distance]]: from and to, of the ids of the fiducials, mm and sigma_mm."""
    distances = []
    for entry in table.tables("fiducial_distance") if "fiducial_distance" in table else ():
        start, end = (entry.text(key) for key in ("from", "to"))
        for key, id_ in (("from", start), ("to", end)):
            if id_ not in ids:
                raise entry.error(key, f"there is no fiducial {id_!r}.{did_you_mean(id_, ids)}")
        if start == end:
            raise entry.error("to", "is the same as from: a distance has two ends.")
        length, sigma = (entry.number(key, above=0.0) for key in ("mm", "sigma_mm"))
        distances.append(FiducialDistance(start, end, length, sigma))
        entry.done()
    return tuple(distances)


def _placed(
    mark: shapes.Mark | shapes.LearnedMark, radial: bool, xy_mm: shapes.Point
) -> shapes.Mark | shapes.LearnedMark:
    """A radial mark is drawn as on the positive x' axis; elsewhere its own x axis points away from the centre. What is
    learned is learned at each place by itself; a frame's corner lies as its quadrant says."""
    if isinstance(mark, shapes.LearnedMark):
        return mark
    if isinstance(mark, shapes.FrameCorner):
        reach = mark.reach_mm or max(min(abs(xy_mm[0]), abs(xy_mm[1])) * CORNER_REACH, 2 * mark.radius_mm)
        return shapes.frame_corner(xy_mm, reach, mark.radius_mm, mark.polarity)
    return shapes.turned(mark, math.degrees(math.atan2(xy_mm[1], xy_mm[0]))) if radial else mark


def _default_principal_point(fiducials: Sequence[GivenFiducial]) -> tuple[tuple[float, float] | None, float]:
    """Where a file that gives none has it, and its standard deviation: the origin, where the fiducials lie about it;
    else, where they count from a corner of the frame, near their middle, and nothing is known of it."""
    if not fiducials:
        return None, math.inf
    xy = np.array([fiducial.xy_mm for fiducial in fiducials])
    middle, extent = (xy.min(axis=0) + xy.max(axis=0)) / 2, np.ptp(xy, axis=0).max()
    if len(fiducials) < _FEWEST_ABOUT_ORIGIN or np.abs(middle).max() < _OFF_MIDDLE * extent:
        return (0.0, 0.0), DEFAULT_SIGMA_MM
    return (float(middle[0]), float(middle[1])), math.inf


def _distortion(table: Table, camera: CameraTable) -> Distortion:
    given = camera.distortion
    name, needs_half = given.family, family(given.family).needs == "half_mm"
    in_dm = name == "juhl"  # Juhl counts in decimetres
    for key, is_wrong in (("r0_mm", in_dm), ("r0_dm", not in_dm), ("half_mm", not needs_half)):
        if is_wrong and key in table:
            raise table.error(key, f"is no key of this table where the family is {name}. Take it out.")
    r0_mm = 100.0 * table.number("r0_dm", above=0.0) if in_dm else given.r0_mm
    half_mm = _half(table, given, camera.frame_mm) if needs_half else (0.0, 0.0)
    values, sigmas = table.table("value"), table.table("sigma")
    every = sigmas.sigma("all", 0.0)  # a set of 44 parameters is not named one by one
    known = parameter_names(name)
    parameters = {each: Prior(values.number(each, 0.0), sigmas.sigma(each, every)) for each in known}
    values.done()
    sigmas.done()
    named = {each: prior for each, prior in parameters.items() if each in values or each in sigmas or every > 0.0}
    return Distortion(name, named, given.decentering, r0_mm, half_mm)


def _family(table: Table) -> str:
    name = table.text("family")
    try:
        family(name)
    except ValueError as error:
        raise table.error("family", f"{error}.{did_you_mean(name, FAMILY_NAMES)}") from None
    return name


def _half(table: Table, given: DistortionTable, frame_mm: shapes.Point | None) -> shapes.Point:
    """Half the frame, the unit of length of a self-calibration set."""
    if given.half_mm is not None:
        if min(given.half_mm) <= 0.0:
            raise table.error("half_mm", f"must be positive, not {list(given.half_mm)}.")
        return given.half_mm
    if frame_mm is None:
        raise table.error(
            "family",
            f"{given.family} counts in halves of the frame, and its size is not known. Give the camera's frame_mm, or "
            "half_mm in this table.",
        )
    return (frame_mm[0] / 2.0, frame_mm[1] / 2.0)
