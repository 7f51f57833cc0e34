"""Fiducial marks, given against estimated: in the camera's datum, and as a figure that is free of the datum."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray
from scipy import stats

from pipeline.adjustment_file import Covariance
from pipeline.report import svg
from pipeline.report.data import Json

Array = NDArray[np.float64]

LONGEST_PX = 46.0
WIDTH_PX = 400.0
MARGIN_PX = 58.0


@dataclass(frozen=True)
class Figure:
    """Estimated less given fiducials, less their own shift, rotation and scale: the figure's change of form.

    ids (n); given_mm (n, 2); change_um (n, 2); covariance_um2 (n, 2, 2) of each mark's change.
    """

    ids: tuple[str, ...]
    given_mm: Array
    change_um: Array
    covariance_um2: Array


def figure(camera: str, fiducials: Json, covariance: Covariance) -> Figure | None:
    """The change of form of a camera's fiducials; None with fewer than three, whose form has nothing to say.

    The datum that the fiducials stand in is itself uncertain, by a shift, a rotation and a scale that all of them
    share; the S-transformation (Baarda 1973), C' = S C S' with S = I - G (G'G)^-1 G', takes it out of values and
    covariance.
    """
    known = {id: fiducial for id, fiducial in fiducials.items() if _given(fiducial) is not None}
    if len(known) < 3:
        return None
    given = np.array([_given(fiducial) for fiducial in known.values()])
    estimated = np.array([(fiducial["x_mm"]["value"], fiducial["y_mm"]["value"]) for fiducial in known.values()])
    names = [f"FID.{camera}.{id}.{axis}" for id in known for axis in "xy"]
    s = _without_datum(given)
    reduced = 1e6 * s @ covariance.of(names) @ s.T
    blocks = reduced.reshape(len(known), 2, len(known), 2)
    at = np.arange(len(known))
    return Figure(tuple(known), given, 1e3 * (s @ (estimated - given).ravel()).reshape(-1, 2), blocks[at, :, at, :])


def figure_plot(change: Figure) -> Markup:
    """The given places, the change of each mark as a stroke, and the 95 % ellipse about its end."""
    axes, angles = _ellipse_axes(change.covariance_um2)
    radius = np.sqrt(stats.chi2.ppf(0.95, 2)) * axes
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
        *_ellipses(ends, px_per_um * radius, angles),
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


def _given(fiducial: Json) -> tuple[float, float] | None:
    x, y = fiducial["x_mm"].get("given"), fiducial["y_mm"].get("given")
    return None if x is None or y is None else (x["value"], y["value"])


def _without_datum(xy: Array) -> Array:
    """(2n, 2n) the projector that takes shift, rotation and scale out of changes of the points (n, 2)."""
    x, y = (xy - xy.mean(axis=0)).T
    ones, zeros = np.ones(len(xy)), np.zeros(len(xy))
    columns = [(ones, zeros), (zeros, ones), (-y, x), (x, y)]
    g = np.stack([np.stack(column, axis=1).ravel() for column in columns], axis=1)
    q, _ = np.linalg.qr(g)
    return np.asarray(np.eye(2 * len(xy)) - q @ q.T)


def _ellipse_axes(covariance: Array) -> tuple[Array, Array]:
    """Semi-axes (n, 2), the larger last, and its direction (n,), counter-clockwise from x in degrees."""
    variances, directions = np.linalg.eigh(covariance)
    return np.sqrt(np.maximum(variances, 0.0)), np.degrees(np.arctan2(directions[:, 1, 1], directions[:, 0, 1]))


def _ellipses(centers: Array, radii_px: Array, angles_deg: Array) -> Iterator[Markup]:
    for (x, y), (minor, major), angle in zip(centers, radii_px, angles_deg, strict=True):
        yield svg.tag(
            "ellipse",
            rx=float(major),
            ry=float(minor),
            transform=f"translate({x:.2f} {y:.2f}) rotate({-angle:.2f})",
            class_="ellipse",
        )
