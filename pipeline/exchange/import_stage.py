"""`reseau import`: marks, cameras and poses of other programs, and certificates, as files of this one."""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from importlib.metadata import version
from pathlib import Path

import numpy as np

from adjust.functional_model.rotation import angles_from_rotation
from pipeline.errors import InputError
from pipeline.exchange.convention import IMPORTED
from pipeline.exchange.export_stage import README, check_folder, publish
from pipeline.exchange.incoming import ForeignMark, ForeignPose, ImportOptions, Incoming
from pipeline.files.camera_file import DEFAULT_SIGMA_MM, CameraFile
from pipeline.files.camera_text import camera_text
from pipeline.files.images_file import ELEMENTS
from pipeline.results.comparator_file import COLUMNS, comparator_from_pixel
from pipeline.text.csv_table import csv_line
from pipeline.text.names import file_word


@dataclass(frozen=True)
class Imported:
    """What was written; told: the lines of its README."""

    files: tuple[str, ...]
    readme_text: str


def run_import(format: str, paths: Sequence[Path], folder: Path, options: ImportOptions) -> Imported:
    """Write what another program's files hold into a folder, in the place of an earlier import.

    Raises InputError for a format that there is not, and for files that are not of it.
    """
    if format not in IMPORTED:
        raise InputError(f"there is no format {format!r} to import; possible are {', '.join(IMPORTED)}.")
    check_folder(folder)
    module = "certificate" if format == "certificate" else f"{format}_format"
    read: Callable[[Sequence[Path], ImportOptions], Incoming] = import_module(f"pipeline.exchange.{module}").read
    incoming = read(paths, options)
    files: dict[str, str | bytes] = dict(incoming.tables)
    if incoming.marks:
        files["comparator.csv"] = _comparator(incoming, options)
    if incoming.poses:
        files["images.csv"] = _images(incoming.poses)
    files |= _cameras(incoming.cameras)
    if not files:
        raise InputError(f"{', '.join(map(str, paths))}: there is nothing to import in it.")
    incoming = replace(incoming, notes=(*incoming.notes, *_unknown_notes(incoming.cameras)))
    readme_text = _readme(format, paths, files, incoming)
    publish(folder, {**files, README: readme_text})
    return Imported(tuple(files), readme_text)


def _unknown_notes(cameras: Sequence[CameraFile]) -> Iterator[str]:
    """What a camera file says that the other program's files do not."""
    for camera in cameras:
        if camera.principal_distance_sigma_mm == 0.0:
            yield (
                f"{camera.name}: the files give no standard deviations. The calibration is held fixed; give [sigma] in "
                "the camera file if it is to be adjusted."
            )
        if camera.fiducials and camera.principal_point_mm is not None:
            x, y = camera.principal_point_mm
            yield (
                f"{camera.name}: the files give no principal point. Adjusting starts at the middle of the fiducials, "
                f"({x:.4g}, {y:.4g}) mm; it is free. The standard deviation of the fiducials, {DEFAULT_SIGMA_MM:g} mm, "
                "is no figure of the files either. Set in the camera file what a certificate says."
            )


def _readme(format: str, paths: Sequence[Path], files: dict[str, str | bytes], incoming: Incoming) -> str:
    lines = [f"Written by reseau {version('reseau')}: import of {format}", "", "From:"]
    lines += [f"- {path.name}" for path in paths]
    lines += ["", "Files:", *(f"- {name}" for name in files)]
    return "\n".join([*lines, "", "Notes:", *(f"- {note}" for note in incoming.notes or ("nothing",))]) + "\n"


def _comparator(incoming: Incoming, options: ImportOptions) -> str:
    if options.pitch_um is None:
        raise InputError("marks in pixels become mm: say with --pitch-um how many um a pixel has.")
    pitch = (options.pitch_um, options.pitch_um)
    times = Counter((mark.image, mark.kind, mark.point) for mark in incoming.marks)
    (image, kind, point), most = times.most_common(1)[0]
    if most > 1:
        raise InputError(f"{kind} {point!r} of image {image!r} is given twice in the files. Name one of them.")
    lines = [
        f"# comparator coordinates, reseau {version('reseau')}, imported",
        "# x_mm to the right, y_mm UP, origin at the centre of the scan's top-left pixel; sx_mm, sy_mm their sigmas",
        "# col_px to the right, row_px down; the CENTRE of the top-left pixel is (0, 0)",
        *(
            f"# pitch of {image}: {pitch[0]:.10g} um across, {pitch[1]:.10g} um down"
            for image in _image_names(incoming)
        ),
        ",".join(COLUMNS),
    ]
    return "\n".join([*lines, *(_mark_line(mark, options, pitch) for mark in incoming.marks)]) + "\n"


def _image_names(incoming: Incoming) -> list[str]:
    return sorted({mark.image for mark in incoming.marks})


def _mark_line(mark: ForeignMark, options: ImportOptions, pitch_um: tuple[float, float]) -> str:
    covariance = mark.covariance_px2
    if covariance is None:
        if options.sigma_px is None:
            raise InputError(
                f"mark {mark.point!r} of image {mark.image!r} has no standard deviation: say with --sigma-px what "
                "marks have that bring none."
            )
        covariance = options.sigma_px**2 * np.eye(2)
    x, y = comparator_from_pixel(mark.place, pitch_um)
    mm2 = comparator_from_pixel(comparator_from_pixel(covariance, pitch_um).T, pitch_um)
    sx, sy = np.sqrt(np.diag(mm2))
    numbers = [x, y, sx, sy, mm2[0, 1] / (sx * sy), *mark.place]
    return csv_line([mark.image, mark.point, mark.kind, *(repr(float(number)) for number in numbers), "measured", ""])


def _images(poses: Sequence[ForeignPose]) -> str:
    """Without standard deviations: approximations."""
    lines = ["# orientations of another program, as approximations", ",".join(("image", *ELEMENTS))]
    for pose in poses:
        angles = np.degrees(angles_from_rotation(pose.rotation))
        lines.append(csv_line([pose.image, *(repr(float(value)) for value in (*pose.station, *angles))]))
    return "\n".join(lines) + "\n"


def _cameras(cameras: Sequence[CameraFile]) -> dict[str, str]:
    """camera.toml, or files by name where there are several; equal ones once."""
    files: dict[str, str] = {}
    for camera in cameras:
        name = "camera.toml" if len(cameras) == 1 else f"{file_word(camera.name or 'camera')}.toml"
        text = camera_text(replace(camera, path=Path(name)), lambda *_: "")
        if files.setdefault(name, text) != text:
            raise InputError(f"two cameras of the name {camera.name!r} differ. Import them one by one.")
    return files
