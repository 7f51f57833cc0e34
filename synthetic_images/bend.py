"""Geometric error of a scanner: displacement of points, as Legendre polynomials over the bed."""

import re
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.polynomial.legendre import legval2d
from numpy.typing import NDArray

Array = NDArray[np.float64]

HIGHEST = 6  # highest degree in x and in y
STEPS = 12  # iterations of the inversion; each reduces the error by a factor of about a thousand


@dataclass(frozen=True)
class ScannerBend:
    """Geometric error of a scanner.

    Attributes
    ----------
    terms_um : coefficients of the Legendre products P_m(x) P_n(y) by name: "amn" for the displacement in x, "bmn" in y.
    size_mm : side of the square bed, whose upper left corner is the origin of the comparator.
    """

    terms_um: Mapping[str, float]
    size_mm: float

    @property
    def center_mm(self) -> tuple[float, float]:
        return self.size_mm / 2, -self.size_mm / 2

    def displacement_mm(self, scan_mm: Array) -> Array:
        """(n, 2) displacement, scan minus bed, at scan coordinates (n, 2)."""
        across, up = ((scan_mm - self.center_mm) / (self.size_mm / 2)).T
        factors = np.zeros((2, HIGHEST + 1, HIGHEST + 1))
        for name, value in self.terms_um.items():
            factors["ab".index(name[0]), int(name[1]), int(name[2])] = value / 1000
        return np.stack([legval2d(across, up, one) for one in factors], axis=1)

    def scan_from_bed(self, bed_mm: Array) -> Array:
        """Convert places (n, 2) on the bed to scan coordinates (n, 2)."""
        scan_mm = bed_mm
        for _ in range(STEPS):
            scan_mm = bed_mm + self.displacement_mm(scan_mm)
        return scan_mm

    def bed_from_scan(self, scan_mm: Array) -> Array:
        return np.asarray(scan_mm - self.displacement_mm(scan_mm))


def is_term(name: str) -> bool:
    return re.fullmatch(rf"[ab][0-{HIGHEST}][0-{HIGHEST}]", name) is not None
