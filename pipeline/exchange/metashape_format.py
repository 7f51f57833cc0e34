"""Metashape: a script for its console that creates film cameras with fiducials, and calibrations in its XML."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from pipeline.adjusting.picture_turn import NOT_TURNED
from pipeline.errors import InputError
from pipeline.exchange.block import ImageBlock, OutFrame
from pipeline.exchange.formats import Convention, ExportOptions, Written
from pipeline.exchange.incoming import (
    ImportOptions,
    Incoming,
    child_numbers,
    child_text,
    opencv_camera,
    read_xml,
    xml_text,
)
from pipeline.exchange.micmac_format import TURNED, camera_box
from pipeline.exchange.pinhole import BROWN, FittedLens, checked_misfits, sheared_lens
from pipeline.files.camera_file import CameraFile
from pipeline.opencv_check.opencv_calibration import INTERIOR
from pipeline.resampling.canvas import Canvas
from pipeline.text.files import file_word

METASHAPE = Convention(
    (0.5, 0.5),
    "column right, row down, from the outer corner of the first pixel; camera x right, y down, z forward",
    "Agisoft Metashape Professional manual, appendix Camera models: u = w/2 + cx + x'f + x'B1 + y'B2, v = h/2 + cy + "
    "y'f, x' = x(...) + P1 (r2 + 2x2) + 2 P2 xy; Python reference: Sensor.film_camera, pixel_size, "
    "calibrateFiducials(resolution in mm), Marker.Type.Fiducial",
)
_MOST_REASONS = 3  # largest number in a message
_OTHER_TERMS = ("k4", "p3", "p4")  # of its lens, which no family here has
NAMES = ("f", "cx", "cy", "k1", "k2", "k3", "p1", "p2", "b1", "b2")


def write_metashape(block: ImageBlock, options: ExportOptions) -> Written:
    """Write reseau_to_metashape.py with its data, and CAMERA.xml where there is an adjustment; of digital cameras
    CAMERA.xml alone."""
    reasons = {frame.image: _hindrance(block, frame) for frame in block.frames}
    frames = [frame for frame in block.frames if not reasons[frame.image]]
    digital = {frame.camera for frame in frames if not block.camera_file(frame.camera).fiducials}
    others = [frame.image for frame in block.frames if frame not in frames and frame.camera not in digital]
    left_out = tuple(f"{image}: {reasons[image]}" for image in others)
    if not frames:
        raise InputError(f"metashape: no image can go out. {' '.join(left_out[:_MOST_REASONS])}")
    files: dict[str, str | bytes] = {}
    notes = []
    for camera in dict.fromkeys(frame.camera for frame in frames if frame.is_oriented):
        own = [frame for frame in frames if frame.camera == camera and frame.is_oriented]
        lens, box = sheared_lens(block, own[0], at_ideal=False), camera_box(block, own[0], options)
        if camera in digital:  # a film's box begins at the frame's edge, a picture's at the middle of its first pixel
            box = replace(box, x_mm=box.x_mm - box.pitch_mm / 2.0, y_mm=box.y_mm + box.pitch_mm / 2.0)
        misfit_px = checked_misfits(block, own, lens, box, options, "metashape")
        files[f"{file_word(camera)}.xml"] = _calibration(lens, box)
        notes.append(f"{camera}: the lens was fitted over the frame: off by {misfit_px:.2g} px at most.")
    frames = [frame for frame in frames if frame.camera not in digital]
    if not frames:
        notes.append("A digital camera: Tools > Camera Calibration loads the XML file in Metashape.")
        return Written(files, ("standard deviations, exterior orientations, points and marks",), tuple(notes), left_out)
    data = {
        "cameras": {camera: _camera(block, camera, files) for camera in dict.fromkeys(f.camera for f in frames)},
        "images": [_image(frame) for frame in frames],
        "points": {id: place.tolist() for id, place in block.points.items()},
    }
    files["reseau_to_metashape.json"] = json.dumps(data, indent=1, ensure_ascii=False) + "\n"
    files["reseau_to_metashape.py"] = Path(__file__).with_name("metashape_script.txt").read_text(encoding="utf-8")
    notes.append(
        "The fiducials' y is given downward, as that of the pixels; no public page says which way Metashape takes it. "
        "Look at its picture after calibrateFiducials: the frame must stand upright."
    )
    lost = ("the standard deviations of marks", "the angles of the images", "what is not affine in the film")
    return Written(files, lost, tuple(notes), left_out)


def _hindrance(block: ImageBlock, frame: OutFrame) -> str:
    """Reason why an image cannot be exported; "" where it can."""
    if not block.camera_file(frame.camera).fiducials:
        without = "it has no adjusted orientation, and no fiducials." if not frame.is_oriented else ""
        return TURNED if frame.turn != NOT_TURNED else without
    if frame.is_mirrored:
        return (
            "its scan is mirrored, and Metashape is not known to take that. Resample it (reseau resample) and use the "
            "opencv or colmap export."
        )
    if len(frame.observed_marks(fiducials=True)) < 3:
        return f"{len(frame.observed_marks(fiducials=True))} of its fiducials are observed, and three are needed."
    return ""


def _camera(block: ImageBlock, name: str, files: dict[str, str | bytes]) -> dict[str, object]:
    file = block.camera_file(name)
    adjusted = block.adjustment.cameras.get(name) if block.adjustment else None
    calibration = f"{file_word(name)}.xml"
    return {
        "focal_length_mm": adjusted.principal_distance_mm.value if adjusted else file.principal_distance_mm,
        "calibration": calibration if calibration in files else None,
        "fiducials_mm": {id: [x, -y] for id, (x, y) in block.fiducials_mm(name).items()},
    }


def _image(frame: OutFrame) -> dict[str, object]:
    pitch = frame.known_pitch_um
    marks = {
        key: {
            mark.point: place.tolist()
            for mark, place in zip(own, frame.pixels(own) + METASHAPE.first_pixel_px, strict=True)
        }
        for key, own in (("fiducials_px", frame.observed_marks(True)), ("points_px", frame.observed_marks(False)))
    }
    return {
        "file": str(frame.scan_file.resolve()) if frame.scan_file else frame.file_name,
        "label": Path(frame.file_name).stem,
        "camera": frame.camera,
        "pitch_mm": [pitch[0] / 1000.0, pitch[1] / 1000.0],
        "station": frame.model.station.tolist() if frame.model is not None and frame.is_oriented else None,
        **marks,
    }


def _calibration(lens: FittedLens, box: Canvas) -> str:
    """Calibration of the exposed frame; cx and cy from its centre. Metashape's p1 is OpenCV's p2."""
    fx, fy, x0, y0 = lens.coefficients(INTERIOR)
    k1, k2, p1, p2, k3 = lens.coefficients(BROWN)
    middle = box.x_mm + box.width_px * box.pitch_mm / 2.0, box.y_mm - box.height_px * box.pitch_mm / 2.0
    values = {
        "f": fy,
        "cx": x0 - middle[0],
        "cy": middle[1] - y0,
        "b1": fx - fy,
        "b2": lens.shear * fy,
    }
    in_px = {name: float(value / box.pitch_mm) for name, value in values.items()}
    terms = {"k1": k1, "k2": k2, "k3": k3, "p1": p2, "p2": p1}
    size = {"projection": "frame", "width": str(box.width_px), "height": str(box.height_px)}
    return xml_text("calibration", {**size, **in_px, **{name: float(value) for name, value in terms.items()}})


def import_metashape(paths: Sequence[Path], options: ImportOptions) -> Incoming:
    """Read calibrations in Agisoft's XML as camera files."""
    return Incoming(cameras=tuple(_read_camera(path, options) for path in paths))


def _read_camera(path: Path, options: ImportOptions) -> CameraFile:
    """Read one calibration. Raises InputError for other files, and for parameters that no family here has."""
    root = read_xml(path)
    if root.tag != "calibration":
        raise InputError(f"{path}: its root is <{root.tag}>, not <calibration>. Save it as Agisoft XML.")
    projection = "frame" if root.find("projection") is None else child_text(root, "projection", path)
    if projection != "frame":
        raise InputError(f"{path}: is of a {projection} camera; only frame cameras are read.")
    names = ("width", "height", *NAMES, *_OTHER_TERMS)
    given = {name: child_numbers(root, name, 1, path)[0] for name in names if root.find(name) is not None}
    missing = [name for name in ("width", "height", "f") if not given.get(name, 0.0) > 0.0]
    if missing:
        raise InputError(f"{path}: has no positive {missing[0]}. Export the calibration again.")
    lost = [f"{name} is {given[name]:g}" for name in _OTHER_TERMS if given.get(name)]
    lost += [f"{child.tag} is {child.text}" for child in root if child.tag not in names and _is_set(child.text)]
    if lost:
        raise InputError(
            f"{path}: {lost[0]}, and no family of distortion here has it. Calibrate again with it held at 0."
        )
    values = {name: given.get(name, 0.0) for name in NAMES}
    f, b1, b2, size = values["f"], values["b1"], values["b2"], (given["width"], given["height"])
    interior = (f + b1, f, size[0] / 2 + values["cx"], size[1] / 2 + values["cy"])
    lens = {name: values[name] for name in ("k1", "k2", "k3")} | {"p1": values["p2"], "p2": values["p1"], "b2": b2 / f}
    return opencv_camera(path, path.stem, interior, lens, size, options, METASHAPE)


def _is_set(text: str | None) -> bool:
    """Whether the text of an element is a number other than 0."""
    try:
        return float(text or "") != 0.0
    except ValueError:
        return False
