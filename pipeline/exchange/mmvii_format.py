"""MMVII: the marks of unresampled scans with their whole covariances, which it alone of these programs takes."""

from collections.abc import Sequence
from itertools import chain
from pathlib import Path

import numpy as np

from pipeline.errors import InputError
from pipeline.exchange.block import Block, OutFrame
from pipeline.exchange.convention import Convention, ExportOptions, Written
from pipeline.exchange.incoming import ForeignMark, ImportOptions, Incoming
from pipeline.exchange.xml_tree import numbers_of, plain_number, read_xml, text_of, xml_lines, xml_text
from pipeline.results.comparator_file import ComparatorPoint
from pipeline.text.names import image_name

CONVENTION = Convention(
    (0.0, 0.0),
    "column right, row down; Sigma2 is the covariance xx xy yy in px",
    "micmac, MMVII/src/Sensors/Measures.cpp (Name, Pt, Sigma2; SetMesIm, NameIm, Measures) and cGenerateTarget.cpp",
)
_FOLDERS = {True: "Fiducials", False: "Targets"}


def write(block: Block, options: ExportOptions) -> Written:
    """MMVII-PhgrProj/PointsMeasure/{Fiducials, Targets}/MesIm-IMAGE.xml."""
    files: dict[str, str | bytes] = {}
    unsaid = 0
    for frame in block.frames:
        for fiducials, folder in _FOLDERS.items():
            marks = frame.observed(fiducials)
            unsaid += sum(mark.sigma_mm is None for mark in marks)
            if marks:
                place = f"MMVII-PhgrProj/PointsMeasure/{folder}/MesIm-{frame.file_name}.xml"
                files[place] = _measures(frame, marks)
    lost = ("of the marks nothing; camera, poses and points do not go out",)
    notes = (f"{unsaid} marks have no standard deviation of their own: Sigma2 is 1 0 1 px.",) if unsaid else ()
    return Written(files, lost, notes)


def _measures(frame: OutFrame, marks: tuple[ComparatorPoint, ...]) -> str:
    elements = []
    for mark, place in zip(marks, frame.pixels(marks) + CONVENTION.first_pixel_px, strict=True):
        xx, xy, yy = _sigma2(mark, frame.known_pitch_um)
        content = [
            *xml_lines("Name", f'"{mark.point}"'),
            *xml_lines("Pt", " ".join(plain_number(value) for value in place)),
            *xml_lines("Sigma2", f"{xx!r} {xy!r} {yy!r}"),
        ]
        elements.append(xml_lines("el", content))
    measures = [*xml_lines("NameIm", f'"{frame.file_name}"'), *xml_lines("Measures", list(chain(*elements)))]
    head = [*xml_lines("Type", '"MMVII_Serialization"'), *xml_lines("Version", '"0.0.0"')]
    return xml_text(xml_lines("Root", [*head, *xml_lines("Data", xml_lines("SetMesIm", measures))]))


def _sigma2(mark: ComparatorPoint, pitch_um: tuple[float, float]) -> tuple[float, float, float]:
    """In px, rows downward: what x and y have in common changes its sign."""
    if mark.sigma_mm is None:
        return 1.0, 0.0, 1.0
    sx, sy = (float(sigma) for sigma in mark.sigma_mm / (np.array(pitch_um) / 1000.0))
    return sx * sx, -mark.rho * sx * sy, sy * sy


def read(paths: Sequence[Path], options: ImportOptions) -> Incoming:
    """Files MesIm-*.xml: marks with their covariances. Those in a folder Fiducials are fiducials."""
    marks: list[ForeignMark] = []
    for path in paths:
        marks += _marks(path, options.fiducials or path.resolve().parent.name == _FOLDERS[True])
    return Incoming(tuple(marks))


def _marks(path: Path, fiducials: bool) -> list[ForeignMark]:
    measures = read_xml(path).find("Data/SetMesIm")
    if measures is None:
        raise InputError(f"{path}: has no <SetMesIm>. Files MesIm-*.xml are read.")
    image = image_name(_word(text_of(measures, "NameIm", path)))
    marks = []
    for element in measures.iterfind("Measures/el"):
        place = np.array(numbers_of(element, "Pt", 2, path)) - CONVENTION.first_pixel_px
        xx, xy, yy = numbers_of(element, "Sigma2", 3, path)
        known = xx > 0.0 and yy > 0.0 and xx * yy > xy * xy
        covariance = np.array([[xx, xy], [xy, yy]]) if known else None
        name = _word(text_of(element, "Name", path))
        marks.append(ForeignMark(image, name, "fiducial" if fiducials else "target", place, covariance))
    return marks


def _word(text: str) -> str:
    """Text stands within quotation marks."""
    return text[1:-1] if len(text) > 1 and text[0] == text[-1] == '"' else text
