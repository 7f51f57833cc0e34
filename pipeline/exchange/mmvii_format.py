"""MMVII: marks of unresampled scans with their full covariances, which no other of these formats supports."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from pipeline.errors import InputError
from pipeline.exchange.block import Block, OutFrame
from pipeline.exchange.formats import Convention, ExportOptions, Written
from pipeline.exchange.incoming import ForeignMark, ImportOptions, Incoming
from pipeline.exchange.xml_tree import Content, child_numbers, child_text, read_xml, xml_text
from pipeline.results.comparator_file import ComparatorPoint
from pipeline.text.files import image_name

CONVENTION = Convention(
    (0.0, 0.0),
    "column right, row down; Sigma2 is the covariance xx xy yy in px",
    "micmac, MMVII/src/Sensors/Measures.cpp (Name, Pt, Sigma2; SetMesIm, NameIm, Measures) and cGenerateTarget.cpp",
)
_FOLDERS = {True: "Fiducials", False: "Targets"}


def write(block: Block, options: ExportOptions) -> Written:
    """Write MMVII-PhgrProj/PointsMeasure/{Fiducials, Targets}/MesIm-IMAGE.xml."""
    kinds = [(frame, folder, frame.observed(is_f)) for frame in block.frames for is_f, folder in _FOLDERS.items()]
    files = {
        f"MMVII-PhgrProj/PointsMeasure/{folder}/MesIm-{frame.file_name}.xml": _measures(frame, marks)
        for frame, folder, marks in kinds
        if marks
    }
    without_sigma = sum(mark.sigma_mm is None for *_, marks in kinds for mark in marks)
    lost = ("of the marks nothing; camera, poses and points do not go out",)
    note = f"{without_sigma} marks have no standard deviation of their own: Sigma2 is 1 0 1 px."
    return Written(files, lost, (note,) if without_sigma else ())


def _measures(frame: OutFrame, marks: tuple[ComparatorPoint, ...]) -> str:
    places = frame.pixels(marks) + CONVENTION.first_pixel_px
    measures: list[tuple[str, Content]] = [
        ("el", {"Name": f'"{mark.point}"', "Pt": place, "Sigma2": np.array(_sigma2(mark, frame.known_pitch_um))})
        for mark, place in zip(marks, places, strict=True)
    ]
    data: Content = {"SetMesIm": {"NameIm": f'"{frame.file_name}"', "Measures": measures}}
    return xml_text("Root", {"Type": '"MMVII_Serialization"', "Version": '"0.0.0"', "Data": data})


def _sigma2(mark: ComparatorPoint, pitch_um: tuple[float, float]) -> tuple[float, float, float]:
    """Covariance xx, xy, yy in px. The rows point down, so xy changes its sign."""
    if mark.sigma_mm is None:
        return 1.0, 0.0, 1.0
    sx, sy = (float(sigma) for sigma in mark.sigma_mm / (np.array(pitch_um) / 1000.0))
    return sx * sx, -mark.rho * sx * sy, sy * sy


def read(paths: Sequence[Path], options: ImportOptions) -> Incoming:
    """Read MesIm-*.xml: marks with their covariances. Those in a folder Fiducials are fiducials."""
    return Incoming(tuple(mark for path in paths for mark in _marks(path, options)))


def _marks(path: Path, options: ImportOptions) -> Iterator[ForeignMark]:
    is_fiducial = options.fiducials or path.resolve().parent.name == _FOLDERS[True]
    measures = read_xml(path).find("Data/SetMesIm")
    if measures is None:
        raise InputError(f"{path}: has no <SetMesIm>. Files MesIm-*.xml are read.")
    image = image_name(_unquoted(child_text(measures, "NameIm", path)))
    for element in measures.iterfind("Measures/el"):
        place = np.array(child_numbers(element, "Pt", 2, path)) - CONVENTION.first_pixel_px
        xx, xy, yy = child_numbers(element, "Sigma2", 3, path)
        known = xx > 0.0 and yy > 0.0 and xx * yy > xy * xy
        covariance = np.array([[xx, xy], [xy, yy]]) if known else None
        name = _unquoted(child_text(element, "Name", path))
        yield ForeignMark(image, name, "fiducial" if is_fiducial else "target", place, covariance)


def _unquoted(text: str) -> str:
    return text[1:-1] if len(text) > 1 and text[0] == text[-1] == '"' else text
