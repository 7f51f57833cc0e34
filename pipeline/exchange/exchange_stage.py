"""`reseau export` and `reseau import`: marks, cameras and orientations as files of another program, and the reverse,
all files of a folder or none."""

import os
import re
import shutil
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import numpy as np

from adjust.functional_model.rotation import angles_from_rotation
from measure.flags import Status
from measure.scans.remote import ScanPart
from pipeline.errors import InputError
from pipeline.exchange.block import read_block
from pipeline.exchange.formats import ExportOptions, Written, format_function
from pipeline.exchange.incoming import ForeignMark, ForeignPose, ImportOptions, Incoming
from pipeline.files.camera_file import CameraFile, camera_text
from pipeline.files.camera_tables import DEFAULT_SIGMA_MM
from pipeline.files.object_files import ELEMENTS
from pipeline.files.project_file import Project
from pipeline.results import comparator_file
from pipeline.text.csv_table import csv_line
from pipeline.text.files import file_word, make_folder, path_below, write_atomically, writing
from pipeline.text.wording import listed

README = "README.txt"
SCAN_FORMATS = ("micmac", "mmvii", "metashape")  # whose pixels are those of the scan's file
ROTATION_ERROR = 1e-3  # of R^T R: rotations are written with four decimals or more
_HEAD = "Written by reseau"
_FILES = "\nFiles:\n"


def run_export(project: Project, format: str, folder: Path, options: ExportOptions) -> Written:
    """Write a format's files into a folder, replacing an earlier export.

    Raises InputError for an unknown format, a folder that holds anything else, and whatever the format cannot
    represent.
    """
    write, convention = format_function("write", format)
    check_folder(folder)
    block = read_block(project)
    images, cameras = dict[str, str](), dict[str, str]()  # by file name: other programs know them by nothing else
    for frame in block.frames:
        file_name = frame.scan.name if frame.scan and format not in SCAN_FORMATS else frame.file_name
        if format in SCAN_FORMATS and isinstance(frame.scan, ScanPart) and (frame.scan.page or 1) > 1:
            raise InputError(
                f"image {frame.image!r} is page {frame.scan.page} of {frame.file_name}, and {format} reads the first "
                "alone. Save the page as a file of its own, or export resampled frames: colmap or opencv."
            )
        name = Path(file_name).stem if format == "metashape" else file_name  # cameras of a chunk are labelled so
        other = images.setdefault(name, frame.image)
        if other != frame.image:
            raise InputError(
                f"images {other!r} and {frame.image!r} have files of the same name {name!r}, and other "
                "programs know images by it. Export them as projects of their own."
            )
        camera = cameras.setdefault(file_word(frame.camera), frame.camera)
        if camera != frame.camera and format in SCAN_FORMATS:
            raise InputError(
                f"cameras {camera!r} and {frame.camera!r} would have the same files {file_word(camera)!r}. Rename one."
            )
    written: Written = write(block, options)
    decisions = comparator_file.describe_decisions(comparator_file.read_decision_counts(project.comparator))
    written = replace(written, notes=tuple(filter(None, [*written.notes, *block.lens_reach.values(), decisions])))
    parts = {"Lost": written.lost, "Notes": written.notes, "Left out": written.left_out}
    col, row = convention.first_pixel_px
    pixel = [] if col != col else [f"The centre of the first pixel is ({col:g}, {row:g})."]
    head = [*pixel, f"Axes: {convention.axes}.", f"Source: {convention.source}."]
    readme_text = readme(format, head, parts)
    publish(folder, written.files, readme_text)
    return replace(written, readme_text=readme_text)


def readme(what: str, head: Sequence[str], parts: Mapping[str, Sequence[str]]) -> str:
    """Text of the README: a head, and lists by their titles."""
    lines = [f"{_HEAD} {version('reseau')}: {what}", "", *head]
    for title, sentences in parts.items():
        lines += ["", f"{title}:", *(f"- {sentence}" for sentence in sentences or ("nothing",))]
    return "\n".join(lines) + "\n"


def check_folder(folder: Path) -> None:
    """Raise InputError for a folder with anything other than an earlier export, by the files that its README lists, and
    for one that the program runs in."""
    if not folder.exists():
        return
    make_folder(folder)
    if Path.cwd().is_relative_to(folder.resolve()):
        raise InputError(
            f"{folder}: is the folder that reseau runs in, or above it, and the whole folder is replaced. Name "
            "another, such as export."
        )
    readme_path = folder / README
    text = readme_path.read_text(encoding="utf-8", errors="replace") if readme_path.is_file() else ""
    own = {README, *re.findall(r"^- (.*)$", text.partition(_FILES)[2], re.M)} if text.startswith(_HEAD) else set()
    others = (path.relative_to(folder).as_posix() for path in folder.rglob("*") if not path.is_dir())
    if found := sorted(set(others) - own)[:1]:
        raise InputError(
            f"{folder}: holds something that is no export of reseau, {found[0]}, and is replaced as a whole. Name "
            "another folder, or an empty one."
        )


def publish(folder: Path, files: Mapping[str, str | bytes], readme_text: str) -> str:
    """Write all files into a new folder that then replaces the earlier one, or the one that a symbolic link names, and
    return the README with the list of files.

    Raises InputError for file names that lead out of the folder.
    """
    folder = folder.resolve()
    new = folder.with_name(f".{folder.name}.{os.getpid()}.part")
    old = folder.with_name(f".{folder.name}.{os.getpid()}.old")
    readme_text = "\n".join([readme_text, f"{_FILES.strip()}", *(f"- {name}" for name in files), ""])
    try:
        all_files = {**files, README: readme_text}
        places = {path_below(folder, name).relative_to(folder): content for name, content in all_files.items()}
        for place, content in places.items():
            write_atomically(new / place, content)
        with writing(folder):
            if folder.exists():
                os.replace(folder, old)
            os.replace(new, folder)
    except BaseException:
        if old.exists() and not folder.exists():
            os.replace(old, folder)
        raise
    finally:
        for left in (new, old):
            shutil.rmtree(left, ignore_errors=True)
    return readme_text


def run_import(format: str, paths: Sequence[Path], folder: Path, options: ImportOptions) -> Written:
    """Convert another program's files and write the result into a folder, replacing an earlier import.

    Raises InputError for an unknown format and for files that do not have it.
    """
    read, _ = format_function("import", format)
    check_folder(folder)
    incoming: Incoming = read(paths, options)
    files: dict[str, str | bytes] = dict(incoming.tables)
    if incoming.marks:
        files["comparator.csv"] = _comparator(incoming.marks, options)
    is_one = len(incoming.cameras) == 1 and {pose.camera for pose in incoming.poses} <= {incoming.cameras[0].name}
    cameras = _cameras(incoming.cameras, is_one)
    if incoming.poses:
        files["images.csv"] = _images(incoming.poses, [] if is_one else [folder / name for name in cameras])
    files |= cameras
    if not files:
        raise InputError(f"{', '.join(map(str, paths))}: there is nothing to import in it.")
    notes = (*incoming.notes, *_unknown_notes(incoming.cameras))
    if cameras and not is_one and any(pose.camera for pose in incoming.poses):
        notes += (
            f"images.csv names a camera file for each image, as {folder / next(iter(cameras))}: from the folder "
            "of project.toml.",
        )
    parts = {"Notes": notes} | ({"Left out": incoming.left_out} if incoming.left_out else {})
    readme_text = readme(f"import of {format}", ["From:", *(f"- {path.name}" for path in paths)], parts)
    readme_text = publish(folder, files, readme_text)
    return Written(files, notes=notes, left_out=incoming.left_out, readme_text=readme_text)


def _unknown_notes(cameras: Sequence[CameraFile]) -> Iterator[str]:
    """Notes on what the camera files assume because the other program's files do not contain it."""
    held = dict.fromkeys(camera.name for camera in cameras if camera.principal_distance_sigma_mm == 0.0)
    if held:
        yield (
            f"{listed([*held])}: the files give no standard deviations. The calibration is held fixed; give [sigma] in "
            "the camera file if it is to be adjusted."
        )
    for camera in cameras:
        is_stated = np.isfinite(camera.principal_point_sigma_mm).all()  # as by a certificate
        if camera.fiducials and camera.principal_point_mm is not None and not is_stated:
            x, y = camera.principal_point_mm
            yield (
                f"{camera.name}: the files give no principal point. Adjusting starts at the middle of the fiducials, "
                f"({x:.4g}, {y:.4g}) mm; it is free. The standard deviation of the fiducials, {DEFAULT_SIGMA_MM:g} mm, "
                "is no figure of the files either. Set in the camera file what a certificate says."
            )


def _comparator(marks: Sequence[ForeignMark], options: ImportOptions) -> str:
    if options.pitch_um is None:
        raise InputError("marks in pixels become mm: give the pixel size in µm with --pitch-um.")
    pitch = (options.pitch_um, options.pitch_um)
    times = Counter((mark.image, mark.kind, mark.point) for mark in marks)
    (image, kind, point), most = times.most_common(1)[0]
    if most > 1:
        raise InputError(f"{kind} {point!r} of image {image!r} is given twice in the files. Name one of them.")
    rows = []
    for mark in marks:
        covariance = mark.covariance_px2
        if covariance is None:
            if options.sigma_px is None:
                raise InputError(
                    f"mark {mark.point!r} of image {mark.image!r} has no standard deviation: say with --sigma-px what "
                    "marks have that bring none."
                )
            covariance = options.sigma_px**2 * np.eye(2)
        place = comparator_file.comparator_from_pixel(mark.place, pitch)
        mm2 = comparator_file.comparator_from_pixel(comparator_file.comparator_from_pixel(covariance, pitch).T, pitch)
        sigma = np.sqrt(np.diag(mm2))
        rho = float(mm2[0, 1] / sigma.prod())
        rows.append(
            comparator_file.ComparatorPoint(mark.image, mark.point, mark.kind, place, sigma, rho, Status.MEASURED, "")
        )
    return "".join(comparator_file.comparator_lines(rows, dict.fromkeys(sorted({mark.image for mark in marks}), pitch)))


def _images(poses: Sequence[ForeignPose], cameras: Sequence[Path]) -> str:
    """images.csv without standard deviations: approximate orientations, and camera files unless all have one."""
    file_of = {path.name: path.as_posix() for path in cameras}
    columns = ("image", *ELEMENTS, "camera") if file_of else ("image", *ELEMENTS)
    lines = ["# orientations of another program, as approximations", ",".join(columns)]
    image, most = Counter(pose.image for pose in poses).most_common(1)[0]
    if most > 1:
        raise InputError(f"the orientation of image {image!r} is given twice in the files. Name one of them.")
    for pose in poses:
        turned = np.allclose(pose.rotation.T @ pose.rotation, np.eye(3), atol=ROTATION_ERROR)
        if not (turned and np.linalg.det(pose.rotation) > 0.0 and np.isfinite(pose.station).all()):
            raise InputError(
                f"the orientation of image {pose.image!r} is no rotation matrix with a place of finite numbers. "
                "Correct it, or leave the file out."
            )
        angles = np.degrees(angles_from_rotation(pose.rotation))
        camera = [file_of.get(_camera_file(pose.camera), "")] if file_of else []
        lines.append(csv_line([pose.image, *(repr(float(value)) for value in (*pose.station, *angles)), *camera]))
    return "\n".join(lines) + "\n"


def _camera_file(name: str) -> str:
    return f"{file_word(name or 'camera')}.toml"


def _cameras(cameras: Sequence[CameraFile], is_one: bool) -> dict[str, str]:
    """camera.toml where one is that of all images, else one file per name; equal ones once."""
    files: dict[str, str] = {}
    for camera in cameras:
        name = "camera.toml" if is_one else _camera_file(camera.name)
        text = camera_text(replace(camera, path=Path(name)), lambda *_: "")
        if files.setdefault(name, text) != text:
            raise InputError(
                f"two cameras of the name {camera.name!r} differ. Import them one by one, each into its own folder."
            )
    return files
