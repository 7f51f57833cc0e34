"""Whether the fiducials of comparator.csv can be those of the camera's file: by their names, and by their unit."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import InputError
from pipeline.files.project_file import Project
from pipeline.results.comparator_file import ComparatorPoint

OTHER_UNIT = 5.0  # film and paper keep their size to some percent; the nearest other unit, cm, is ten times as large


def check_fiducials(project: Project, marks: Sequence[ComparatorPoint]) -> None:
    """Raises InputError for a fiducial that the camera does not have, and for given coordinates that are no mm."""
    shown: dict[str, list[ComparatorPoint]] = {}
    for mark in marks:
        if mark.kind == "fiducial":
            shown.setdefault(mark.image, []).append(mark)
    for image, own in shown.items():
        _check_names(project, image, own)
        if not project.scans:
            _check_unit(project, image, own)


def _check_names(project: Project, image: str, marks: Sequence[ComparatorPoint]) -> None:
    camera = project.camera_of(image)
    ids = [fiducial.id for fiducial in camera.fiducials]
    for mark in marks:
        if mark.point not in ids:
            raise InputError(
                f"{project.comparator}, line {mark.line}: image {image!r}: {camera.path} has no fiducial "
                f"{mark.point!r}. It has {', '.join(ids) or 'none'}."
            )


def _check_unit(project: Project, image: str, marks: Sequence[ComparatorPoint]) -> None:
    """In um, inches or pixels they stand farther apart than the camera's, or closer, than film could make them."""
    camera = project.camera_of(image)
    given = {one.id: one.xy_mm for one in camera.fiducials if max(one.sigma_mm) < math.inf}
    known = [(mark.xy_mm, given[mark.point]) for mark in marks if mark.xy_mm is not None and mark.point in given]
    measured_mm, given_mm = (_extent(np.array(places)) for places in zip(*known, strict=True)) if known else (0.0, 0.0)
    if measured_mm and given_mm and not 1 / OTHER_UNIT < measured_mm / given_mm < OTHER_UNIT:
        raise InputError(
            f"{project.comparator}, line {marks[0].line}: the fiducials of image {image!r} stand "
            f"{measured_mm / given_mm:.3g} times as far apart as those of {camera.path}. Give both in mm: not in um, "
            "inches or pixels."
        )


def _extent(xy: NDArray[np.float64]) -> float:
    """Of points (n, 2), the diagonal of the rectangle about them."""
    return float(np.hypot(*np.ptp(xy, axis=0)))
