"""Corrections of the fiducial coordinates to the given ones, after removal of the datum."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup

from adjust.functional_model.transformation import Film, film_parameter_names
from adjust.problem.parameter import Parameter
from adjust.quality.fiducial_corrections import KEEPS_DISTANCES, corrections_to_given
from pipeline.drawing import svg
from pipeline.results.adjustment_file import ParameterCovariance
from pipeline.results.adjustment_record import AdjustmentRecord, FiducialRecord
from pipeline.text.wording import listed
from pipeline.types import Array

LONGEST_PX = 46.0
VISIBLE_PX = 1.5  # smallest half axis of an ellipse that can be told from its centre
WIDTH_PX = 400.0
SIGNIFICANT = 3.0  # standard deviations of a coordinate
DATUM_UM = 100.0  # µm; coordinates with a larger given standard deviation only define the datum
LEAST_UM = 0.1  # µm, resolution of certificates; smaller corrections are ignored
MARGIN_PX = 58.0
BETTER = 2.0  # ratio of the standard deviations of coordinates and distances above which distances define the figure
_CALIBRATED = Film("similarity", np.array([0.0, 0.0, 1.0, 0.0]), np.zeros(2))  # datum of calibrated cameras
_MEASURED = Film("congruent", np.zeros(3), np.zeros(2))  # datum of fiducials with measured distances


@dataclass(frozen=True)
class MarkDistance:
    """Distance between two fiducials. change_um: estimated minus given; sigma_um includes the scale of the datum."""

    start: str
    end: str
    length_mm: float
    change_um: float
    sigma_um: float


@dataclass(frozen=True)
class Figure:
    """Estimated fiducials after a best-fit datum transformation to the given ones.

    Attributes
    ----------
    ids, given_mm : (n,) and (n, 2).
    change_um, covariance_um2 : (n, 2) estimated minus given after the transformation, and (2n, 2n) their covariance.
    distances : across the frame; empty if the film models, which alone define the datum, do not preserve distances.
    transformation : kind of the datum transformation.
    """

    ids: tuple[str, ...]
    given_mm: Array
    change_um: Array
    covariance_um2: Array
    distances: tuple[MarkDistance, ...]
    transformation: str

    @property
    def sigmas_um(self) -> Array:
        """(n, 2) standard deviations of the changes."""
        return np.sqrt(np.maximum(np.diag(self.covariance_um2), 0.0)).reshape(-1, 2)


def correction_sentence(form: Figure, fiducials: Mapping[str, FiducialRecord], given_by: str) -> str:
    """State the size of the corrections and which are significant.

    The limit is based on the larger of the standard deviations of the correction and of the given coordinate, the
    latter only if it does more than define the datum. given_by: source of the given coordinates.
    """
    size = np.hypot(*form.change_um.T)
    worst, rms = int(size.argmax()), float(np.sqrt(np.mean(form.change_um**2)))
    pairs = [(fiducials[id].x_mm.given, fiducials[id].y_mm.given) for id in form.ids]
    given_um = np.array([[1e3 * each.sigma if each is not None else 0.0 for each in pair] for pair in pairs])
    limit_um = SIGNIFICANT * np.maximum(form.sigmas_um, np.where(given_um < DATUM_UM, given_um, 0.0))
    excess_um = (np.abs(form.change_um) - np.maximum(limit_um, LEAST_UM)).max(axis=1)
    moved = [id for id, each in zip(form.ids, excess_um.tolist(), strict=True) if each > 0.0]
    taken = "shift, rotation and scale" if form.transformation == "none" else f"{form.transformation} transformation"
    found = (
        f"Corrections to {given_by}, after a common {taken}: {rms:.1f} µm rms of a coordinate, the largest "
        f"{size[worst]:.1f} µm (mark {form.ids[worst]})."
    )
    if not moved:
        return (
            f"{found} None exceeds {SIGNIFICANT:g} times its standard deviation, or the given one where that is larger."
        )
    names = f"mark {moved[0]} exceeds" if len(moved) == 1 else f"marks {listed(moved)} exceed"
    return (
        f"{found} Those of {names} {SIGNIFICANT:g} standard deviations: compare the camera file with {given_by}, and "
        "take the adjusted coordinates where the file is right."
    )


def figure(name: str, stored: AdjustmentRecord, covariance: ParameterCovariance) -> Figure | None:
    """Corrections of a camera's fiducials; None if the datum transformation absorbs all of them."""
    camera = stored.cameras[name]
    distance_sigmas = [row.sigma_mm for row in stored.fiducial_distances if row.camera == name]
    given = [each.given for mark in camera.fiducials.values() for each in (mark.x_mm, mark.y_mm)]
    known = [each.sigma for each in given if each is not None and np.isfinite(each.sigma)]  # NaN: free
    if distance_sigmas and BETTER * max(distance_sigmas) < min(known, default=np.inf):
        return figure_of_films(name, camera.fiducials, covariance, {}, _MEASURED)
    films = {} if camera.is_calibrated else stored.films(stored.camera_images(name))
    return figure_of_films(name, camera.fiducials, covariance, films)


def figure_of_films(
    name: str,
    fiducials: Mapping[str, FiducialRecord],
    covariance: ParameterCovariance,
    films: Mapping[str, Film],
    otherwise: Film = _CALIBRATED,
) -> Figure | None:
    """Corrections of fiducials whose datum only the film transformations define; None without given coordinates.

    Parameters
    ----------
    films : film transformations by image, of one kind. The datum transformation then absorbs all that they can.
    otherwise : film transformation of the kind of the datum transformation if films is empty.

    Notes
    -----
    The datum of calibrated fiducials is uncertain by a common shift, rotation and scale. The covariance is therefore
    that after an S-transformation (Baarda 1973) to the marks.
    """
    known = {id: (mark.given_mm, mark.xy_mm) for id, mark in fiducials.items() if mark.given_mm is not None}
    given, estimated = np.array(list(known.values()), dtype=float).reshape(-1, 2, 2).swapaxes(0, 1)
    left = corrections_to_given(next(iter(films.values()), otherwise), estimated, given) if known else None
    if left is None:
        return None
    unknowns = [Parameter.fiducial(name, id, axis) for id in known for axis in "xy"]
    count = len(unknowns)
    if films:
        image, first = next(iter(films.items()))
        unknowns += [Parameter.film(image, each) for each in film_parameter_names(first.transformation)]
    by_unknowns = left.by_unknowns[:, : len(unknowns)]
    whole = covariance.select(unknowns[: by_unknowns.shape[1]])
    keeps = not films or left.transformation in KEEPS_DISTANCES
    distances = _distances(tuple(known), estimated, given, whole[:count, :count]) if keeps else ()
    changes = 1e3 * left.corrections_mm, 1e6 * by_unknowns @ whole @ by_unknowns.T
    return Figure(tuple(known), given, *changes, distances, left.transformation)


def _distances(
    ids: tuple[str, ...], places_mm: Array, given_mm: Array, covariance_mm2: Array
) -> tuple[MarkDistance, ...]:
    """Distance from each mark to the farthest one. covariance_mm2: (2n, 2n) of the coordinates, datum included."""
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
        found.append(MarkDistance(ids[i], ids[j], length_mm, change_um, 1e3 * float(np.sqrt(variance_mm2))))
    return tuple(found)


def figure_plot(change: Figure) -> Markup:
    """Plot the given places, the change of each mark as a vector, and the 95 % ellipse around its end."""
    at = np.arange(len(change.ids))
    radius, angles = svg.ellipse_axes(change.covariance_um2.reshape(len(at), 2, len(at), 2)[at, :, at, :])
    reach = np.hypot(*change.change_um.T) + radius.max(axis=1)
    px_per_um = svg.round_step(LONGEST_PX / float(reach.max())) if reach.max() > 0.0 else 1.0
    low, high = change.given_mm.min(axis=0), change.given_mm.max(axis=0)
    px_per_mm = (WIDTH_PX - 2.0 * MARGIN_PX) / float(max(high - low))
    height = float(high[1] - low[1]) * px_per_mm + 2.0 * MARGIN_PX

    def page(xy_mm: Array) -> Array:
        return np.asarray(MARGIN_PX + px_per_mm * (xy_mm - (low[0], high[1])) * (1.0, -1.0))

    places = page(change.given_mm)
    ends = places + px_per_um * change.change_um * (1.0, -1.0)
    corners = page(np.array([[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]]))
    um = svg.round_step(70.0 / px_per_um)
    size = f"{um:g} µm, enlarged {1e3 * px_per_um / px_per_mm:,.0f} times"
    if px_per_um * radius.max() < VISIBLE_PX:
        size += "; ellipses too small"
    content = [
        svg.line(corners[:, 0], corners[:, 1], "frame", closed=True),
        *svg.ellipses(ends, px_per_um * radius, angles),
        svg.strokes(places, ends, "vector fiducial"),
        svg.strokes(places, places, "dot fiducial"),
        *(svg.words(x + 8.0, y + 16.0, id, "name") for id, (x, y) in zip(change.ids, places, strict=True)),
        svg.scale_bar(MARGIN_PX, height + 8.0, um * px_per_um, size),
    ]
    return svg.picture(WIDTH_PX, height + 28.0, "Fiducial marks: change of form with 95 % ellipses", *content)
