"""Image coordinates in the fiducial system, of frames in one scan or in overlapping parts.

The parts are transformed one after the other into the comparator system of the first, by a similarity fitted to the
points in common with the parts placed so far. All fiducial marks of the frame then determine its film transformation,
as if it had been scanned at once. The film transformation of each part follows from it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from adjust.array_types import Array, Indices
from adjust.errors import AdjustmentError
from adjust.functional_model.lens import Lens
from adjust.functional_model.transformation import film_kind
from adjust.initial_values.fiducial_fit import LATTICE, fit_transformation
from adjust.initial_values.pose import Sight
from adjust.problem.network import Image, Network
from adjust.problem.observations import Observations


@dataclass(frozen=True, eq=False)
class Frames:
    """Object points of all images in the fiducial system, image by image, sorted by point name within each."""

    network: Network
    rows: Indices  # (n,) numbers of the observations
    xy_mm: Array  # (n, 2) image coordinates
    starts: Indices  # (images + 1,) index of the first point of each image; the last is n
    sigma_mm: Array  # (images,) median standard deviation of an image coordinate; 0 for an image without points

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
                tuple([names[row] for row in self.rows[self.part(i)].tolist()]),
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


Film = tuple[Array, bool]  # parameters, and whether the scan is mirrored
Mark = tuple[str, str]  # kind and point

FEWEST_COMMON = 3  # common points of two parts: a mirrored similarity fits two points as well


def joined_frame(network: Network, parts: Sequence[Image]) -> tuple[dict[str, Film], dict[str, Array]]:
    """Film transformations of the parts of one frame by name, and its joins (2,) in the fiducial system, mm, by point.

    Raises AdjustmentError if the parts have too few points in common, or the frame has too few fiducial marks.
    """
    marks_by_part = {part.name: _marks(network, part) for part in parts}
    first_from, place = _placed(parts[0].part_of, marks_by_part)
    given = network.camera_by_name[parts[0].camera].fiducials
    marks = sorted(point for kind, point in place if kind == "fiducial")
    camera_mm = np.array([[given[mark].x_mm.value, given[mark].y_mm.value] for mark in marks]).reshape(-1, 2)
    first_mm = np.array([place["fiducial", mark] for mark in marks]).reshape(-1, 2)
    kind = parts[0].transformation
    parameters, mirrored = fit_transformation(kind, first_mm, camera_mm)
    whole = film_kind(kind, mirrored)
    films = {}
    for part in parts:
        xy_mm = np.array(list(marks_by_part[part.name].values()))
        lattice = (xy_mm.min(axis=0) + xy_mm.max(axis=0)) / 2 + np.ptp(xy_mm, axis=0) / 2 * LATTICE
        turned, is_mirrored = first_from[part.name]
        in_first = film_kind("similarity", is_mirrored).apply(turned, lattice)
        films[part.name] = fit_transformation(kind, lattice, whole.apply(parameters, in_first))
    joins = [(point, xy) for (what, point), xy in place.items() if what == "join"]
    in_camera = whole.apply(parameters, np.array([xy for _, xy in joins]).reshape(-1, 2))
    return films, {point: xy for (point, _), xy in zip(joins, in_camera, strict=True)}


def _marks(network: Network, part: Image) -> dict[Mark, Array]:
    """Comparator coordinates of all marks of a part, sorted by kind and name."""
    rows = np.flatnonzero(network.image_numbers == network.images.index(part))
    observations = network.observations
    return {
        (observations.kind[row], observations.point[row]): network.straight_xy_mm[row]
        for row in sorted(rows, key=lambda row: (observations.kind[row], observations.point[row]))
    }


def _placed(frame: str, marks_by_part: Mapping[str, Mapping[Mark, Array]]) -> tuple[dict[str, Film], dict[Mark, Array]]:
    """Place the parts in the comparator system of the first; the part with most common points comes next."""
    # Returns the similarity of each part, and the coordinates (2,) of all marks in the system of the first.
    left = list(marks_by_part)
    films: dict[str, Film] = {left[0]: (np.array([0.0, 0.0, 1.0, 0.0]), False)}
    place = dict(marks_by_part[left.pop(0)])
    while left:
        name = max(left, key=lambda name: len(place.keys() & marks_by_part[name].keys()))
        own, common = marks_by_part[name], sorted(place.keys() & marks_by_part[name].keys())
        if len(common) < FEWEST_COMMON:
            raise AdjustmentError(
                f"frame {frame}: its scan {name} has {len(common)} points in common with {', '.join(films)}; joining "
                f"them takes {FEWEST_COMMON}, and more to be checked. Scan the frame in parts that overlap, measure "
                "crosses that both show, or leave the scan out."
            )
        in_part, in_first = (np.array([where[mark] for mark in common]) for where in (own, place))
        films[name] = fit_transformation("similarity", in_part, in_first)
        moved = film_kind("similarity", films[name][1]).apply(films[name][0], np.array(list(own.values())))
        place |= {mark: xy for mark, xy in zip(own, moved, strict=True) if mark not in place}
        left.remove(name)
    return films, place


def whole_frames(network: Network, films: Mapping[str, Film]) -> Network:
    """Reduce a network to whole frames, with each point measured once and in the fiducial system.

    The result holds the frames that show object points, without film transformations, join points and fiducial marks.
    """
    first: dict[str, Image] = {}
    for image in network.images:
        if image.name not in network.objectless_images:
            first.setdefault(image.frame, image)
    observations, xy_mm = network.observations, network.straight_xy_mm.copy()
    for i, image in enumerate(network.images):
        rows = network.image_numbers == i
        parameters, mirrored = films[image.name]
        xy_mm[rows] = film_kind(image.transformation, mirrored).apply(parameters, xy_mm[rows])
    frame_of = {image.name: image.frame for image in network.images}
    kept: dict[tuple[str, str], int] = {}
    for row in np.flatnonzero(~observations.is_fiducial):
        kept.setdefault((frame_of[observations.image[row]], observations.point[row]), int(row))
    rows = np.array(list(kept.values()), dtype=np.intp)
    return replace(
        network,
        images=tuple(Image(frame, image.camera, "none", image.exterior) for frame, image in first.items()),
        observations=Observations(
            tuple(frame for frame, _ in kept),
            tuple(point for _, point in kept),
            tuple(observations.kind[row] for row in rows),
            xy_mm[rows],
            observations.covariance_mm2[rows],
        ),
        distances=tuple(
            replace(each, start=frame_of.get(each.start, each.start), end=frame_of.get(each.end, each.end))
            for each in network.distances
        ),
        calibrations=(),
        scanners=(),
    )
