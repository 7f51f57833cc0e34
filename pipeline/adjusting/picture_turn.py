"""Pictures of a digital camera that were turned by a quarter: to the sensor's coordinates and back."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pipeline.errors import InputError
from pipeline.files.project_file import Project
from pipeline.results.comparator_file import ComparatorPoint
from pipeline.types import Array

Turn = tuple[int, tuple[float, float]]  # counter-clockwise, degrees; from the sensor's first to its last pixel, mm
NOT_TURNED: Turn = (0, (0.0, 0.0))


def rotate_to_sensor(project: Project, marks: Sequence[ComparatorPoint]) -> list[ComparatorPoint]:
    """Marks in sensor coordinates, by the column turned_deg of images.csv.

    Raises InputError where the size of a rotated image is unknown.
    """
    rotated = []
    for mark in marks:
        if mark.xy_mm is not None and project.turned_deg(mark.image):
            turned_deg, last_mm = picture_turn(project, mark.image)
            mark = replace(mark, xy_mm=turned_back(mark.xy_mm, turned_deg, last_mm))
            if turned_deg != 180:
                sigma_mm = None if mark.sigma_mm is None else mark.sigma_mm[::-1].copy()
                mark = replace(mark, sigma_mm=sigma_mm, rho=-mark.rho)
        rotated.append(mark)
    return rotated


def turned_back(xy_mm: Array, turned_deg: int, last_mm: tuple[float, float]) -> Array:
    """(..., 2) comparator coordinates before a counter-clockwise rotation of the image.

    last_mm: distances from the first to the last pixel of a row and of a column before the rotation, mm.
    """
    x, y = np.moveaxis(np.asarray(xy_mm, float), -1, 0)
    width, height = last_mm
    places = {0: (x, y), 90: (y + width, -x), 180: (width - x, -height - y), 270: (-y, x - height)}
    return np.stack(places[turned_deg], axis=-1)


def turned_forth(xy_mm: Array, turned_deg: int, last_mm: tuple[float, float]) -> Array:
    """(..., 2) comparator coordinates after the rotation: the inverse of `turned_back`."""
    return turned_back(xy_mm, -turned_deg % 360, last_mm if turned_deg % 180 == 0 else last_mm[::-1])


def picture_turn(project: Project, image: str) -> Turn:
    """Rotation of an image, for `turned_back`. Raises InputError where the size of a rotated image is unknown."""
    turned_deg = project.turned_deg(image)
    if not turned_deg:
        return NOT_TURNED
    camera, pitch_um = project.image_camera(image), project.pitch_um
    if camera.frame_mm is None or pitch_um is None:
        raise InputError(
            f"{project.images_path}: image {image!r} is turned (column turned_deg), which needs the size of the "
            f"picture: give frame_mm in {camera.path} and pitch_um in {project.path}."
        )
    (width, height), (across, down) = camera.frame_mm, pitch_um
    return turned_deg, (width - across / 1000.0, height - down / 1000.0)
