"""Cause and remedy for undetermined images and points, and for unnamed null directions."""

from collections.abc import Mapping, Sequence

import numpy as np

from adjust.array_types import Array
from adjust.problem.network import Image
from adjust.problem.parameter import Parameter
from adjust.problem.problem import Problem, State

IN_LINE = 1e-3  # width over length of collinear marks, and base over distance of coincident stations
SHOWN = 3  # names listed one by one

# Cause and remedy by the kind of the unknown that moves most.
UNNAMED: Mapping[str, tuple[str, str]] = {
    "exterior": (
        "The exterior orientation of image {owner} can change ({quantity} most){followers}: too few known points, or "
        "rays from other stations, hold it.",
        "Measure known points in this image, take images from other stations that share its points, or give its "
        "orientation with standard deviations in images.csv.",
    ),
    "point": (
        "The object point {id} can move ({quantity} most){followers}.",
        "Measure it in more images, give its coordinates with standard deviations, or leave it out.",
    ),
    "fiducial": (
        "The fiducial mark {id} of camera {owner} can move ({quantity} most){followers}.",
        "Give it a standard deviation (F5, F6), or measure it in more images.",
    ),
    "film": (
        "The film transformation of image {owner} can change ({quantity} most){followers}.",
        "Measure more fiducial marks in this image, or choose a transformation with fewer parameters.",
    ),
    "join": (
        "Point {id}, which joins the scans of frame {owner}, can move ({quantity} most){followers}.",
        "Measure more points that both scans show, spread over their overlap.",
    ),
    "scanner": (
        "The term {quantity} of the bend of scanner {owner} can change{followers}.",
        "Give {quantity} a standard deviation, or leave it out.",
    ),
    "board": (
        "The {quantity} of board {owner} can change{followers}: no image sees the board at a slant.",
        "Take images that are tilted against the board, or give its bend a standard deviation.",
    ),
    "interior": (
        "The quantity {quantity} of camera {owner} can change{followers}.",
        "Give {quantity} a standard deviation, or fix it.",
    ),
}


def unnamed_sentence(most: Parameter, followers: str) -> tuple[str, str]:
    """Cause and remedy of an unnamed direction, by the unknown that moves most."""
    words = most._asdict() | {"followers": followers}
    cause, remedy = UNNAMED[most.kind]
    return cause.format(**words), remedy.format(**words)


def many_sentence(count: int, followers: str) -> tuple[str, str]:
    """Cause and remedy of many unnamed directions."""
    return (
        f"The network can drift and bend in {count} ways{followers}: what is known of the object is too little for it, "
        "or too far apart.",
        "Measure known points all over the network, those of a long strip every few images, or give stations with "
        "standard deviations in images.csv. The standard deviations tell how far it may have drifted.",
    )


def own_sentence(problem: Problem, state: State, parameter: Parameter) -> tuple[str, str]:
    """Cause and remedy of an undetermined image or point; parameter: one of its unknowns."""
    if parameter.kind == "point":
        return _point_sentence(problem, state, parameter.id)
    parts = _parts(problem, parameter.owner)
    return _parts_sentence(problem, parts) if parts else _image_sentence(problem, parameter.owner)


def _parts(problem: Problem, frame: str) -> list[Image]:
    """Scans of a frame that was scanned in parts; frame: its name or that of one of its scans."""
    image = problem.network.image_by_name.get(frame)
    frame = image.part_of if image is not None else frame
    return [image for image in problem.network.images if image.part_of and image.part_of == frame]


def _parts_sentence(problem: Problem, parts: Sequence[Image]) -> tuple[str, str]:
    common = sum(frame == parts[0].part_of for frame, _ in problem.network.joins)
    return (
        f"The marks of frame {parts[0].part_of} do not determine its orientation and the transformations of its scans "
        f"{_listed([part.name for part in parts])}, which {common} points join.",
        "Measure more fiducial marks and more common points, spread over what the scans have in common, choose a "
        "transformation with fewer parameters, or leave the frame out.",
    )


def _point_sentence(problem: Problem, state: State, point: str) -> tuple[str, str]:
    position = problem.unknowns.point[point][0]
    numbers = problem.image_numbers[(problem.places[:, 0] == position) & ~problem.is_fiducial]
    images = _listed([problem.network.images[i].name for i in numbers])
    stations = state.values[problem.exterior[numbers, :3]]
    distances = np.linalg.norm(stations - state.values[problem.unknowns.point[point]], axis=1)
    apart = np.linalg.norm(stations - stations[0], axis=1).max()
    where = "from another station"
    if len(numbers) == 1:
        cause = f"Only image {images} shows point {point}: one ray does not tell where on it the point lies."
    elif apart <= IN_LINE * distances.max():
        cause = f"The images that show point {point} ({images}) were taken from one station: their rays are one ray."
    else:
        cause = (
            f"Point {point} lies in line with the stations of the images that show it ({images}): their rays are one "
            "ray."
        )
        where = "from a station off that line"
    return cause, f"Measure it in an image {where}, give its coordinates, or leave it out."


def _image_sentence(problem: Problem, image: str) -> tuple[str, str]:
    xy_mm = problem.network.observations.xy_mm
    own = np.array(problem.network.observations.image) == image
    why = [
        f"all its {what} lie on one line"
        for what, rows in (("targets", own & ~problem.is_fiducial), ("fiducial marks", own & problem.is_fiducial))
        if rows.any() and _are_collinear(xy_mm[rows])
    ]
    cause = f"The marks of image {image} do not determine its own orientation and transformation"
    where = "off that line" if why else "spread over the frame"
    return (
        f"{cause}{': ' if why else ''}{' and '.join(why)}.",
        f"Measure more marks in this image, {where}, give its orientation in images.csv, or leave the image out.",
    )


def _are_collinear(xy_mm: Array) -> bool:
    extents = np.linalg.svd(xy_mm - xy_mm.mean(axis=0), compute_uv=False)
    return len(extents) < 2 or bool(extents[-1] <= IN_LINE * extents[0])


def _listed(names: Sequence[str]) -> str:
    more = len(names) - SHOWN
    return ", ".join(names[:SHOWN]) + (f" and {more} more" if more > 0 else "")
