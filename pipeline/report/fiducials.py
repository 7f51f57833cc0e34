"""Fiducial marks, given against estimated, as a figure that is free of the datum in which the camera stands."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray
from scipy.special import chdtri

from pipeline.report import svg
from pipeline.report.data import Json
from pipeline.results.adjustment_reader import Covariance

Array = NDArray[np.float64]

LONGEST_PX = 46.0
WIDTH_PX = 400.0
MARGIN_PX = 58.0


@dataclass(frozen=True)
class Figure:
    """The camera, laid over its given fiducials by the shift, rotation and scale that fit them best.

    ids (n); given_mm (n, 2); change_um (n, 2): what is left of estimated less given; covariance_um2 (n, 2, 2) of each
    mark's change. interior_mm (3,): c, x0', y0' laid over along with the marks, interior_sigma_mm (3,).
    """

    ids: tuple[str, ...]
    given_mm: Array
    change_um: Array
    covariance_um2: Array
    interior_mm: Array
    interior_sigma_mm: Array


def figure(name: str, camera: Json, covariance: Covariance) -> Figure | None:
    """A camera's entry of adjustment.json, free of its datum; None with fewer than three given fiducials.

    The datum that the fiducials stand in is itself uncertain, by a shift, a rotation and a scale that all of them and
    the interior orientation share. Values are laid over the given marks by a Helmert transformation, and the covariance
    by the S-transformation (Baarda 1973) C' = S C S' with S = I - G (G_f'G_f)^-1 G_f', G_f the rows of the marks.
    """
    known = {id: fiducial for id, fiducial in camera["fiducials"].items() if _given(fiducial) is not None}
    if len(known) < 3:
        return None
    count = 2 * len(known)
    point = camera["principal_point_mm"]
    c, x0, y0 = (q["value"] for q in (camera["principal_distance_mm"], point["x"], point["y"]))
    given = np.array([_given(fiducial) for fiducial in known.values()])
    estimated = np.array([(fiducial["x_mm"]["value"], fiducial["y_mm"]["value"]) for fiducial in known.values()])
    turn_and_scale, shift = _helmert(estimated, given)

    marks = [f"FID.{name}.{id}.{axis}" for id in known for axis in "xy"]
    s = _s_transformation(estimated, c, (x0, y0))
    reduced = s @ covariance.of([*marks, *(f"IO.{name}.{each}" for each in ("c", "x0", "y0"))]) @ s.T
    blocks = reduced[:count, :count].reshape(len(known), 2, len(known), 2)
    at = np.arange(len(known))
    principal_point = turn_and_scale @ (x0, y0) + shift
    return Figure(
        ids=tuple(known),
        given_mm=given,
        change_um=1e3 * (estimated @ turn_and_scale.T + shift - given),
        covariance_um2=1e6 * blocks[at, :, at, :],
        interior_mm=np.array([c * np.sqrt(np.linalg.det(turn_and_scale)), *principal_point]),
        interior_sigma_mm=np.sqrt(np.maximum(np.diag(reduced)[count:], 0.0)),
    )


def figure_plot(change: Figure) -> Markup:
    """The given places, the change of each mark as a stroke, and the 95 % ellipse about its end."""
    axes, angles = ellipse_axes(change.covariance_um2)
    radius = np.sqrt(chdtri(2, 0.05)) * axes
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
        *ellipses(ends, px_per_um * radius, angles),
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


def _helmert(source: Array, target: Array) -> tuple[Array, Array]:
    """Matrix (2, 2) of rotation and scale, and shift (2,), that lay the source points over the target points best."""
    z, w = source @ (1.0, 1.0j), target @ (1.0, 1.0j)
    centred = z - z.mean()
    factor = complex(np.vdot(centred, w) / np.vdot(centred, centred).real)
    matrix = np.array([[factor.real, -factor.imag], [factor.imag, factor.real]])
    return matrix, target.mean(axis=0) - matrix @ source.mean(axis=0)


def _s_transformation(marks: Array, c: float, principal_point: tuple[float, float]) -> Array:
    """(2n + 3, 2n + 3): takes the marks' common shift, rotation and scale out of marks, c, x0' and y0'."""
    center = marks.mean(axis=0)
    x, y = (np.vstack([marks, principal_point]) - center).T
    ones, zeros = np.ones(len(x)), np.zeros(len(x))
    moved = [(ones, zeros, 0.0), (zeros, ones, 0.0), (-y, x, 0.0), (x, y, c)]
    g = np.stack([_in_order(dx, dy, dc) for dx, dy, dc in moved], axis=1)
    of_marks = g.copy()
    of_marks[2 * len(marks) :] = 0.0
    return np.asarray(np.eye(len(g)) - g @ np.linalg.solve(of_marks.T @ of_marks, of_marks.T))


def _in_order(dx: Array, dy: Array, dc: float) -> Array:
    """Changes of the marks and, last, of the principal point, in the order of the covariance."""
    changes = np.stack([dx, dy], axis=1)
    return np.concatenate([changes[:-1].ravel(), [dc], changes[-1]])


def ellipse_axes(covariance: Array) -> tuple[Array, Array]:
    """Semi-axes (n, 2), the larger last, and its direction (n,), counter-clockwise from x in degrees."""
    variances, directions = np.linalg.eigh(covariance)
    return np.sqrt(np.maximum(variances, 0.0)), np.degrees(np.arctan2(directions[:, 1, 1], directions[:, 0, 1]))


def ellipses(centers: Array, radii_px: Array, angles_deg: Array) -> Iterator[Markup]:
    for (x, y), (minor, major), angle in zip(centers, radii_px, angles_deg, strict=True):
        yield svg.tag(
            "ellipse",
            rx=float(major),
            ry=float(minor),
            transform=f"translate({x:.2f} {y:.2f}) rotate({-angle:.2f})",
            class_="ellipse",
        )
