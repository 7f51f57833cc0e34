"""Ring-coded targets: a dot in a ring that is divided into equal segments, one bit each."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from measure.array_types import Array
from measure.scans.scan import Scan
from measure.targets.block_search import TargetCandidate

_SAMPLES = 16  # along each segment
_RING_SHARES = (0.35, 0.5, 0.65)  # sampled positions across the ring, away from its blurred edges
_CORE = 0.4  # in radii of the dot: where the dot's grey value is sampled
_GAP_LEVEL = 0.35  # in contrasts of the dot: tolerance of the background in the gap
_LEAST_PLAIN = 0.97  # fraction of samples that must be within tolerance
_EDGE_SAMPLES = 4  # ignored at either end of a segment, for blur and perspective
_SURE = 0.3  # in contrasts of the dot: tolerance of a bit's grey value


@dataclass(frozen=True)
class RingCode:
    """Design of a ring code. bits: number of segments; ring: inner and outer radius in radii of the dot.

    The default is the common 12-bit code (Schneider, IDENT/VISION 1991): ring, gap and radius of the dot are equally
    wide. The number of a code is the smallest over all rotations of its segments.
    """

    bits: int = 12
    ring: tuple[float, float] = (2.0, 3.0)

    def __post_init__(self) -> None:
        if not 4 <= self.bits <= 24:
            raise ValueError(f"its bits are {self.bits}; 4 to 24 are right")
        if not 1.2 <= self.ring[0] < self.ring[1]:
            raise ValueError(f"its ring is {list(self.ring)} of the dot's radius; 1.2 or more, the inner one first")

    def number(self, segments: NDArray[np.bool_]) -> int:
        """Smallest number over all rotations of the segments (bits,), clockwise, most significant bit first."""
        weights = 1 << np.arange(self.bits)[::-1]
        return min(int(weights @ np.roll(segments, turn)) for turn in range(self.bits))

    def mirror(self, number: int) -> int:
        """Number of the mirror image of a code."""
        return self.least_turn(int(f"{number:0{self.bits}b}"[::-1], 2))

    def published_numbers(self) -> tuple[int, ...]:
        """Numbers of DE 197 33 466 A1, ascending: an even number of set bits, two of them opposite each other. Other
        numbers are read as well."""
        half, whole = self.bits // 2, 2**self.bits - 1
        published = []
        for number in range(1, whole, 2):
            turns = (number << turn & whole | number >> self.bits - turn for turn in range(1, self.bits))
            has_opposite_bits = number & number >> half & 2**half - 1
            if number.bit_count() % 2 == 0 and has_opposite_bits and all(number <= turned for turned in turns):
                published.append(number)
        return tuple(published)

    def least_turn(self, number: int) -> int:
        """Smallest number over all rotations of a number's bits."""
        return self.number(np.array([number >> bit & 1 for bit in range(self.bits)[::-1]], bool))


def read_code(scan: Scan, dot: TargetCandidate, code: RingCode) -> int | None:
    """Read the code in the ring around a dot.

    Returns
    -------
    The number; None where there is no ring of this code.

    Notes
    -----
    The ring is sampled along the enlarged ellipse of the dot: perspective changes both alike, to a few per cent. A
    segment is a set bit if it has the grey value of the dot (Schneider, IDENT/VISION 1991).
    """
    inner, outer = code.ring
    angles = 2.0 * np.pi * np.arange(code.bits * _SAMPLES) / (code.bits * _SAMPLES)
    gap_radius = (1.0 + inner) / 2.0
    radii = np.array([_CORE, gap_radius, *(inner + share * (outer - inner) for share in _RING_SHARES)])
    core, gap, *ring = _sample_rings(scan, dot, radii, angles)
    ground, contrast = float(np.median(gap)), float(np.median(core) - np.median(gap))
    if contrast * dot.contrast_dn <= 0.0 or np.mean(np.abs(gap - ground) < _GAP_LEVEL * abs(contrast)) < _LEAST_PLAIN:
        return None
    return _decode(((np.mean(ring, axis=0) - ground) / contrast), code)


def _sample_rings(scan: Scan, dot: TargetCandidate, radii: Array, angles: Array) -> Array:
    """(radii, angles) grey values on ellipses similar to the dot's, clockwise in the image."""
    axes = dot.pixel_from_disk
    if np.linalg.det(axes) < 0.0:
        axes = axes * np.array([1.0, -1.0])
    circle = np.stack([np.cos(angles), np.sin(angles)])
    places = dot.center_px + radii[:, None, None] * (axes @ circle).T
    corner = np.floor(places.min(axis=(0, 1))).astype(int) - 1
    width, height = np.ceil(places.max(axis=(0, 1))).astype(int) + 2 - corner
    window = scan.window(int(corner[0]), int(corner[1]), int(width), int(height))
    within = (places - corner).astype(np.float32)
    return np.asarray(cv2.remap(window, within[..., 0], within[..., 1], cv2.INTER_LINEAR), np.float64)


def _decode(levels: Array, code: RingCode) -> int | None:
    """Number of a ring with levels (bits * _SAMPLES,), 0: background, 1: dot. None where no phase of the segments makes
    each of them uniform, or where all are equal."""
    turned = np.stack([np.roll(levels, -phase).reshape(code.bits, _SAMPLES) for phase in range(_SAMPLES)])
    strays = np.minimum((turned > 0.5).sum(axis=2), (turned <= 0.5).sum(axis=2)).sum(axis=1)
    segments = turned[int(np.argmin(strays))]
    middles = segments[:, _EDGE_SAMPLES:-_EDGE_SAMPLES]
    set_bits = np.median(middles, axis=1) > 0.5
    sure = np.where(set_bits[:, None], middles > 1.0 - 1.5 * _SURE, middles < _SURE)
    if np.mean(sure) < _LEAST_PLAIN or set_bits.all() or not set_bits.any():
        return None
    return code.number(set_bits)
