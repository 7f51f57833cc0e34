"""Fiducial marks, given against estimated, as a figure that is free of the datum in which the camera stands."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup

from adjust.functional_model.transformation import Film, film_parameter_names
from adjust.problem.parameter import Parameter
from adjust.quality.fiducial_corrections import KEEPS_DISTANCES, corrections_to_given
from pipeline.drawing import svg
from pipeline.results.adjustment_record import CameraRecord, FiducialRecord
from pipeline.results.covariance_file import Covariance
from pipeline.types import Array

LONGEST_PX = 46.0
WIDTH_PX = 400.0
MARGIN_PX = 58.0


@dataclass(frozen=True)
class Distance:
    """Between two marks: mm, less the given one in um, and its whole standard deviation, the datum's scale included."""

    start: str
    end: str
    length_mm: float
    change_um: float
    sigma_um: float


@dataclass(frozen=True)
class Figure:
    """The camera, laid over its given fiducials by what its datum leaves open, and fits them best.

    ids (n); given_mm (n, 2); change_um (n, 2): what is left of estimated less given; covariance_um2 (2n, 2n) of all
    changes. distances: across, as estimated; none where films alone hold the figure and keep none. transformation: to
    the given places, after which these changes are left. interior_mm (3,): c, x0', y0' laid over along with the marks,
    interior_sigma_mm (3,); empty without an interior orientation.
    """

    ids: tuple[str, ...]
    given_mm: Array
    change_um: Array
    covariance_um2: Array
    distances: tuple[Distance, ...]
    transformation: str
    interior_mm: Array
    interior_sigma_mm: Array

    @property
    def of_marks_um2(self) -> Array:
        """(n, 2, 2) of each mark's change."""
        at = np.arange(len(self.ids))
        return self.covariance_um2.reshape(len(at), 2, len(at), 2)[at, :, at, :]


def _distances(ids: tuple[str, ...], places_mm: Array, given_mm: Array, covariance_mm2: Array) -> tuple[Distance, ...]:
    """From every mark to that which lies farthest from it; covariance_mm2 (2n, 2n): of the places, datum and all."""
    apart = np.linalg.norm(given_mm[:, None] - given_mm, axis=2)
    pairs = np.sort(np.stack([np.arange(len(apart)), apart.argmax(axis=1)], axis=1), axis=1)
    found = []
    for i, j in np.unique(pairs, axis=0).tolist():
        vector_mm = places_mm[j] - places_mm[i]
        length_mm = float(np.linalg.norm(vector_mm))
        by_places = np.zeros_like(places_mm)
        by_places[j], by_places[i] = vector_mm / length_mm, -vector_mm / length_mm
        variance_mm2 = max(float(by_places.ravel() @ covariance_mm2 @ by_places.ravel()), 0.0)
        change_um = 1e3 * (length_mm - float(apart[i, j]))
        found.append(Distance(ids[i], ids[j], length_mm, change_um, 1e3 * float(np.sqrt(variance_mm2))))
    return tuple(found)


def figure(name: str, camera: CameraRecord, covariance: Covariance) -> Figure | None:
    """A camera's entry of adjustment.json, free of its datum; None with fewer than three given fiducials.

    The datum that the fiducials stand in is itself uncertain, by a shift, a rotation and a scale that all of them and
    the interior orientation share. Values are laid over the given marks by a Helmert transformation, and the covariance
    by the S-transformation (Baarda 1973) C' = S C S' with S = I - G (G_f'G_f)^-1 G_f', G_f the rows of the marks.
    """
    ids, given, estimated = _marks(camera.fiducials)
    if len(ids) < 3:
        return None
    c, x0, y0 = (camera.interior[name].value for name in ("c", "x0", "y0"))
    turn_and_scale, shift = _helmert(estimated, given)
    interior = [Parameter.interior(name, each) for each in ("c", "x0", "y0")]
    s = _s_transformation(_similarities(estimated, c, (x0, y0)), 2 * len(ids))
    whole = covariance.of([*_places(name, ids), *interior])
    reduced = s @ whole @ s.T
    principal_point = turn_and_scale @ (x0, y0) + shift
    return Figure(
        ids=ids,
        given_mm=given,
        change_um=1e3 * (estimated @ turn_and_scale.T + shift - given),
        covariance_um2=1e6 * reduced[:-3, :-3],
        distances=_distances(ids, estimated, given, whole[:-3, :-3]),
        transformation="similarity",
        interior_mm=np.array([c * np.sqrt(np.linalg.det(turn_and_scale)), *principal_point]),
        interior_sigma_mm=np.sqrt(np.maximum(np.diag(reduced)[-3:], 0.0)),
    )


def figure_of_films(
    name: str, fiducials: Mapping[str, FiducialRecord], covariance: Covariance, films: Mapping[str, Film]
) -> Figure | None:
    """The same of a camera of which only fiducials were adjusted, with these films by image.

    Nothing but the films holds the marks' figure: its datum takes up all that each film can. None where that is more
    than the marks tell.
    """
    ids, given, estimated = _marks(fiducials)
    left = corrections_to_given(list(films.values()), estimated, given) if len(ids) else None
    if left is None:
        return None
    image, first = next(iter(films.items()))
    of_film = [Parameter.film(image, each) for each in film_parameter_names(first.transformation)]
    whole = covariance.of([*_places(name, ids), *of_film[: left.by_unknowns.shape[1] - 2 * len(ids)]])
    reduced = left.by_unknowns @ whole @ left.by_unknowns.T
    of_places = whole[: 2 * len(ids), : 2 * len(ids)]
    distances = _distances(ids, estimated, given, of_places) if left.transformation in KEEPS_DISTANCES else ()
    nothing = np.empty(0)
    changes = 1e3 * left.corrections_mm, 1e6 * reduced
    return Figure(ids, given, *changes, distances, left.transformation, nothing, nothing)


def figure_plot(change: Figure) -> Markup:
    """The given places, the change of each mark as a stroke, and the 95 % ellipse about its end."""
    radius, angles = svg.ellipse_axes(change.of_marks_um2)
    reach = np.hypot(*change.change_um.T) + radius.max(axis=1)
    px_per_um = svg.round_step(LONGEST_PX / float(reach.max())) if reach.max() > 0.0 else 1.0
    low, high = change.given_mm.min(axis=0), change.given_mm.max(axis=0)
    px_per_mm = (WIDTH_PX - 2.0 * MARGIN_PX) / float(max(high - low))
    height = float(high[1] - low[1]) * px_per_mm + 2.0 * MARGIN_PX
    places = MARGIN_PX + px_per_mm * np.stack([change.given_mm[:, 0] - low[0], high[1] - change.given_mm[:, 1]], axis=1)
    ends = places + px_per_um * change.change_um * (1.0, -1.0)
    corners = np.array([[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]])
    x_corner, y_corner = (MARGIN_PX + px_per_mm * np.stack([corners[:, 0] - low[0], high[1] - corners[:, 1]], axis=1)).T
    content = [
        svg.line(x_corner, y_corner, "frame", closed=True),
        *svg.ellipses(ends, px_per_um * radius, angles),
        svg.strokes(places, ends, "vector fiducial"),
        svg.strokes(places, places, "dot fiducial"),
        *(svg.words(x + 8.0, y + 16.0, id, "name") for id, (x, y) in zip(change.ids, places, strict=True)),
    ]
    um = svg.round_step(70.0 / px_per_um)
    x, y = MARGIN_PX, height + 8.0
    bar = svg.line(x + np.array([0, 0, 0, 1, 1, 1]) * um * px_per_um, y + np.array([-3, 3, 0, 0, -3, 3]), "bar")
    text = svg.words(
        x + um * px_per_um + 6.0,
        y + 4.0,
        f"{um:g} µm, drawn {1e3 * px_per_um / px_per_mm:,.0f} times too large",
        "tick",
    )
    return svg.picture(
        WIDTH_PX, height + 28.0, "Fiducial marks: change of form with 95 % ellipses", *content, bar, text
    )


def _marks(fiducials: Mapping[str, FiducialRecord]) -> tuple[tuple[str, ...], Array, Array]:
    """The ids of the given marks, where they are given and where they are estimated (n, 2)."""
    known = {id: (mark.given_mm, mark.xy_mm) for id, mark in fiducials.items() if mark.given_mm is not None}
    given, estimated = np.array(list(known.values()), dtype=float).reshape(-1, 2, 2).swapaxes(0, 1)
    return tuple(known), given, estimated


def _places(camera: str, ids: Iterable[str]) -> list[Parameter]:
    return [Parameter.fiducial(camera, id, axis) for id in ids for axis in "xy"]


def _helmert(source: Array, target: Array) -> tuple[Array, Array]:
    """Matrix (2, 2) of rotation and scale, and shift (2,), that lay the source points over the target points best."""
    z, w = source @ (1.0, 1.0j), target @ (1.0, 1.0j)
    centred = z - z.mean()
    factor = complex(np.vdot(centred, w) / np.vdot(centred, centred).real)
    matrix = np.array([[factor.real, -factor.imag], [factor.imag, factor.real]])
    return matrix, target.mean(axis=0) - matrix @ source.mean(axis=0)


def _s_transformation(motions: Array, marks: int) -> Array:
    """(m, m): takes motions (m, d) out, as the first rows, those of the marks, have them."""
    of_marks = motions.copy()
    of_marks[marks:] = 0.0
    return np.asarray(np.eye(len(motions)) - motions @ np.linalg.solve(of_marks.T @ of_marks, of_marks.T))


def _similarities(marks: Array, c: float, principal_point: tuple[float, float]) -> Array:
    """(2n + 3, 4): how marks, c, x0' and y0' change with their common shift, rotation and scale."""
    x, y = (np.vstack([marks, principal_point]) - marks.mean(axis=0)).T
    ones, zeros = np.ones(len(x)), np.zeros(len(x))
    moved = [(ones, zeros, 0.0), (zeros, ones, 0.0), (-y, x, 0.0), (x, y, c)]
    return np.stack([_ordered_changes(dx, dy, dc) for dx, dy, dc in moved], axis=1)


def _ordered_changes(dx: Array, dy: Array, dc: float) -> Array:
    """Changes of the marks and, last, of the principal point, in the order of the covariance."""
    changes = np.stack([dx, dy], axis=1)
    return np.concatenate([changes[:-1].ravel(), [dc], changes[-1]])
