"""Map coordinates to longitude and latitude: UTM zones, and coordinates that are longitude and latitude already."""

import re

import numpy as np

from pipeline.errors import InputError
from pipeline.types import Array

# Semi-major axis in m and flattening. ETRS89 (GRS 80) and WGS 84 differ by less than a metre, and by plate motion.
_AXIS_M, _FLATTENING = 6378137.0, 1.0 / 298.257222101
_SCALE, _EASTING_M, _SOUTHERN_M = 0.9996, 500_000.0, 10_000_000.0
_DEGREES = ("EPSG:4326", "EPSG:4258")


def check_crs(crs: str) -> None:
    """Raise InputError for an unknown coordinate reference system."""
    if crs.upper() not in _DEGREES and _zone(crs) is None:
        raise InputError(
            f"crs {crs!r} is not known here. Known are UTM zones (EPSG:32601 to 32660, 32701 to 32760 of WGS 84, 25828 "
            f"to 25838 of ETRS89) and degrees of longitude and latitude ({', '.join(_DEGREES)}). Transform the points "
            "to one of them."
        )


def lon_lat(xy: Array, crs: str) -> Array:
    """Longitude and latitude (n, 2) in degrees from easting and northing (n, 2) in m, or from longitude and
    latitude."""
    check_crs(crs)
    zone = _zone(crs)
    return _from_utm(xy, *zone) if zone else xy


def _zone(crs: str) -> tuple[int, bool] | None:
    """Number of a UTM zone, and whether it is southern; None for other systems."""
    found = re.fullmatch(r"EPSG:(326|327|258)(\d\d)", crs.upper())
    if found is None:
        return None
    number = int(found[2])
    usable = 28 <= number <= 38 if found[1] == "258" else 1 <= number <= 60
    return (number, found[1] == "327") if usable else None


def _from_utm(xy: Array, zone: int, southern: bool) -> Array:
    """Longitude and latitude from UTM by Krueger's series in the third flattening, to n^4: exact to some micrometres
    within a zone.

    L. Krueger, Konforme Abbildung des Erdellipsoids in der Ebene (1912); C. F. F. Karney, Transverse Mercator with an
    accuracy of a few nanometers, J. Geodesy 85 (2011), equations 11, 14, 36.
    """
    n = _FLATTENING / (2.0 - _FLATTENING)
    radius = _AXIS_M / (1.0 + n) * (1.0 + n**2 / 4.0 + n**4 / 64.0)
    beta = (
        n / 2 - 2 * n**2 / 3 + 37 * n**3 / 96 - n**4 / 360,
        n**2 / 48 + n**3 / 15 - 437 * n**4 / 1440,
        17 * n**3 / 480 - 37 * n**4 / 840,
        4397 * n**4 / 161280,
    )
    north, east = xy[:, 1] - (_SOUTHERN_M if southern else 0.0), xy[:, 0] - _EASTING_M
    z = (north + 1j * east) / (_SCALE * radius)
    z = z - sum(b * np.sin(2 * k * z) for k, b in enumerate(beta, 1))
    xi, eta = z.real, z.imag
    lon = np.arctan2(np.sinh(eta), np.cos(xi))
    conformal = np.sin(xi) / np.hypot(np.sinh(eta), np.cos(xi))  # tan of the conformal latitude
    e = np.sqrt(_FLATTENING * (2.0 - _FLATTENING))
    tan = conformal / (1.0 - e**2)
    for _ in range(6):  # Newton's method for the geodetic latitude, by Karney's equations 19 to 21
        sigma = np.sinh(e * np.arctanh(e * tan / np.hypot(1.0, tan)))
        value = tan * np.hypot(1.0, sigma) - sigma * np.hypot(1.0, tan)
        step = (conformal - value) / np.hypot(1.0, value) * (1.0 + (1.0 - e**2) * tan**2)
        tan = tan + step / ((1.0 - e**2) * np.hypot(1.0, tan))
    return np.asarray(np.degrees(np.column_stack([lon, np.arctan(tan)])) + np.array([6.0 * zone - 183.0, 0.0]))
