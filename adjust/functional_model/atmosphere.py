"""Refraction of the lines of sight in the standard atmosphere.

ICAO standard atmosphere: temperature falls by 6.5 K/km up to 11 km and is constant above; heights above sea in m. Dry
air, refractivity by Edlén (1966) at 0.55 um; from 0.4 to 0.7 um it differs by less than 2 %.
"""

from dataclasses import dataclass

import numpy as np

from adjust.array_types import Array

SEA_LEVEL_K, SEA_LEVEL_HPA = 288.15, 1013.25
LAPSE_K_PER_M, TROPOPAUSE_M = 0.0065, 11000.0
GRAVITY_M_PER_S2, GAS_CONSTANT = 9.80665, 287.05287  # the latter of dry air, J/(kg K)
REFRACTIVITY_K_PER_HPA = 2.7782e-4 * SEA_LEVEL_K / SEA_LEVEL_HPA  # (n - 1) T / p
LEVEL_M = 1.0  # heights that differ by less count as equal


@dataclass(frozen=True)
class Bending:
    """By how much lines of sight bend: coefficient (n,) in 1/m, and its derivatives (n,) by both heights in 1/m²."""

    coefficient: Array
    by_station: Array
    by_point: Array


def bending(station_m: Array, point_m: Array) -> Bending:
    """How lines of sight bend between heights (n,) of stations and of points.

    A point at the slant distance s is seen higher by coefficient times s². With N = n - 1 at the station and the mean
    of N between both heights, the angle of refraction is K tan(nadir angle), K = mean - N (Schut, Photogrammetric
    refraction, 1969; Saastamoinen 1972), and the coefficient K over the difference of heights. The mean needs no
    quadrature: N is proportional to the density, whose integral is the difference of the pressures over gravity.
    """
    level = np.abs(station_m - point_m) < LEVEL_M
    difference = np.where(level, 1.0, station_m - point_m)
    (pressure, there, slope), (pressure_below, below, _) = _air(station_m), _air(point_m)
    weight = REFRACTIVITY_K_PER_HPA * GAS_CONSTANT / GRAVITY_M_PER_S2
    mean = weight * (pressure_below - pressure) / difference
    return Bending(
        np.where(level, -slope / 2.0, (mean - there) / difference),
        np.where(level, 0.0, (2.0 * (there - mean) / difference - slope) / difference),
        np.where(level, 0.0, (2.0 * mean - below - there) / difference**2),
    )


def _air(height_m: Array) -> tuple[Array, Array, Array]:
    """Pressure in hPa, N = n - 1 and its derivative by the height in 1/m."""
    below = height_m < TROPOPAUSE_M
    temperature = SEA_LEVEL_K - LAPSE_K_PER_M * np.minimum(height_m, TROPOPAUSE_M)
    exponent = GRAVITY_M_PER_S2 / (GAS_CONSTANT * LAPSE_K_PER_M)
    above_m = np.maximum(height_m - TROPOPAUSE_M, 0.0)
    pressure = SEA_LEVEL_HPA * (temperature / SEA_LEVEL_K) ** exponent
    pressure = pressure * np.exp(-GRAVITY_M_PER_S2 * above_m / (GAS_CONSTANT * temperature))
    refractivity = REFRACTIVITY_K_PER_HPA * pressure / temperature
    relative = (np.where(below, LAPSE_K_PER_M, 0.0) - GRAVITY_M_PER_S2 / GAS_CONSTANT) / temperature
    return pressure, refractivity, refractivity * relative
