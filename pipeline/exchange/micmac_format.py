"""MicMac: marks of unresampled scans for its ReSampFid, and camera and poses for the frames that this makes."""

from collections.abc import Iterator, Mapping, Sequence
from itertools import chain
from math import ceil, floor
from pathlib import Path
from typing import Literal

import numpy as np

from pipeline.errors import InputError
from pipeline.exchange.block import Block, OutFrame
from pipeline.exchange.convention import Convention, ExportOptions, Written
from pipeline.exchange.fitted_lens import BROWN, FittedLens, frame_corners_mm, sheared_lens
from pipeline.exchange.incoming import ForeignMark, ImportOptions, Incoming, fiducial_camera
from pipeline.exchange.pinhole import Y_DOWN_Z_FORWARD, check_misfit, sight_misfit_mm
from pipeline.exchange.xml_tree import Element, numbers_of, plain_number, read_xml, text_of, xml_lines, xml_text
from pipeline.resampling.canvas import Canvas
from pipeline.results.comparator_file import ComparatorPoint
from pipeline.text.names import file_word, image_name
from pipeline.types import Array

CONVENTION = Convention(
    (0.0, 0.0),
    "column right, row down; camera mm with x right and y DOWN; camera x right, y down, z forward; X = R P + C",
    "micmac, include/general: TIm2D::getr; DefautChantierDescripteur.xml, Key-Assoc-STD-Orientation-Interne (names of "
    "the files); ParamChantierPhotogram.xml (their elements); phgr_dist.cpp, cDistModStdPhpgr::Direct (distortion of "
    "the ideal point in px); cAppliOneReechMarqFid (pixel = (mm - box) / resolution)",
)
_Y_DOWN = np.array([1.0, -1.0])
_KNOWN = "eConvApero_DistM2C"
_REECH = "OIS-Reech_"  # before the name of what ReSampFid writes
_DIGITS = 12
_FEWEST = 3  # marks that an affine transformation needs


def write(block: Block, options: ExportOptions) -> Written:
    """Ori-InterneScan with the fiducials; where there is an adjustment, Ori-Reseau with camera and poses, too. Several
    cameras have a folder each, for MicMac knows one MeasuresCamera.xml a folder."""
    cameras = dict.fromkeys(frame.camera for frame in block.frames)
    files: dict[str, str | bytes] = {}
    notes: list[str] = []
    left_out: list[str] = []
    for camera in cameras:
        frames = [frame for frame in block.frames if frame.camera == camera]
        folder = f"{file_word(camera)}/" if len(cameras) > 1 else ""
        part = _camera_files(block, camera, frames, options)
        files |= {f"{folder}{place}": content for place, content in part.files.items()}
        notes += part.notes
        left_out += part.left_out
    lost = (
        "what x and y of a mark differ in precision (PrecPointe is one number, and ReSampFid does not look at it)",
        "the covariances of an adjustment",
    )
    return Written(files, lost, tuple(notes), tuple(left_out))


def _camera_files(block: Block, camera: str, frames: Sequence[OutFrame], options: ExportOptions) -> Written:
    fiducials = _fiducials(block, camera)
    files: dict[str, str | bytes] = {}
    left_out = []
    if fiducials:
        files["Ori-InterneScan/MeasuresCamera.xml"] = xml_text(_marks("Glob", fiducials))
    usable = []
    for frame in frames if fiducials else ():
        marks = frame.observed(fiducials=True)
        if len(marks) < _FEWEST:
            left_out.append(f"{frame.image}: {len(marks)} fiducials are observed, and MicMac's affine fit needs three.")
            continue
        usable.append(frame)
        places = frame.pixels(marks) + CONVENTION.first_pixel_px
        named = {mark.point: place for mark, place in zip(marks, places, strict=True)}
        lines = _marks(frame.file_name, named, _sigmas_px(marks, sum(frame.known_pitch_um) / 2000.0))
        files[f"Ori-InterneScan/MeasuresIm-{frame.file_name}.xml"] = xml_text(lines)
    oriented = [frame for frame in (usable if fiducials else frames) if frame.is_oriented]
    if not oriented:
        has_frame = bool(usable) and block.camera_file(camera).frame_mm is not None
        command = (_resampling(camera, box_of(block, usable[0], options)),) if has_frame else ()
        return Written(files, notes=(*command, *_no_orientation(camera)), left_out=tuple(left_out))
    lens = sheared_lens(block, oriented[0], at_ideal=True)
    box = box_of(block, oriented[0], options) if fiducials else picture_box(block, oriented[0])
    reech = _REECH if fiducials else ""
    misfit = {each.image: (lens.largest_mm + sight_misfit_mm(block, each)) / box.pitch_mm for each in oriented}
    check_misfit(misfit, options, "micmac")
    calibration = f"Ori-Reseau/AutoCal_{file_word(camera)}.xml"
    files[calibration] = _calibration(lens, box)
    for frame in oriented:
        files[f"Ori-Reseau/Orientation-{reech}{frame.file_name}.xml"] = _orientation(frame, calibration)
    files["Measures-S2D.xml"] = _measures(block, oriented, box, reech)
    files["Measures-S3D.xml"] = _ground(block)
    notes = _notes(camera, oriented, fiducials, box, max(misfit.values()))
    return Written(files, notes=notes, left_out=tuple(left_out))


def box_of(block: Block, frame: OutFrame, options: ExportOptions) -> Canvas:
    """The frame that ReSampFid is to make: the exposed frame, at whole multiples of the pitch, never the marks' box."""
    pitch = options.pitch_um or float(np.sqrt(np.prod(frame.known_pitch_um)))
    corners = frame_corners_mm(block, frame) / (pitch / 1000.0)
    left, top = floor(corners[0, 0]), ceil(corners[1, 1])
    width, height = ceil(corners[1, 0]) - left, top - floor(corners[0, 1])
    return Canvas(left * pitch / 1000.0, top * pitch / 1000.0, pitch / 1000.0, width, height)


def picture_box(block: Block, frame: OutFrame) -> Canvas:
    """A digital camera's picture, which is not resampled. Raises InputError where its pixels are no squares."""
    x_um, y_um = frame.known_pitch_um
    if x_um != y_um:
        raise InputError(
            f"micmac: a pixel of {frame.image!r} is {x_um:g} x {y_um:g} um. Resample it, and export colmap."
        )
    return Canvas(0.0, 0.0, x_um / 1000.0, *block.size_px(frame))


def _fiducials(block: Block, camera: str) -> dict[str, Array]:
    """Camera mm with y down, as adjusted; as given, where nothing is adjusted."""
    return {id: np.array(place) * _Y_DOWN for id, place in block.fiducials_mm(camera).items()}


def _marks(image: str, places: Mapping[str, Array], sigmas_px: Mapping[str, float] | None = None) -> list[str]:
    marks = []
    for point, place in places.items():
        content = [*xml_lines("NamePt", point), *xml_lines("PtIm", _numbers(place))]
        if sigmas_px and point in sigmas_px:
            content = [*xml_lines("PrecPointe", plain_number(sigmas_px[point])), *content]
        marks.append(xml_lines("OneMesureAF1I", content))
    return xml_lines("MesureAppuiFlottant1Im", [*xml_lines("NameIm", image), *chain(*marks)])


def _sigmas_px(marks: Sequence[ComparatorPoint], pitch_mm: float) -> dict[str, float]:
    """MicMac has one number a mark: the root mean square of both directions."""
    known = {mark.point: mark.sigma_mm for mark in marks if mark.sigma_mm is not None}
    return {point: float(np.sqrt((sigma**2).mean())) / pitch_mm for point, sigma in known.items()}


def _calibration(lens: FittedLens, box: Canvas) -> str:
    """A central perspective with ModPhgrStd, in px of the resampled frame. MicMac's P1 is OpenCV's p2."""
    fx, fy, x0, y0 = lens.values[:4]
    k1, k2, p1, p2, k3 = lens.named(BROWN)
    focal = fy / box.pitch_mm
    point = np.array([x0 - box.x_mm, box.y_mm - y0]) / box.pitch_mm + CONVENTION.first_pixel_px
    radial = [k / focal ** (2 * i) for i, k in enumerate((k1, k2, k3), 1)]
    terms = [*xml_lines("CDist", _numbers(point)), *chain(*(xml_lines("CoeffDist", plain_number(k)) for k in radial))]
    distortion = [*xml_lines("RadialePart", terms)]
    for name, value in {"P1": p2 / focal, "P2": p1 / focal, "b1": fx / fy - 1.0, "b2": lens.shear}.items():
        distortion += xml_lines(name, plain_number(value))
    content = [
        *xml_lines("KnownConv", _KNOWN),
        *xml_lines("PP", _numbers(point)),
        *xml_lines("F", plain_number(focal)),
        *xml_lines("SzIm", f"{box.width_px} {box.height_px}"),
        *xml_lines("CalibDistortion", xml_lines("ModPhgrStd", distortion)),
    ]
    return xml_text(xml_lines("ExportAPERO", xml_lines("CalibrationInternConique", content)))


def _orientation(frame: OutFrame, calibration: str) -> str:
    assert frame.model is not None
    rows = (Y_DOWN_Z_FORWARD @ frame.model.rotation).T  # camera to world
    station = frame.model.station
    lines = [f"L{i}" for i in (1, 2, 3)]
    matrix = list(chain(*(xml_lines(line, _numbers(row)) for line, row in zip(lines, rows, strict=True))))
    outer = [
        *xml_lines("KnownConv", _KNOWN),
        *xml_lines("Centre", _numbers(station)),
        *xml_lines("ParamRotation", xml_lines("CodageMatr", matrix)),
    ]
    content = [
        *xml_lines("TypeProj", "eProjStenope"),
        *xml_lines("ZoneUtileInPixel", "true"),
        *xml_lines("FileInterne", calibration),
        *xml_lines("RelativeNameFI", "true"),
        *xml_lines("Externe", outer),
        *xml_lines("ConvOri", xml_lines("KnownConv", _KNOWN)),
    ]
    return xml_text(xml_lines("ExportAPERO", xml_lines("OrientationConique", content)))


def _measures(block: Block, frames: Sequence[OutFrame], box: Canvas, reech: str) -> str:
    """The points' marks in the frames that ReSampFid makes, or in a digital camera's pictures."""
    images = []
    for frame in frames:
        marks = frame.observed(fiducials=False)
        assert frame.model is not None
        places = frame.model.camera_from_comparator(np.array([mark.xy_mm for mark in marks]).reshape(-1, 2))
        pixels = (places - (box.x_mm, box.y_mm)) * _Y_DOWN / box.pitch_mm + CONVENTION.first_pixel_px
        named = {mark.point: pixel for mark, pixel in zip(marks, pixels, strict=True) if mark.point in block.points}
        images += _marks(f"{reech}{frame.file_name}", named, _sigmas_px(marks, box.pitch_mm))
    return xml_text(xml_lines("SetOfMesureAppuisFlottants", images))


def _ground(block: Block) -> str:
    assert block.adjustment is not None
    points = []
    for id, place in block.points.items():
        sigmas = [each.sigma if np.isfinite(each.sigma) else 0.0 for each in block.adjustment.points[id].axes]
        content = [
            *xml_lines("Pt", _numbers(place)),
            *xml_lines("NamePt", id),
            *xml_lines("Incertitude", _numbers(np.array(sigmas))),
        ]
        points += xml_lines("OneAppuisDAF", content)
    return xml_text(xml_lines("DicoAppuisFlottant", points))


def _notes(
    camera: str, frames: Sequence[OutFrame], fiducials: Mapping[str, Array], box: Canvas, misfit_px: float
) -> tuple[str, ...]:
    fitted = f"{camera}: the lens was fitted over the frame: it is off by {misfit_px:.2g} px at most."
    if not fiducials:
        return (fitted,)
    misfits = {frame.image: affine_misfit_px(frame, fiducials, box) for frame in frames}
    worst = max(misfits, key=lambda image: misfits[image])
    own = (
        f"MicMac fits its affine transformation without weights: in image {worst} it lies up to "
        f"{misfits[worst]:.2g} px beside the adjusted one."
    )
    return (_resampling(camera, box), fitted, own)


def _resampling(camera: str, box: Canvas) -> str:
    right, bottom = box.x_mm + box.width_px * box.pitch_mm, box.y_mm - box.height_px * box.pitch_mm
    corners = ",".join(f"{value:.{_DIGITS}g}" for value in (box.x_mm, -box.y_mm, right, -bottom))
    command = f'mm3d ReSampFid ".*tif" {box.pitch_mm:.{_DIGITS}g} BoxCh=[{corners}]'
    return f"{camera}: {command} makes the frames; name your scans in the place of .*tif."


def affine_misfit_px(frame: OutFrame, fiducials: Mapping[str, Array], box: Canvas) -> float:
    """How far an affine transformation through an image's fiducials, all weighted alike, lies beside the adjusted one
    at them, px of the frame."""
    assert frame.model is not None
    marks = [mark for mark in frame.observed(fiducials=True) if mark.point in fiducials]
    if len(marks) < _FEWEST:
        return 0.0
    places = np.array([mark.xy_mm for mark in marks], dtype=float)
    design = np.column_stack([places, np.ones(len(places))])
    fitted = design @ np.linalg.lstsq(design, np.array([fiducials[mark.point] * _Y_DOWN for mark in marks]))[0]
    return float(np.linalg.norm(fitted - frame.model.camera_from_comparator(places), axis=1).max()) / box.pitch_mm


def _no_orientation(camera: str) -> tuple[str, ...]:
    return (f"{camera}: no image is oriented, so there are marks only: camera and poses come by object points.",)


def _numbers(values: Array) -> str:
    return " ".join(plain_number(value) for value in values)


def read(paths: Sequence[Path], options: ImportOptions) -> Incoming:
    """Files MeasuresIm-*.xml (fiducials), MeasuresCamera.xml (a camera's, which makes a camera file) and sets of marks
    (points)."""
    marks: list[ForeignMark] = []
    cameras = []
    for path in paths:
        root = read_xml(path)
        alone = root.tag == "MesureAppuiFlottant1Im"
        images = [root] if alone else root.findall("MesureAppuiFlottant1Im")
        if not images:
            raise InputError(f"{path}: has no <MesureAppuiFlottant1Im>. Measures of marks are read, and nothing else.")
        if path.name == "MeasuresCamera.xml":
            places = {point: place * _Y_DOWN for point, place, _ in _points(root, path)}
            if not places:
                raise InputError(
                    f"{path}: has no mark <OneMesureAF1I>, so nothing is known of the camera. Name another."
                )
            cameras.append(fiducial_camera(path.parent.parent.name or "camera", places))
            continue
        for image in images:
            name = image_name(text_of(image, "NameIm", path))
            for point, place, sigma_px in _points(image, path):
                covariance = None if sigma_px is None else sigma_px**2 * np.eye(2)
                kind: Literal["fiducial", "target"] = "fiducial" if alone or options.fiducials else "target"
                marks.append(ForeignMark(name, point, kind, place - CONVENTION.first_pixel_px, covariance))
    return Incoming(tuple(marks), tuple(cameras))


def _points(image: Element, path: Path) -> Iterator[tuple[str, Array, float | None]]:
    """Name, place and standard deviation, if there is one, of an image's marks."""
    for mark in image.findall("OneMesureAF1I"):
        sigma_px = numbers_of(mark, "PrecPointe", 1, path)[0] if mark.find("PrecPointe") is not None else None
        yield text_of(mark, "NamePt", path), np.array(numbers_of(mark, "PtIm", 2, path)), sigma_px
