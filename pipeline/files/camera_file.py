"""camera.toml: the camera as it is given, for the measurement (its marks) and for the adjustment (its priors)."""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast, get_args

import numpy as np

from adjust.functional_model.families import FAMILY_NAMES, family, parameter_names
from adjust.functional_model.lens import Decentering, Distortion, Prior
from adjust.problem.camera import Camera, Fiducial
from measure.marks import shapes
from measure.marks.rendering import extent_px
from pipeline.errors import InputError
from pipeline.files.earlier_calibration import EarlierCalibration, read_calibration
from pipeline.files.mark_table import Clicks, LearnedFrom, read_clicks, read_learned_from, read_mark
from pipeline.text.tables import Table, read_toml
from pipeline.text.text_file import SMALLEST_SIGMA
from pipeline.text.wording import did_you_mean

FIELD_RATIO = 50.0  # of principal distance and half the diagonal, either way: 2.3 degrees of field to 178

Drawing = shapes.Mark | shapes.LearnedMark | None
NO_MARK = "none"  # a fiducial that is not to be looked for in scans
CORNER_REACH = 1 / 6  # of half the frame: how far along its edges a corner is measured where nobody says
DEFAULT_SIGMA_MM = 1.0  # Torlegård's a-priori standard deviation where only a datum is wanted
_FEWEST_ABOUT_ORIGIN = 3  # fiducials that show where their middle is...
_OFF_MIDDLE = 0.25  # ...and how far the origin lies from it, in their extent, where it is none of their middle


def check_units(
    table: Table,
    frame_mm: tuple[float, float],
    distance_mm: float | None,
    fiducials: Sequence[tuple[Table, shapes.Point, Drawing]],
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


def _size_mm(mark: Drawing) -> float:
    """Width or height, whichever is larger; 0 where nothing is drawn, or the frame's edges themselves are."""
    if mark is None or isinstance(mark, shapes.FrameCorner):
        return 0.0
    if isinstance(mark, shapes.LearnedMark):
        return mark.size_mm
    return float(np.ptp(extent_px(mark, np.eye(2, 3)), axis=0).max())


@dataclass(frozen=True)
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


@dataclass(frozen=True)
class Source:
    """Where the numbers of a camera file come from, and from how many calibration reports."""

    text: str
    reports: int


@dataclass(frozen=True)
class CameraFile:
    """A camera file as read: mm, a standard deviation of 0 fixes, inf frees.

    principal_distance_mm and principal_point_mm are None where the file leaves them to the points. number: of the
    camera or its lens cone, as its plate in the picture has it; "" where the file is of a type. writing: where the
    camera writes on its film, as far as the file says. calibration: an earlier one, which takes the place of the
    standard deviations of all that it gives. clicks: None where nobody has shown the learned marks; learned_from: None
    before they are learned.
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
        )


def read_camera(path: Path) -> CameraFile:
    """Read camera.toml. Raises InputError naming file, line and key."""
    table = read_toml(path)
    camera = parse_camera(table)
    table.done()
    return camera


def parse_camera(table: Table) -> CameraFile:
    """The camera that stands in a table: a whole camera file, or a part of another file in the same words."""
    fiducials = _fiducials(table)
    default_sigma = DEFAULT_SIGMA_MM if fiducials else math.inf
    default_point, point_sigma = _default_principal_point(fiducials)
    sigma = table.table("sigma")
    distance = table.number("principal_distance_mm", above=0.0) if "principal_distance_mm" in table else None
    point = default_point
    if "principal_point_mm" in table:
        point, point_sigma = table.pair("principal_point_mm"), default_sigma
    frame = table.pair("frame_mm") if "frame_mm" in table else None
    if frame is not None and min(frame) <= 0.0:
        raise table.error("frame_mm", f"must be two positive lengths, [width, height], not {list(frame)}.")
    if frame is not None:
        entries = zip(table.tables("fiducial"), fiducials, strict=True)
        check_units(table, frame, distance, [(entry, one.xy_mm, one.mark) for entry, one in entries])
    learned = [one.id for one in fiducials if isinstance(one.mark, shapes.LearnedMark)]
    camera = CameraFile(
        path=table.file,
        name=table.text("name", table.file.stem),
        frame_mm=frame,
        principal_distance_mm=distance,
        principal_point_mm=point,
        principal_distance_sigma_mm=sigma.sigma("principal_distance_mm", default_sigma),
        principal_point_sigma_mm=sigma.sigma_pair("principal_point_mm", (point_sigma, point_sigma)),
        distortion=_distortion(table.table("distortion"), frame),
        fiducials=fiducials,
        number=_number(table),
        writing=_writing(table),
        source=_source(table.table("source")) if "source" in table else None,
        clicks=read_clicks(table.table("clicks"), learned) if "clicks" in table else None,
        learned_from=read_learned_from(table.table("learned_from")) if "learned_from" in table else None,
    )
    camera = replace(camera, calibration=read_calibration(sigma, camera.camera()))
    sigma.done()
    return camera


def _number(table: Table) -> str:
    number = table.text("number", "")
    if number and not number.isdigit():
        raise table.error("number", f'must be digits in quotes, as the plate has them: "13182", not {number!r}.')
    return number


def _writing(table: Table) -> tuple[shapes.WrittenPlace, ...]:
    """Places as "left: reads upward", "right: plate reads downward", or "left" where the direction is not known."""
    if "data_strip" in table:
        raise table.error(
            "data_strip",
            'has become writing, which also says how it reads: writing = ["left: reads upward"], or "left".',
        )
    places = []
    for text in table.texts("writing") if "writing" in table else ():
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


def _source(table: Table) -> Source:
    source = Source(table.text("text"), int(table.number("reports", 0.0, least=0.0)))
    table.done()
    return source


def _fiducials(table: Table) -> tuple[GivenFiducial, ...]:
    marks = _marks(table.table("mark"))
    fiducials: dict[str, GivenFiducial] = {}
    for entry in table.tables("fiducial"):
        id = entry.text("id")
        if not id or id != id.strip() or not id.isprintable():
            raise entry.error("id", f"must be text on one line without blanks at its ends, not {id!r}.")
        if id in fiducials:
            raise entry.error("id", f"fiducial {id!r} is given twice. Every mark has an id of its own.")
        mark = entry.text("mark", choices=(*marks, NO_MARK)) if "mark" in entry else None
        xy = entry.pair("xy_mm")
        sigma = entry.sigma_pair("sigma_mm", (DEFAULT_SIGMA_MM, DEFAULT_SIGMA_MM))
        if any(0.0 < one < SMALLEST_SIGMA for one in sigma):
            raise entry.error("sigma_mm", f"nothing is known to {min(sigma):g} mm. Write 0 for what is to be fixed.")
        drawn = None if mark is None or mark not in marks else _placed(*marks[mark], xy)
        for other in fiducials.values():
            if other.xy_mm == xy:
                raise entry.error("xy_mm", f"fiducial {other.id!r} has the same place. Every mark has one of its own.")
        origin_mm = entry.pair("seen_mm") if "seen_mm" in entry else None
        fiducials[id] = GivenFiducial(id, xy, sigma, drawn, mark == NO_MARK and drawn is None, origin_mm)
        entry.done()
    return tuple(fiducials.values())


def _marks(table: Table) -> Mapping[str, tuple[shapes.Mark | shapes.LearnedMark, bool]]:
    """Every drawn mark by name, and whether it is turned with its place."""
    marks = {}
    for name in table.names():
        entry = table.table(name)
        mark = read_mark(entry)
        radial = entry.text("rotate", "none", ("none", "radial")) == "radial"
        entry.done()
        marks[name] = (mark, radial)
    return marks


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


def _distortion(table: Table, frame_mm: tuple[float, float] | None) -> Distortion:
    name = _family(table)
    decentering = cast(Decentering, table.text("decentering", "reduced", ("reduced", "paper")))
    # Juhl counts in decimetres.
    in_dm = name == "juhl"
    r0_mm = 100.0 * table.number("r0_dm", above=0.0) if in_dm else table.number("r0_mm", 0.0, least=0.0)
    half_mm = _half(table, name, frame_mm) if family(name).needs == "half_mm" else (0.0, 0.0)
    values, sigmas = table.table("value"), table.table("sigma")
    table.done()
    known = parameter_names(name)
    of_all = sigmas.sigma("all", 0.0)  # a set of 44 parameters is not named one by one
    parameters = {each: Prior(values.number(each, 0.0), sigmas.sigma(each, of_all)) for each in known}
    values.done()
    sigmas.done()
    named = {each: prior for each, prior in parameters.items() if each in values or each in sigmas or of_all > 0.0}
    return Distortion(name, named, decentering, r0_mm, half_mm)


def _family(table: Table) -> str:
    name = table.text("family", "none")
    try:
        family(name)
    except ValueError as error:
        raise table.error("family", f"{error}.{did_you_mean(name, FAMILY_NAMES)}") from None
    return name


def _half(table: Table, name: str, frame_mm: tuple[float, float] | None) -> tuple[float, float]:
    """Half the frame, the unit of length of a self-calibration set."""
    if "half_mm" in table:
        half = table.number_or_pair("half_mm")
        if min(half) <= 0.0:
            raise table.error("half_mm", f"must be positive, not {list(half)}.")
        return half
    if frame_mm is None:
        raise table.error(
            "family",
            f"{name} counts in halves of the frame, and its size is not known. Give the camera's frame_mm, or half_mm "
            "in this table.",
        )
    return (frame_mm[0] / 2.0, frame_mm[1] / 2.0)
