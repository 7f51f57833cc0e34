"""MicMac: fiducials of unresampled scans for its ReSampFid, camera and orientations for the frames that it creates;
MMVII: marks of unresampled scans with their full covariances, which no other of these formats supports."""

from collections.abc import Iterator, Mapping, Sequence
from math import ceil, floor
from pathlib import Path
from typing import Literal

import numpy as np

from pipeline.adjusting.picture_turn import NOT_TURNED
from pipeline.errors import InputError
from pipeline.exchange import incoming, pinhole
from pipeline.exchange.block import ImageBlock, OutFrame
from pipeline.exchange.formats import Convention, ExportOptions, Written
from pipeline.opencv_check.opencv_calibration import INTERIOR
from pipeline.resampling.canvas import Canvas
from pipeline.results.comparator_file import ComparatorPoint
from pipeline.text.files import file_word, image_name
from pipeline.types import Array

MICMAC = Convention(
    (0.0, 0.0),
    "column right, row down; camera mm with x right and y DOWN; camera x right, y down, z forward; X = R P + C",
    "micmac, include/general: TIm2D::getr; DefautChantierDescripteur.xml, Key-Assoc-STD-Orientation-Interne (names of "
    "the files); ParamChantierPhotogram.xml (their elements); phgr_dist.cpp, cDistModStdPhpgr::Direct (distortion of "
    "the ideal point in px); cAppliOneReechMarqFid (pixel = (mm - box) / resolution)",
)
_CAMERA_IMAGE = "Glob"  # name of the image in MeasuresCamera.xml
_Y_DOWN = np.array([1.0, -1.0])
_KNOWN = {"KnownConv": "eConvApero_DistM2C"}
_REECH = "OIS-Reech_"  # prefix of the files that ReSampFid writes
_DIGITS = 12
TURNED = "its picture is turned (column turned_deg). Turn the file back, and calibrate again; or export colmap."
_FEWEST = 3  # marks needed for an affine transformation


def write_micmac(block: ImageBlock, options: ExportOptions) -> Written:
    """Write Ori-InterneScan with the fiducials and, where there is an adjustment, Ori-Reseau with camera and
    orientations.

    With several cameras each has its own folder, since MicMac reads one MeasuresCamera.xml per folder.
    """
    cameras = dict.fromkeys(frame.camera for frame in block.frames)
    parts = {
        f"{file_word(camera)}/" if len(cameras) > 1 else "": _camera_files(block, camera, options) for camera in cameras
    }
    lost = (
        "what x and y of a mark differ in precision (PrecPointe is one number, and ReSampFid does not look at it)",
        "the covariances of an adjustment",
    )
    return Written(
        {f"{folder}{place}": content for folder, part in parts.items() for place, content in part.files.items()},
        lost,
        tuple(note for part in parts.values() for note in part.notes),
        tuple(reason for part in parts.values() for reason in part.left_out),
    )


def _camera_files(block: ImageBlock, camera: str, options: ExportOptions) -> Written:
    frames = [frame for frame in block.frames if frame.camera == camera]
    fiducials = {id: np.array(place) * _Y_DOWN for id, place in block.fiducials_mm(camera).items()}
    files: dict[str, str | bytes] = {}
    left_out: tuple[str, ...] = ()
    if fiducials:
        files["Ori-InterneScan/MeasuresCamera.xml"] = incoming.xml_text(*_marks(_CAMERA_IMAGE, fiducials))
        found = {frame.image: frame.observed_marks(fiducials=True) for frame in frames}
        few = [frame.image for frame in frames if len(found[frame.image]) < _FEWEST]
        reason = "fiducials are observed, and MicMac's affine fit needs three."
        left_out = tuple(f"{image}: {len(found[image])} {reason}" for image in few)
        frames = [frame for frame in frames if frame.image not in few]
        for frame in frames:
            marks = found[frame.image]
            pixels = frame.pixels(marks) + MICMAC.first_pixel_px
            places = {mark.point: pixel for mark, pixel in zip(marks, pixels, strict=True)}
            own = _marks(frame.file_name, places, _sigmas_px(marks, sum(frame.known_pitch_um) / 2000.0))
            files[f"Ori-InterneScan/MeasuresIm-{frame.file_name}.xml"] = incoming.xml_text(*own)
    turned = [frame for frame in frames if frame.turn != NOT_TURNED]
    left_out += tuple(f"{frame.image}: {TURNED}" for frame in turned)
    oriented = [frame for frame in frames if frame.is_oriented and frame not in turned]
    if not oriented:
        has_frame = bool(fiducials and frames) and block.camera_file(camera).frame_mm is not None
        command = (_resampling(camera, film_box(block, frames[0], options)),) if has_frame else ()
        without = f"{camera}: no image is oriented, so there are marks only: its calibration needs object points."
        return Written(files, notes=(*command, without), left_out=left_out)
    lens = pinhole.sheared_lens(block, oriented[0], at_ideal=True)
    box = camera_box(block, oriented[0], options)
    reech = _REECH if fiducials else ""
    misfit_px = pinhole.checked_misfits(block, oriented, lens, box, options, "micmac")
    calibration = f"Ori-Reseau/AutoCal_{file_word(camera)}.xml"
    files[calibration] = _calibration(lens, box)
    for frame in oriented:
        files[f"Ori-Reseau/Orientation-{reech}{frame.file_name}.xml"] = _orientation(frame, calibration)
    files["Measures-S2D.xml"] = _measures(block, oriented, box, reech)
    files["Measures-S3D.xml"] = _ground(block)
    notes = [f"{camera}: the lens was fitted over the frame: it is off by {misfit_px:.2g} px at most."]
    if fiducials:
        misfits = {frame.image: _affine_misfit_px(frame, fiducials, box) for frame in oriented}
        worst = max(misfits, key=lambda image: misfits[image])
        notes.insert(0, _resampling(camera, box))
        notes.append(
            f"MicMac fits its affine transformation without weights: in image {worst} it lies up to "
            f"{misfits[worst]:.2g} px from the adjusted one."
        )
    return Written(files, notes=tuple(notes), left_out=left_out)


def film_box(block: ImageBlock, frame: OutFrame, options: ExportOptions) -> Canvas:
    """Canvas for ReSampFid: the exposed frame, at whole multiples of the pitch, never the bounding box of the marks."""
    pitch = options.pitch_um or float(np.sqrt(np.prod(frame.known_pitch_um)))
    corners = pinhole.frame_corners_mm(block, frame) / (pitch / 1000.0)
    left, top = floor(corners[0, 0]), ceil(corners[1, 1])
    width, height = ceil(corners[1, 0]) - left, top - floor(corners[0, 1])
    return Canvas(left * pitch / 1000.0, top * pitch / 1000.0, pitch / 1000.0, width, height)


def camera_box(block: ImageBlock, frame: OutFrame, options: ExportOptions) -> Canvas:
    """Canvas of a camera's frames: `film_box`, or a digital camera's picture, which is not resampled.

    Raises InputError for a picture whose pixels are not square.
    """
    if block.camera_file(frame.camera).fiducials:
        return film_box(block, frame, options)
    x_um, y_um = frame.known_pitch_um
    if x_um != y_um:
        raise InputError(
            f"a pixel of {frame.image!r} is {x_um:g} x {y_um:g} µm, and this format is for square ones. Resample it, "
            "and export colmap."
        )
    with block.open_scan(frame) as scan:
        return Canvas(0.0, 0.0, x_um / 1000.0, scan.width_px, scan.height_px)


def _marks(
    image: str, places: Mapping[str, Array], sigmas_px: Mapping[str, float] | None = None
) -> tuple[str, list[tuple[str, incoming.Content]]]:
    content: list[tuple[str, incoming.Content]] = [("NameIm", image)]
    for point, place in places.items():
        sigma = {"PrecPointe": sigmas_px[point]} if sigmas_px and point in sigmas_px else {}
        content.append(("OneMesureAF1I", {**sigma, "NamePt": point, "PtIm": place}))
    return "MesureAppuiFlottant1Im", content


def _sigmas_px(marks: Sequence[ComparatorPoint], pitch_mm: float) -> dict[str, float]:
    """One standard deviation per mark, px, as MicMac needs it: the root mean square of both directions."""
    known = {mark.point: mark.sigma_mm for mark in marks if mark.sigma_mm is not None}
    return {point: float(np.sqrt((sigma**2).mean())) / pitch_mm for point, sigma in known.items()}


def _calibration(lens: pinhole.FittedLens, box: Canvas) -> str:
    """Central perspective with ModPhgrStd, in px of the resampled frame. MicMac's P1 is OpenCV's p2."""
    fx, fy, x0, y0 = lens.coefficients(INTERIOR)
    k1, k2, p1, p2, k3 = lens.coefficients(pinhole.BROWN)
    focal = float(fy / box.pitch_mm)
    point = box.pixel_from_camera(np.array([x0, y0])) + MICMAC.first_pixel_px
    radial: list[tuple[str, incoming.Content]] = [("CDist", point)]
    radial += [("CoeffDist", float(k / focal ** (2 * i))) for i, k in enumerate((k1, k2, k3), 1)]
    affine = {"b1": float(fx / fy - 1.0), "b2": float(lens.shear)}
    distortion: incoming.Content = {"RadialePart": radial, "P1": float(p2 / focal), "P2": float(p1 / focal), **affine}
    content: incoming.Content = {
        **_KNOWN,
        "PP": point,
        "F": focal,
        "SzIm": f"{box.width_px} {box.height_px}",
        "CalibDistortion": {"ModPhgrStd": distortion},
    }
    return incoming.xml_text("ExportAPERO", {"CalibrationInternConique": content})


def _orientation(frame: OutFrame, calibration: str) -> str:
    assert frame.model is not None
    rows = (incoming.Y_DOWN_Z_FORWARD @ frame.model.rotation).T  # rotation from camera to world
    matrix = {f"L{i}": row for i, row in enumerate(rows, 1)}
    content: incoming.Content = {
        "TypeProj": "eProjStenope",
        "ZoneUtileInPixel": "true",
        "FileInterne": calibration,
        "RelativeNameFI": "true",
        "Externe": {**_KNOWN, "Centre": frame.model.station, "ParamRotation": {"CodageMatr": matrix}},
        "ConvOri": _KNOWN,
    }
    return incoming.xml_text("ExportAPERO", {"OrientationConique": content})


def _measures(block: ImageBlock, frames: Sequence[OutFrame], box: Canvas, reech: str) -> str:
    """The object points' marks in the frames created by ReSampFid, or in a digital camera's images."""
    images = []
    for frame in frames:
        marks = frame.observed_marks(fiducials=False)
        pixels = box.pixel_from_camera(frame.camera_mm(marks)) + MICMAC.first_pixel_px
        known = zip(marks, pixels, strict=True)
        places = {mark.point: pixel for mark, pixel in known if mark.point in block.points}
        images.append(_marks(f"{reech}{frame.file_name}", places, _sigmas_px(marks, box.pitch_mm)))
    return incoming.xml_text("SetOfMesureAppuisFlottants", images)


def _ground(block: ImageBlock) -> str:
    assert block.adjustment is not None
    points: list[tuple[str, incoming.Content]] = []
    for id, place in block.points.items():
        sigmas = np.array([each.sigma for each in block.adjustment.points[id].axes])
        known = np.where(np.isfinite(sigmas), sigmas, 0.0)
        points.append(("OneAppuisDAF", {"Pt": place, "NamePt": id, "Incertitude": known}))
    return incoming.xml_text("DicoAppuisFlottant", points)


def _resampling(camera: str, box: Canvas) -> str:
    right, bottom = box.x_mm + box.width_px * box.pitch_mm, box.y_mm - box.height_px * box.pitch_mm
    corners = ",".join(f"{value:.{_DIGITS}g}" for value in (box.x_mm, -box.y_mm, right, -bottom))
    command = f'mm3d ReSampFid ".*tif" {box.pitch_mm:.{_DIGITS}g} BoxCh=[{corners}]'
    return f"{camera}: {command} makes the frames; name your scans in the place of .*tif."


def _affine_misfit_px(frame: OutFrame, fiducials: Mapping[str, Array], box: Canvas) -> float:
    """Largest difference, px of the frame, at an image's fiducials between the unweighted and the adjusted affinity."""
    marks = tuple(mark for mark in frame.observed_marks(fiducials=True) if mark.point in fiducials)
    if len(marks) < _FEWEST:
        return 0.0
    design = np.array([[*mark.xy_mm, 1.0] for mark in marks if mark.xy_mm is not None])
    fitted = design @ np.linalg.lstsq(design, np.array([fiducials[mark.point] * _Y_DOWN for mark in marks]))[0]
    return float(np.linalg.norm(fitted - frame.camera_mm(marks), axis=1).max()) / box.pitch_mm


def import_micmac(paths: Sequence[Path], options: incoming.ImportOptions) -> incoming.Incoming:
    """Read MeasuresIm-*.xml (fiducials), MeasuresCamera.xml (gives a camera file) and sets of marks (object points).

    Whatever its name, a file whose image is called as in MeasuresCamera.xml is one.
    """
    marks: list[incoming.ForeignMark] = []
    cameras = []
    for path in paths:
        root = incoming.read_xml(path)
        alone = root.tag == "MesureAppuiFlottant1Im"
        images = [root] if alone else root.findall("MesureAppuiFlottant1Im")
        if not images:
            raise InputError(f"{path}: has no <MesureAppuiFlottant1Im>. Measures of marks are read, and nothing else.")
        if path.name == "MeasuresCamera.xml" or (images[0].findtext("NameIm") or "").strip() == _CAMERA_IMAGE:
            places = {point: place * _Y_DOWN for point, place, _ in _points(images[0], path)}
            if not places:
                raise InputError(
                    f"{path}: has no mark <OneMesureAF1I>, so nothing is known of the camera. Name another."
                )
            name = path.stem if path.name != "MeasuresCamera.xml" else path.parent.parent.name or "camera"
            cameras.append(incoming.fiducial_camera(name, places))
            continue
        kind: Literal["fiducial", "target"] = "fiducial" if alone or options.fiducials else "target"
        for image in images:
            name = image_name(incoming.child_text(image, "NameIm", path))
            for point, place, sigma_px in _points(image, path):
                covariance = sigma_px**2 * np.eye(2) if sigma_px is not None else None
                marks.append(incoming.ForeignMark(name, point, kind, place - MICMAC.first_pixel_px, covariance))
    return incoming.Incoming(tuple(marks), tuple(cameras))


def _points(image: incoming.Element, path: Path) -> Iterator[tuple[str, Array, float | None]]:
    """Name, place and standard deviation (or None) of an image's marks."""
    for mark in image.findall("OneMesureAF1I"):
        name, place = incoming.child_text(mark, "NamePt", path), incoming.child_numbers(mark, "PtIm", 2, path)
        is_given = mark.find("PrecPointe") is not None
        sigma_px = incoming.child_numbers(mark, "PrecPointe", 1, path)[0] if is_given else -1.0
        if not (sigma_px > 0.0 or sigma_px == -1.0):
            raise InputError(
                f"{path}: <PrecPointe> of mark {name!r} is {sigma_px:g}; a positive standard deviation in px is right. "
                "Correct it; -1 leaves it to --sigma-px."
            )
        yield name, np.array(place), sigma_px if sigma_px > 0.0 else None


MMVII = Convention(
    (0.0, 0.0),
    "column right, row down; Sigma2 is the covariance xx xy yy in px",
    "micmac, MMVII/src/Sensors/Measures.cpp (Name, Pt, Sigma2; SetMesIm, NameIm, Measures) and cGenerateTarget.cpp",
)
_NO_SIGMA2 = [-1.0, 0.0, -1.0]  # MMVII's own for a mark without one
_FOLDERS = {True: "Fiducials", False: "Targets"}


def write_mmvii(block: ImageBlock, options: ExportOptions) -> Written:
    """Write MMVII-PhgrProj/PointsMeasure/{Fiducials, Targets}/MesIm-IMAGE.xml."""
    kinds = [(frame, folder, frame.observed_marks(is_f)) for frame in block.frames for is_f, folder in _FOLDERS.items()]
    files = {
        f"MMVII-PhgrProj/PointsMeasure/{folder}/MesIm-{frame.file_name}.xml": _mmvii_measures(frame, marks)
        for frame, folder, marks in kinds
        if marks
    }
    without_sigma = sum(mark.sigma_mm is None for *_, marks in kinds for mark in marks)
    lost = ("of the marks nothing; camera, exterior orientations and points do not go out",)
    note = f"{without_sigma} marks have no standard deviation of their own: Sigma2 is 1 0 1 px."
    return Written(files, lost, (note,) if without_sigma else ())


def _mmvii_measures(frame: OutFrame, marks: tuple[ComparatorPoint, ...]) -> str:
    measures: list[tuple[str, incoming.Content]] = []
    for mark, place in zip(marks, frame.pixels(marks) + MMVII.first_pixel_px, strict=True):
        sigma2 = np.array([1.0, 0.0, 1.0])  # xx, xy, yy in px
        if mark.sigma_mm is not None:
            sx, sy = mark.sigma_mm / (np.array(frame.known_pitch_um) / 1000.0)
            sigma2 = np.array([sx * sx, -mark.rho * sx * sy, sy * sy])  # rows point down, so xy changes its sign
        measures.append(("el", {"Name": f'"{mark.point}"', "Pt": place, "Sigma2": sigma2}))
    data: incoming.Content = {"SetMesIm": {"NameIm": f'"{frame.file_name}"', "Measures": measures}}
    return incoming.xml_text("Root", {"Type": '"MMVII_Serialization"', "Version": '"0.0.0"', "Data": data})


def import_mmvii(paths: Sequence[Path], options: incoming.ImportOptions) -> incoming.Incoming:
    """Read MesIm-*.xml: marks with their covariances. Those in a folder Fiducials are fiducials."""
    marks = []
    for path in paths:
        is_fiducial = options.fiducials or path.resolve().parent.name == _FOLDERS[True]
        measures = incoming.read_xml(path).find("Data/SetMesIm")
        if measures is None:
            raise InputError(f"{path}: has no <SetMesIm>. Files MesIm-*.xml are read.")
        image = image_name(_unquote(incoming.child_text(measures, "NameIm", path)))
        for element in measures.iterfind("Measures/el"):
            place = np.array(incoming.child_numbers(element, "Pt", 2, path)) - MMVII.first_pixel_px
            name = _unquote(incoming.child_text(element, "Name", path))
            xx, xy, yy = sigma2 = incoming.child_numbers(element, "Sigma2", 3, path)
            if sigma2 != _NO_SIGMA2 and not (xx > 0.0 and yy > 0.0 and xx * yy > xy * xy):
                raise InputError(
                    f"{path}: <Sigma2> of mark {name!r} is {xx:g} {xy:g} {yy:g}; a covariance xx xy yy in px² has "
                    "positive xx and yy, and xy² < xx yy. Correct it; -1 0 -1 leaves it to --sigma-px."
                )
            covariance = None if sigma2 == _NO_SIGMA2 else np.array([[xx, xy], [xy, yy]])
            marks.append(incoming.ForeignMark(image, name, "fiducial" if is_fiducial else "target", place, covariance))
    return incoming.Incoming(tuple(marks))


def _unquote(text: str) -> str:
    return text[1:-1] if len(text) > 1 and text[0] == text[-1] == '"' else text
