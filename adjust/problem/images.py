"""Adjusted images of a network, as models that project points."""

from collections.abc import Sequence

import numpy as np

from adjust.array_types import Array
from adjust.functional_model.board import BOARD_NAMES
from adjust.functional_model.families import parameter_names
from adjust.functional_model.lens import INTERIOR_NAMES, Lens
from adjust.functional_model.projection import ImageModel
from adjust.functional_model.rotation import rotation_from_angles
from adjust.functional_model.scanner import NO_BEND
from adjust.functional_model.transformation import Film, film_parameter_names
from adjust.problem.estimates import Estimates
from adjust.problem.network import EXTERIOR_NAMES
from adjust.problem.parameter import Kind, Parameter


def adjusted_image(estimates: Estimates, name: str) -> ImageModel:
    """Make the image model of an image from adjusted values."""
    network = estimates.network
    image = network.image_by_name[name]

    def values(kind: Kind, owner: str, quantities: tuple[str, ...]) -> Array:
        return estimates.values_of(Parameter(kind, owner, "", each) for each in quantities)

    exterior = values("exterior", image.frame, EXTERIOR_NAMES)
    parameters = values("film", name, film_parameter_names(image.transformation))
    middle_mm, mirrored = network.extent_by_image[name].center_mm, name in estimates.mirrored
    bend = network.scanner_by_name[image.scanner].bend if image.scanner else NO_BEND
    return ImageModel(
        lens=adjusted_lens(estimates, image.camera),
        rotation=rotation_from_angles(exterior[3:]),
        station=exterior[:3],
        film=Film(image.transformation, parameters, middle_mm, mirrored),
        line_of_sight=network.line_of_sight,
        bend=bend,
        bend_parameters=values("scanner", image.scanner, bend.terms),
    )


def adjusted_lens(estimates: Estimates, camera: str) -> Lens:
    """Make a camera's lens from adjusted values, without covariance."""
    distortion = estimates.network.camera_by_name[camera].distortion
    names = (*INTERIOR_NAMES, *parameter_names(distortion.family))
    interior, parameters = np.split(estimates.values_of(Parameter.interior(camera, each) for each in names), [3])
    return Lens(distortion, interior, parameters)


def adjusted_places(estimates: Estimates, points: Sequence[str]) -> Array:
    """(n, 3) adjusted coordinates of object points, including the bend of their board."""
    places = estimates.values_of(Parameter.point(point, axis) for point in points for axis in "XYZ").reshape(-1, 3)
    return places + lifted(estimates, points)


def lifted(estimates: Estimates, points: Sequence[str]) -> Array:
    """(n, 3) displacements of object points from their flat places by the bends of boards."""
    offsets = np.zeros((len(points), 3))
    for board in estimates.network.boards:
        bends = estimates.values_of(Parameter.board(board.name, name) for name in BOARD_NAMES)
        for row, point in enumerate(points):
            if point in board.places:
                offsets[row] = bends @ board.lift_directions[point]
    return offsets
