"""Image coordinates of the object points of a network: in the fiducial system, and corrected for the known lens."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from adjust.array_types import Array, Indices
from adjust.functional_model.lens import Lens
from adjust.functional_model.sight import Sight
from adjust.functional_model.transformation import film_kind
from adjust.problem.network import Network


@dataclass(frozen=True, eq=False)
class Frames:
    """Object points of all images in the fiducial system, image by image, sorted by point name within each.

    Attributes
    ----------
    rows : (n,) numbers of the observations.
    xy_mm : (n, 2) image coordinates.
    starts : (images + 1,) index of the first point of each image; the last is n.
    sigma_mm : (images,) median standard deviation of an image coordinate; 0 for an image without points.
    """

    network: Network
    rows: Indices
    xy_mm: Array
    starts: Indices
    sigma_mm: Array

    def part(self, image: int) -> slice:
        return slice(int(self.starts[image]), int(self.starts[image + 1]))

    def camera_images(self, camera: str) -> list[int]:
        """Numbers of the camera's images that show object points."""
        images = enumerate(self.network.images)
        return [i for i, image in images if image.camera == camera and self.starts[i] < self.starts[i + 1]]

    def places(self, images: list[int]) -> Indices:
        """Indices of the points of the given images, one image after the other."""
        return np.concatenate([np.arange(self.starts[i], self.starts[i + 1]) for i in images])

    def sights(self, camera: str, lens: Lens) -> dict[str, Sight]:
        """Reduce the images of a camera to the principal point and correct them for distortion; by image name.

        Coordinates outside the invertible range of the distortion are not corrected for it.
        """
        images, names = self.camera_images(camera), self.network.observations.point
        if not images:
            return {}
        at = self.places(images)
        ideal, found = lens.ideal_from_observed(self.xy_mm[at])
        freed_mm = np.empty_like(self.xy_mm)
        freed_mm[at] = np.where(found[:, None], ideal, self.xy_mm[at]) - lens.interior[1:]
        return {
            self.network.images[i].name: Sight(
                tuple(names[row] for row in self.rows[self.part(i)]),
                freed_mm[self.part(i)],
                float(lens.interior[0]),
                float(self.sigma_mm[i]),
            )
            for i in images
        }


def camera_frames(network: Network, transformation: Mapping[str, Array], mirrored: frozenset[str]) -> Frames:
    """Transform the object points of all images into the fiducial system.

    transformation: parameters of the film transformation by image name; mirrored: names of the mirrored scans.
    """
    observations, count = network.observations, len(network.images)
    names, number = observations.numbered_points
    rank = np.empty(len(names), dtype=np.intp)
    rank[np.argsort(np.array(names), kind="stable")] = np.arange(len(names))
    rows = np.flatnonzero(~observations.is_fiducial)
    rows = rows[np.lexsort((rank[number[rows]], network.image_numbers[rows]))]
    images = network.image_numbers[rows]
    starts = np.searchsorted(images, np.arange(count + 1))
    variances = np.trace(observations.covariance_mm2[rows], axis1=1, axis2=2) / 2.0
    xy_mm = network.straight_xy_mm[rows]
    for i, image in enumerate(network.images):
        if image.transformation != "none":
            part, kind = slice(starts[i], starts[i + 1]), film_kind(image.transformation, image.name in mirrored)
            xy_mm[part] = kind.apply(transformation[image.name], xy_mm[part])
    return Frames(network, rows, xy_mm, starts, np.sqrt(_medians(variances, images, starts)))


def _medians(values: Array, group: Indices, starts: Indices) -> Array:
    """Medians (g,) of values (n,) by group, the groups one after the other; 0 for an empty group."""
    if not len(values):
        return np.zeros(len(starts) - 1)
    ordered = values[np.lexsort((values, group))]
    counts = np.diff(starts)
    middle = np.minimum([starts[:-1] + (counts - 1) // 2, starts[:-1] + counts // 2], len(values) - 1)
    return np.asarray(np.where(counts > 0, ordered[middle].mean(axis=0), 0.0))
