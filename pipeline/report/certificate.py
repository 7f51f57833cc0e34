"""A camera in the form of a calibration certificate: principal distances, and a table of radial distortion by angle."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from adjust.functional_model.lens import Lens
from pipeline.report.lens import curves, displacement_covariance
from pipeline.report.numbers import fixed, value_and_sigma
from pipeline.types import Array

# Of the U.S. Geological Survey's reports, as far as the frame reaches.
ANGLES_DEG = (7.5, 15.0, 22.7, 30.0, 35.0, 40.0)
_FEWEST_ANGLES = 5  # from which the principal distance and three powers come back, with one value over
_RADII, _DIRECTIONS = 240, 36
_NEAR_AXIS = 1e-3  # of the largest radius: there the distortion is linear in it
_STEP_SIGMAS = 0.1  # of the numerical derivatives


@dataclass(frozen=True)
class CertificateRow:
    """The distortion at an angle from the axis, positive outwards, each value with its sigma, ready to print."""

    angle_deg: str
    radius_mm: str
    radial: tuple[str, str]
    asymmetric: tuple[str, str]


@dataclass(frozen=True)
class CertificateView:
    """calibrated: the principal distance that makes the largest and the least radial distortion equal, to which the
    rows refer; equivalent: that near the axis. reach_mm: the radius out to which it is balanced."""

    calibrated: tuple[str, str]
    equivalent: tuple[str, str]
    reach_mm: str
    rows: list[CertificateRow]


def certificate_view(of: Lens, largest_radius_mm: float) -> CertificateView:
    """Of a lens, out to a radius, with standard deviations from the full covariance."""
    angles = _angles_deg(of, largest_radius_mm)
    values, sigmas = _propagate(of, lambda moved: _quantities(moved, angles, largest_radius_mm))
    radii = np.interp(np.tan(np.radians(angles)), *_tangents(of, largest_radius_mm)[::-1])
    asymmetric = curves(of, largest_radius_mm)
    rows = [
        CertificateRow(
            fixed(angle, 1),
            fixed(float(radius), 1),
            value_and_sigma(1000.0 * float(value), 1000.0 * float(sigma)),
            value_and_sigma(
                float(np.interp(radius, asymmetric.radius_mm, asymmetric.asymmetric_um)),
                float(np.interp(radius, asymmetric.radius_mm, asymmetric.asymmetric_sigma_um)),
            ),
        )
        for angle, radius, value, sigma in zip(angles, radii, values[2:], sigmas[2:], strict=True)
    ]
    calibrated, equivalent = (value_and_sigma(float(values[i]), float(sigmas[i])) for i in (0, 1))
    return CertificateView(calibrated, equivalent, fixed(largest_radius_mm, 0), rows)


def _angles_deg(of: Lens, largest_radius_mm: float) -> list[float]:
    """Those of the reports that the frame shows; of a narrower camera six steps, to the tenths that are printed."""
    largest = float(np.degrees(np.arctan(_tangents(of, largest_radius_mm)[1][-1])))
    usual = [angle for angle in ANGLES_DEG if angle <= largest]
    if len(usual) >= _FEWEST_ANGLES:
        return usual
    return [float(angle) for angle in np.floor(10.0 * np.linspace(0.0, largest, len(ANGLES_DEG) + 1)[1:]) / 10.0]


def _quantities(of: Lens, angles_deg: list[float], largest_radius_mm: float) -> Array:
    """The calibrated and the equivalent principal distance, and the distortion at angles, mm."""
    radius, tangent = _tangents(of, largest_radius_mm)
    near, near_tangent = _tangents(of, _NEAR_AXIS * largest_radius_mm)
    calibrated = _balanced_mm(radius, tangent)
    at = np.tan(np.radians(angles_deg))
    distortion = np.interp(at, tangent, radius - calibrated * tangent)
    return np.array([calibrated, near[-1] / near_tangent[-1], *distortion])


def _balanced_mm(radius: Array, tangent: Array) -> float:
    """The principal distance by which the largest and the least distortion are of one size: it lies where the two of
    one pair of radii are, and pairs are exchanged until they are the extremes."""
    distance = float(radius[-1] / tangent[-1])
    for _ in range(50):
        distortion = radius - distance * tangent
        high, low = int(distortion.argmax()), int(distortion.argmin())
        better = float((radius[high] + radius[low]) / (tangent[high] + tangent[low])) if high or low else distance
        if abs(better - distance) < 1e-12 * distance:
            break
        distance = better
    return distance


def _tangents(of: Lens, largest_radius_mm: float) -> tuple[Array, Array]:
    """Radii (n,) of observed points about the principal point, the axis first, and the tangents (n,) of their rays'
    angles, the mean over all directions."""
    radius = np.linspace(0.0, largest_radius_mm, _RADII)
    turns = 2.0 * np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS
    outward = np.column_stack([np.cos(turns), np.sin(turns)])
    point = of.interior[1:]
    places = point + (radius[:, None, None] * outward).reshape(-1, 2)
    ideal, _ = of.ideal_from_observed(places)
    along = ((ideal - point).reshape(_RADII, _DIRECTIONS, 2) * outward).sum(axis=2).mean(axis=1)
    return radius, np.asarray(along / of.interior[0])


def _propagate(of: Lens, quantities: Callable[[Lens], Array]) -> tuple[Array, Array]:
    """Quantities (n,) of a lens and their standard deviations, by central differences."""
    cofactor = displacement_covariance(of)
    columns = []
    for number, sigma in enumerate(np.sqrt(np.maximum(np.diag(cofactor), 0.0)).tolist()):
        step = _STEP_SIGMAS * sigma
        sides = [quantities(_changed_lens(of, number, sign * step)) for sign in (1.0, -1.0)] if step > 0.0 else None
        columns.append(np.zeros_like(quantities(of)) if sides is None else (sides[0] - sides[1]) / (2.0 * step))
    by = np.column_stack(columns)
    return quantities(of), np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", by, cofactor, by), 0.0))


def _changed_lens(of: Lens, number: int, step: float) -> Lens:
    """c is the first of the unknowns."""
    values = of.values
    values[number + 2 if number else 0] += step
    return of.replaced_values(values)
