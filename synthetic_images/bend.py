"""A scanner that bends its scans: how far it puts a point beside its place, in polynomials over the bed."""

import re
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.polynomial.legendre import legval2d
from numpy.typing import NDArray

Array = NDArray[np.float64]

HIGHEST = 6  # degree in x and in y
STEPS = 12  # of the inversion, each a thousandth of the one before


@dataclass(frozen=True)
class Bend:
    """terms_um: by name: the factor of P_m P_n in x is "a" with the degrees m in x and n in y, in y it is "b".

    size_mm: the bed is a square of this size, whose upper left corner is the origin of the comparator.
    """

    terms_um: Mapping[str, float]
    size_mm: float

    @property
    def center_mm(self) -> tuple[float, float]:
        return self.size_mm / 2, -self.size_mm / 2

    def displacement_mm(self, scan_mm: Array) -> Array:
        """(n, 2) scan less place of points whose coordinates in the scan (n, 2) are given."""
        across, up = ((scan_mm - self.center_mm) / (self.size_mm / 2)).T
        factors = np.zeros((2, HIGHEST + 1, HIGHEST + 1))
        for name, value in self.terms_um.items():
            factors["ab".index(name[0]), int(name[1]), int(name[2])] = value / 1000
        return np.stack([legval2d(across, up, one) for one in factors], axis=1)

    def scan_from_bed(self, bed_mm: Array) -> Array:
        """(n, 2) the coordinates that the scanner gives to places (n, 2) on its bed."""
        scan_mm = bed_mm
        for _ in range(STEPS):
            scan_mm = bed_mm + self.displacement_mm(scan_mm)
        return scan_mm

    def bed_from_scan(self, scan_mm: Array) -> Array:
        return np.asarray(scan_mm - self.displacement_mm(scan_mm))


def is_term(name: str) -> bool:
    return re.fullmatch(rf"[ab][0-{HIGHEST}][0-{HIGHEST}]", name) is not None
