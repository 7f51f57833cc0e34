"""camera.toml: the given camera, for the measurement (its marks) and for the adjustment (its priors)."""

import dataclasses
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from adjust.functional_model.families import family, parameter_names
from adjust.functional_model.lens import Distortion, Prior
from adjust.problem.camera import Camera, Fiducial, FiducialDistance
from measure.marks import shapes
from measure.marks.rendering import extent_px
from pipeline.errors import InputError
from pipeline.files import camera_tables
from pipeline.files.mark_table import Clicks, Drawing, LearnedFrom, SavePicture, read_marks, template_values
from pipeline.text.files import SMALLEST_SIGMA, FilePath, image_name
from pipeline.text.table_models import read_model
from pipeline.text.toml_tables import Table, list_words, read_toml
from pipeline.text.wording import did_you_mean, table_lines

if TYPE_CHECKING:
    from pipeline.files.earlier_calibration import EarlierCalibration

FIELD_RATIO = 50.0  # largest half diagonal over principal distance, or frame over fiducials' extent: 178° field of view
LONGEST_RATIO = 500.0  # largest principal distance over half the diagonal: small plates of astrographs with c = 10 m

NO_MARK = "none"  # for a fiducial that is not sought in scans
CORNER_REACH = 1 / 6  # default length of the measured edges of a frame corner, fraction of half the frame
_FEWEST_ABOUT_ORIGIN = 3  # fiducials needed to determine their middle
_OFF_MIDDLE = 0.25  # fraction of the fiducials' extent: an origin farther from their middle is not the frame's centre


@dataclasses.dataclass(frozen=True)
class GivenFiducial:
    """Fiducial of a camera file.

    Attributes
    ----------
    xy_mm, sigma_mm : given coordinates and their standard deviations, mm.
    mark : drawing; None if the fiducial can be adjusted but not measured.
    passed_over : whether it is not to be measured.
    template_origin_mm : origin of a learned mark's template in the scan from which it was first cut, mm.
    """

    id: str
    xy_mm: shapes.Point
    sigma_mm: shapes.Point
    mark: shapes.Mark | shapes.LearnedMark | None
    passed_over: bool = False
    template_origin_mm: shapes.Point | None = None

    @property
    def prior_sigma_mm(self) -> tuple[float, float]:
        """Standard deviations for the adjustment, mm.

        A learned mark is measured at the origin of its template, which may lie anywhere on the mark: its uncertainty is
        added. Fixed coordinates stay fixed.
        """
        sx, sy = (sigma and math.hypot(sigma, shapes.LEARNED_ORIGIN * self.learned_mm) for sigma in self.sigma_mm)
        return sx, sy

    @property
    def learned_mm(self) -> float:
        """Size of a mark that is learned or to be learned, mm; 0 for others."""
        if isinstance(self.mark, shapes.MarkTemplate):
            return self.mark.learned_mm
        return self.mark.size_mm if isinstance(self.mark, shapes.LearnedMark) else 0.0


@dataclasses.dataclass(frozen=True)
class CameraFile:
    """Content of a camera file. Lengths in mm; a standard deviation of 0 fixes a value, inf frees it.

    Attributes
    ----------
    principal_distance_mm, principal_point_mm : None where they are to be determined from the points.
    number : serial number of the camera or its lens cone on the plate; "" for a type of camera.
    writing : where the camera writes on its film, as far as the file states it.
    calibration : an earlier calibration, which replaces the standard deviations of its quantities.
    distances : measured distances between fiducials.
    clicks : places of the marks to be learned; None if nobody has clicked them.
    learned_from : origin of learned marks; None before they are learned.
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
    calibration: "EarlierCalibration | None" = None
    source: camera_tables.Source | None = None
    clicks: Clicks | None = None
    learned_from: LearnedFrom | None = None
    distances: tuple[FiducialDistance, ...] = ()

    @property
    def learned(self) -> tuple[GivenFiducial, ...]:
        """Fiducials whose marks have yet to be learned from the scans."""
        return tuple(one for one in self.fiducials if isinstance(one.mark, shapes.LearnedMark))

    @property
    def needs_clicks(self) -> bool:
        """Whether a person may be asked to click the marks: they are to be learned, and the camera file itself has no
        clicks."""
        return bool(self.learned) and (self.clicks is None or bool(self.clicks.who))

    @property
    def layout_marks(self) -> tuple[shapes.LayoutMark, ...]:
        """Fiducials that can be found in a scan."""
        return tuple(
            shapes.LayoutMark(one.id, one.template_origin_mm or one.xy_mm, one.sigma_mm, one.mark)
            for one in self.fiducials
            if isinstance(one.mark, shapes.Mark)
        )

    def layout(self) -> shapes.FiducialLayout:
        """Layout of the marks to be measured, without those yet to be learned.

        Raises InputError where a mark has no drawing and is not passed over, or the frame's size is missing.
        """
        if self.frame_mm is None:
            raise InputError(f"{self.path}: frame_mm is missing: the size of the exposed frame, [width, height] in mm.")
        for fiducial in self.fiducials:
            if fiducial.mark is None and not fiducial.passed_over:
                raise InputError(
                    f"{self.path}: fiducial {fiducial.id!r} has no mark, and so cannot be found in a scan. "
                    'Add mark = "NAME" to it and a table [mark.NAME] that draws it, or mark = "none" to pass it over; '
                    "a camera of the library is copied with `reseau cameras NAME` for that."
                )
        return shapes.FiducialLayout(self.layout_marks, self.frame_mm, self.writing)

    def camera(self, center_mm: tuple[float, float] = (0.0, 0.0)) -> Camera:
        """Camera for the adjustment. center_mm: initial value of a principal point that the file does not give."""
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


def read_camera(path: FilePath) -> CameraFile:
    """Read camera.toml. Raises InputError with file, line and key."""
    return parse_camera(read_toml(path, "camera.toml"))


def parse_camera(table: Table) -> CameraFile:
    """Read a camera from a table: a whole camera file, or a part of another file with the same keys."""
    if "data_strip" in table:
        raise table.error(
            "data_strip",
            'has become writing, which also says how it reads: writing = ["left: reads upward"], or "left".',
        )
    given = read_model(table, camera_tables.CameraTable)
    entries = table.tables("fiducial")
    fiducials = _fiducials(entries, given, read_marks(table.table("mark")))
    default_sigma = camera_tables.DEFAULT_SIGMA_MM if fiducials else math.inf
    point, point_sigma = _default_principal_point(fiducials)
    if given.principal_point_mm is not None:
        point, point_sigma = given.principal_point_mm, default_sigma
    _check_units(table, given, entries, fiducials)
    learned = [one.id for one in fiducials if isinstance(one.mark, shapes.LearnedMark)]
    distance_sigma = given.sigma.principal_distance_mm
    distances = table.tables("fiducial_distance")
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
        clicks=_clicks(table.table("clicks"), given.clicks, learned) if given.clicks is not None else None,
        learned_from=given.learned_from,
        distances=fiducial_distances(distances, given.fiducial_distance, [one.id for one in fiducials]),
    )
    if given.sigma.calibration is None:
        return camera
    from pipeline.files.earlier_calibration import read_calibration  # a quarter of the start of `cameras --scan`

    earlier = table.file.parent / given.sigma.calibration
    calibration = read_calibration(earlier, table.table("sigma"), given.sigma.calibration_fiducials, camera.camera())
    return replace(camera, calibration=calibration)


def _check_units(
    table: Table, given: camera_tables.CameraTable, entries: Sequence[Table], fiducials: Sequence[GivenFiducial]
) -> None:
    """Raise InputError for lengths that are impossible for the size of the frame. entries: tables of the fiducials."""
    if given.frame_mm is None:
        return
    frame = f"the frame of {given.frame_mm[0]:g} x {given.frame_mm[1]:g} mm"
    distance_mm, half_diagonal = given.principal_distance_mm, math.hypot(*given.frame_mm) / 2
    if distance_mm is not None and not 1 / FIELD_RATIO < distance_mm / half_diagonal < LONGEST_RATIO:
        raise table.error("principal_distance_mm", f"{distance_mm:g} mm is impossible for {frame}. Give both in mm.")
    places = [one.xy_mm for one in fiducials]
    apart_mm = float(np.ptp(places, axis=0).max()) if len(places) > 1 else math.inf
    for entry, one in zip(entries, fiducials, strict=True):
        size_mm = one.mark.size_mm if isinstance(one.mark, shapes.LearnedMark) else 0.0
        if isinstance(one.mark, shapes.Mark) and not isinstance(one.mark, shapes.FrameCorner):
            size_mm = float(np.ptp(extent_px(one.mark, np.eye(2, 3)), axis=0).max())
        if max(map(abs, one.xy_mm)) > 2 * max(given.frame_mm):
            raise entry.error("xy_mm", f"lies far outside of {frame}. Give mm from its middle.")
        if apart_mm < max(given.frame_mm) / FIELD_RATIO:
            raise entry.error("xy_mm", f"all fiducials lie within {apart_mm:.3g} mm, in {frame}. Give mm.")
        if size_mm > min(given.frame_mm) / 2:
            raise entry.error("mark", f"is drawn {size_mm:.4g} mm large, in {frame}. Give its sizes in mm.")


def _fiducials(
    entries: Sequence[Table], given: camera_tables.CameraTable, drawings: Mapping[str, Drawing]
) -> tuple[GivenFiducial, ...]:
    """Fiducials with their drawings. Raises InputError where two share a name or place, or a drawing is missing."""
    fiducials: dict[str, GivenFiducial] = {}
    words = (*drawings, NO_MARK)
    for entry, one in zip(entries, given.fiducial, strict=True):
        if one.id in fiducials:
            raise entry.error("id", f"fiducial {one.id!r} is given twice. Every mark has an id of its own.")
        if one.mark is not None and one.mark not in words:
            possible = f"possible are {list_words(words)}.{did_you_mean(one.mark, words)}"
            raise entry.error("mark", f"is {one.mark!r}; {possible}")
        if any(0.0 < sigma < SMALLEST_SIGMA for sigma in one.sigma_mm):
            raise entry.error(
                "sigma_mm", f"nothing is known to {min(one.sigma_mm):g} mm. Write 0 for what is to be fixed."
            )
        other = next((other for other in fiducials.values() if other.xy_mm == one.xy_mm), None)
        if other is not None:
            raise entry.error("xy_mm", f"fiducial {other.id!r} has the same place. Every mark has one of its own.")
        drawing = drawings.get(one.mark or "")
        drawn = None if drawing is None else _place_mark(*drawing, one.xy_mm)
        fiducials[one.id] = GivenFiducial(
            one.id, one.xy_mm, one.sigma_mm, drawn, one.mark == NO_MARK and drawn is None, one.template_origin_mm
        )
    return tuple(fiducials.values())


def _clicks(table: Table, given: camera_tables.ClicksTable, learned: Sequence[str]) -> Clicks:
    """Clicks on learned marks. Raises InputError where some of them are not clicked, or others are."""
    if unknown := table.table("px").unknown_keys(learned):
        raise InputError("\n".join(unknown))
    missing = [id for id in learned if id not in given.px]
    if missing or not given.px:
        raise table.error(
            "px", f"says nothing of {', '.join(missing) or 'any mark'}. Click all learned marks, or none."
        )
    return Clicks(image_name(given.scan), given.px)


def fiducial_distances(
    entries: Sequence[Table], given: Sequence[camera_tables.FiducialDistanceTable], ids: Sequence[str]
) -> tuple[FiducialDistance, ...]:
    """Distances between fiducials of these ids. Raises InputError, with the key, for other ids."""
    for entry, one in zip(entries, given, strict=True):
        for key, id_ in (("from", one.start), ("to", one.end)):
            if id_ not in ids:
                raise entry.error(key, f"there is no fiducial {id_!r}.{did_you_mean(id_, ids)}")
        if one.start == one.end:
            raise entry.error("to", "is the same as from: a distance has two ends.")
    return tuple(FiducialDistance(one.start, one.end, one.mm, one.sigma_mm) for one in given)


def _place_mark(
    mark: shapes.Mark | shapes.LearnedMark, radial: bool, xy_mm: shapes.Point
) -> shapes.Mark | shapes.LearnedMark:
    """Mark at its place in the frame.

    A radial mark is drawn as on the positive x' axis and rotated so that its x axis points away from the centre. A
    frame corner is oriented by its quadrant. A mark to be learned is learned at each place separately.
    """
    if isinstance(mark, shapes.LearnedMark):
        return mark
    if isinstance(mark, shapes.FrameCorner):
        reach = mark.reach_mm or max(min(abs(xy_mm[0]), abs(xy_mm[1])) * CORNER_REACH, 2 * mark.radius_mm)
        return shapes.frame_corner(xy_mm, reach, mark.radius_mm, mark.polarity)
    return shapes.rotate_mark(mark, math.degrees(math.atan2(xy_mm[1], xy_mm[0]))) if radial else mark


def _default_principal_point(fiducials: Sequence[GivenFiducial]) -> tuple[tuple[float, float] | None, float]:
    """Default principal point and its standard deviation: the origin where the fiducials surround it; else (coordinates
    counted from a corner of the frame) the middle of the fiducials, with infinite standard deviation."""
    if not fiducials:
        return None, math.inf
    xy = np.array([fiducial.xy_mm for fiducial in fiducials])
    middle, extent = (xy.min(axis=0) + xy.max(axis=0)) / 2, np.ptp(xy, axis=0).max()
    if len(fiducials) < _FEWEST_ABOUT_ORIGIN or np.abs(middle).max() < _OFF_MIDDLE * extent:
        return (0.0, 0.0), camera_tables.DEFAULT_SIGMA_MM
    return (float(middle[0]), float(middle[1])), math.inf


def _distortion(table: Table, camera: camera_tables.CameraTable) -> Distortion:
    given = camera.distortion
    known = parameter_names(given.family)
    half_mm = given.half_mm or (0.0, 0.0)
    if family(given.family).needs == "half_mm" and given.half_mm is None:
        if camera.frame_mm is None:
            raise table.error(
                "family",
                f"{given.family} counts in halves of the frame, and its size is not known. Give the camera's "
                "frame_mm, or half_mm in this table.",
            )
        half_mm = (camera.frame_mm[0] / 2.0, camera.frame_mm[1] / 2.0)
    for key, others in (("value", ()), ("sigma", ("all",))):
        if unknown := table.table(key).unknown_keys((*known, *others)):
            raise InputError("\n".join(unknown))
    every = given.sigma.get("all", 0.0)  # default for all: a set of 44 parameters is not listed one by one
    named = [each for each in known if each in given.value or each in given.sigma or every > 0.0]
    parameters = {each: Prior(given.value.get(each, 0.0), given.sigma.get(each, every)) for each in named}
    r0_mm = given.r0_mm if given.r0_dm is None else 100.0 * given.r0_dm
    return Distortion(given.family, parameters, given.decentering, r0_mm, half_mm)


def camera_text(camera: CameraFile, save: SavePicture) -> str:
    """Text of a camera file to be written at camera.path, which `read_camera` can read.

    save(name, picture) stores an image beside it and returns its relative path.
    """
    drawings = dict.fromkeys(one.mark for one in camera.fiducials if one.mark is not None)
    names = {mark: f"mark-{number}" for number, mark in enumerate(drawings, 1)}
    distortion, calibration, parameters = camera.distortion, camera.calibration, camera.distortion.parameters
    in_dm, needs_half = distortion.family == "juhl", family(distortion.family).needs == "half_mm"
    source = {} if camera.source is None else dataclasses.asdict(camera.source)
    content: dict[str, Any] = {
        "name": camera.name,
        "frame_mm": camera.frame_mm,
        "number": camera.number or None,
        "writing": [camera_tables.written_place_text(place) for place in camera.writing] or None,
        "principal_distance_mm": camera.principal_distance_mm,
        "principal_point_mm": camera.principal_point_mm,
        "sigma": {
            "principal_distance_mm": camera.principal_distance_sigma_mm,
            "principal_point_mm": camera.principal_point_sigma_mm,
            "calibration": calibration and os.path.relpath(calibration.path, camera.path.parent),
            "calibration_fiducials": calibration
            and any(each.kind == "fiducial" for each in (*calibration.parameters, *calibration.held)),
        },
        "source": {key: value for key, value in source.items() if value} or None,
        "distortion": {
            "family": distortion.family,
            "decentering": distortion.decentering,
            "r0_dm" if in_dm else "r0_mm": distortion.r0_mm / 100.0 if in_dm else distortion.r0_mm,
            "half_mm": distortion.half_mm if needs_half else None,
            "value": {name: prior.value for name, prior in parameters.items()},
            "sigma": {name: prior.sigma for name, prior in parameters.items()},
        },
        "fiducial": [
            {
                "id": one.id,
                "xy_mm": one.xy_mm,
                "sigma_mm": one.sigma_mm,
                "seen_mm": one.template_origin_mm,
                "mark": names[one.mark] if one.mark is not None else NO_MARK if one.passed_over else None,
            }
            for one in camera.fiducials
        ],
        "fiducial_distance": [
            {"from": one.start, "to": one.end, "mm": one.value_mm, "sigma_mm": one.sigma_mm} for one in camera.distances
        ],
        "learned_from": camera.learned_from and dataclasses.asdict(camera.learned_from),
        "mark": {name: _mark_values(mark, name, save) for mark, name in names.items()} or None,
    }
    return "\n".join(table_lines({key: value for key, value in content.items() if value != []})) + "\n"


def _mark_values(mark: shapes.Mark | shapes.LearnedMark, name: str, save: SavePicture) -> dict[str, Any]:
    match mark:
        case shapes.LearnedMark():
            return {"kind": "learned", "size_mm": mark.size_mm}
        case shapes.MarkTemplate():
            return template_values(mark, name, save)
        case shapes.FrameCorner():
            sizes = {"reach_mm": mark.reach_mm, "radius_mm": mark.radius_mm}
            return {"kind": "frame-corner", **sizes, "polarity": mark.polarity}
    parts = [{"shape": type(part).__name__.lower(), **vars(part)} for part in mark.parts]
    return {"kind": "parts", "polarity": mark.polarity, "true_mm": mark.true_mm, "part": parts}
