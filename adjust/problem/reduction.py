"""Reduction of object coordinates to the centroid of the network.

The difference of two coordinates of seven digits has a rounding error of about a nanometre, which keeps an iteration
from converging. All computations therefore use coordinates relative to the centre of the field.
"""

from dataclasses import dataclass, replace

import numpy as np

from adjust.array_types import Array
from adjust.functional_model.lens import Prior
from adjust.problem.network import Approximations, Network, ObjectPoint
from adjust.problem.unknowns import Unknowns


@dataclass(frozen=True)
class Reduction:
    """Shift of object coordinates; origin (3,): subtracted from all stations and points."""

    origin: Array

    @classmethod
    def to_centroid(cls, network: Network) -> "Reduction":
        """Choose a round origin near the centre of the given coordinates; zero where the field includes the origin.

        The origin is a multiple of a power of two near the field's extent, so that no digit of a coordinate is lost.
        Heights are not reduced where the line of sight depends on them.
        """
        xyz = _given_places(network)
        given = [axis[~np.isnan(axis)] for axis in xyz.T]
        middle = np.array([np.median(axis) if len(axis) else 0.0 for axis in given])
        off = [np.abs(axis - center) for axis, center in zip(given, middle, strict=True) if len(axis)]
        extent = max((float(np.median(axis)) for axis in off), default=0.0)
        step = 2.0 ** np.ceil(np.log2(4.0 * extent)) if extent > 0.0 else 1.0
        origin = step * np.round(middle / step)
        if not network.line_of_sight.is_straight:
            origin[2] = 0.0
        return cls(origin if np.isfinite(origin).all() else np.zeros(3))

    @property
    def is_none(self) -> bool:
        return not self.origin.any()

    @property
    def inverse(self) -> "Reduction":
        """Transformation back to the network's own coordinates."""
        return Reduction(-self.origin)

    def network(self, network: Network) -> Network:
        """Reduce a network."""
        if self.is_none:
            return network
        shift = self._element_shift
        images, points = [], []
        for image in network.images:
            given = image.exterior and replace(image.exterior, values=image.exterior.values - shift)
            images.append(replace(image, exterior=given))
        for point in network.points:
            priors = zip(point.priors, self.origin.tolist(), strict=True)
            moved = (prior and Prior(prior.value - off, prior.sigma) for prior, off in priors)
            points.append(ObjectPoint(point.id, *moved))
        boards = (
            replace(board, places={id_: xyz - self.origin for id_, xyz in board.places.items()})
            for board in network.boards
        )
        return replace(network, images=tuple(images), points=tuple(points), boards=tuple(boards))

    def approximations(self, start: Approximations) -> Approximations:
        """Reduce approximations."""
        if self.is_none:
            return start
        return replace(
            start,
            exterior={image: values - self._element_shift for image, values in start.exterior.items()},
            points={point: xyz - self.origin for point, xyz in start.points.items()},
        )

    def unreduced_values(self, unknowns: Unknowns, values: Array, network: Network) -> Array:
        """Convert values (n,) of reduced unknowns to the network's own coordinates; fixed ones exactly as given."""
        if self.is_none:
            return values
        whole = values.copy()
        for at in [*unknowns.point.values(), *{at[0]: at[:3] for at in unknowns.exterior.values()}.values()]:
            whole[at] += self.origin
        for point in (each for each in network.points if each.id in unknowns.point):
            for at, prior in zip(unknowns.point[point.id], point.priors, strict=True):
                if prior is not None and prior.sigma == 0.0 and unknowns.sigma[at] == 0.0:
                    whole[at] = prior.value
        return whole

    @property
    def _element_shift(self) -> Array:
        """(6,) shift of an exterior orientation."""
        return np.append(self.origin, np.zeros(3))


def _given_places(network: Network) -> Array:
    """(n, 3) given coordinates of the points, else of the stations; nan where not given."""
    places, _ = network.point_priors
    if not np.isnan(places).all():
        return places
    return np.array([image.exterior.center for image in network.images if image.exterior is not None]).reshape(-1, 3)
