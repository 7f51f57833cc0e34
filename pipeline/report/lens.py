"""The distortion of a camera as curves over the radius, with their standard deviations from the full covariance."""

from dataclasses import dataclass, replace

import numpy as np
from markupsafe import Markup

from adjust.functional_model.families import family, parameter_names
from adjust.functional_model.lens import Lens
from adjust.problem.parameter import Parameter
from pipeline.drawing import svg
from pipeline.results.adjustment_record import CameraRecord
from pipeline.results.covariance_file import Covariance
from pipeline.types import Array

RADII = 80
DIRECTIONS = 36
FRAME_GRID = 17
BAND = 1.959964  # sigmas to a probability of 95 %


@dataclass(frozen=True)
class Curves:
    """Over the radius (n,) in mm, in um.

    radial: the mean over all directions of the outward displacement; asymmetric: the largest displacement, over all
    directions, that is left when the radial part is taken out (decentering and affinity); each with its sigma.
    """

    radius_mm: Array
    radial_um: Array
    radial_sigma_um: Array
    asymmetric_um: Array
    asymmetric_sigma_um: Array


def lens(name: str, camera: CameraRecord, covariance: Covariance | None = None) -> Lens:
    """The lens of a camera of adjustment.json, with its covariance where that is known."""
    of = camera.lens()
    if covariance is None:
        return of
    return replace(of, covariance=covariance.of(Parameter.interior(name, each) for each in of.quantities))


def is_of_frame(of: Lens) -> bool:
    """Whether the family is defined over the frame, and not over the radius."""
    return family(of.distortion.family).needs == "half_mm"


def displacement_covariance(of: Lens) -> Array:
    """(1 + k, 1 + k) of c and the parameters, on which a displacement about the principal point depends."""
    return np.delete(np.delete(of.covariance, [1, 2], axis=0), [1, 2], axis=1)


def curves(of: Lens, largest_radius_mm: float) -> Curves:
    """The curves from the principal point out to a radius, or as far as the lens makes an image."""
    radius = np.linspace(0.0, largest_radius_mm, RADII)[1:]
    outward = _directions()
    imaged = of.displacement((radius[:, None, None] * outward).reshape(-1, 2)).imaged.reshape(len(radius), -1)
    radius = radius[np.logical_and.accumulate(imaged.all(axis=1))]
    moved = of.displacement((radius[:, None, None] * outward).reshape(-1, 2))
    value = moved.value_um.reshape(len(radius), DIRECTIONS, 2)
    by = moved.by_unknowns_um.reshape(len(radius), DIRECTIONS, 2, -1)
    cofactor = displacement_covariance(of)

    radial = np.einsum("rdi,di->r", value, outward) / DIRECTIONS
    radial_by = np.einsum("rdik,di->rk", by, outward) / DIRECTIONS
    rest = value - radial[:, None, None] * outward
    rest_by = by - radial_by[:, None, None, :] * outward[:, :, None]
    size = np.hypot(rest[..., 0], rest[..., 1])
    worst = size.argmax(axis=1)
    at = np.arange(len(radius))
    largest = size[at, worst]
    unit = rest[at, worst] / np.maximum(largest, 1e-12)[:, None]
    return Curves(
        radius_mm=radius,
        radial_um=radial,
        radial_sigma_um=_sigma(radial_by, cofactor),
        asymmetric_um=largest,
        asymmetric_sigma_um=_sigma(np.einsum("rik,ri->rk", rest_by[at, worst], unit), cofactor),
    )


def largest_effects_um(of: Lens, radius_mm: float) -> dict[str, float]:
    """By parameter: the largest displacement that a change of 1 of the parameter makes, at a radius.

    Of a family that is defined over the frame: anywhere in it, for beyond it a polynomial means nothing.
    """
    moved = of.displacement(_over_the_frame(of.distortion.half_mm) if is_of_frame(of) else radius_mm * _directions())
    sizes = np.hypot(moved.by_unknowns_um[:, 0, 1:], moved.by_unknowns_um[:, 1, 1:]).max(axis=0)
    return dict(zip(parameter_names(of.distortion.family), sizes.tolist(), strict=True))


def curves_plot(drawn: Curves, observed_radius_mm: float) -> Markup:
    """Both curves with their 95 % bands; grey beyond the outermost target, where nothing was observed."""
    band = BAND * drawn.radial_sigma_um
    has_asymmetric = bool(np.any(drawn.asymmetric_um > 1e-6))
    asymmetric_band = BAND * drawn.asymmetric_sigma_um
    low = float(np.min(drawn.radial_um - band, initial=0.0))
    high = float(np.max([*(drawn.radial_um + band), *(drawn.asymmetric_um + asymmetric_band), 0.0]))
    room = 0.06 * max(high - low, 1e-3)
    axes = svg.Axes((0.0, float(drawn.radius_mm[-1])), (low - room, high + room), height=320.0)
    x = axes.x(drawn.radius_mm)
    content = [
        _extrapolation(axes, observed_radius_mm),
        axes.drawn("radius from the principal point (mm)", "displacement (µm)"),
    ]
    if has_asymmetric:
        content.append(_band(x, axes, drawn.asymmetric_um, asymmetric_band, "band second"))
        content.append(svg.line(x, axes.y(drawn.asymmetric_um), "curve second"))
    content.append(_band(x, axes, drawn.radial_um, band, "band first"))
    content.append(_band(x, axes, drawn.radial_um, drawn.radial_sigma_um, "band first"))
    content.append(svg.line(x, axes.y(drawn.radial_um), "curve first"))
    return svg.picture(axes.width, axes.height, "Distortion over the radius with its 95 % band", *content)


def _over_the_frame(half_mm: tuple[float, float]) -> Array:
    """(n, 2) a grid over the frame, its edges included."""
    along = np.linspace(-1.0, 1.0, FRAME_GRID)
    x, y = np.meshgrid(half_mm[0] * along, half_mm[1] * along)
    return np.stack([x.ravel(), y.ravel()], axis=1)


def _directions() -> Array:
    angles = np.arange(DIRECTIONS) * (2.0 * np.pi / DIRECTIONS)
    return np.stack([np.cos(angles), np.sin(angles)], axis=1)


def _sigma(by: Array, cofactor: Array) -> Array:
    variance: Array = np.einsum("rk,kl,rl->r", by, cofactor, by)
    return np.sqrt(np.maximum(variance, 0.0))


def _band(x: Array, axes: svg.Axes, middle: Array, half: Array, class_: str) -> Markup:
    edge = np.concatenate([axes.y(middle + half), axes.y(middle - half)[::-1]])
    return svg.line(np.concatenate([x, x[::-1]]), edge, class_, closed=True)


def _extrapolation(axes: svg.Axes, observed_radius_mm: float) -> Markup:
    start, end = float(axes.x(min(observed_radius_mm, axes.x_range[1]))), axes.width - axes.right
    if end - start < 1.0:
        return Markup("")
    height = axes.height - axes.bottom - axes.top
    label = (
        svg.words(end - 6.0, axes.top + 14.0, "no targets here", "tick", "end") if end - start > 90.0 else Markup("")
    )
    return svg.tag("rect", x=start, y=axes.top, width=end - start, height=height, class_="beyond") + label
