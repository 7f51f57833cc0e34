"""Transformation from camera coordinates to pixels of the scan, and the pixel grid of the resampled frame."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from math import ceil, floor

import numpy as np
from scipy.interpolate import make_interp_spline

from adjust.functional_model.families import family
from adjust.functional_model.lens import Lens
from adjust.functional_model.scanner import NO_BEND, Bend
from adjust.functional_model.transformation import Film, film_parameter_names
from measure.errors import MeasurementError
from measure.geometry import Affine
from measure.scans.remote import Window
from pipeline.adjusting.picture_turn import NOT_TURNED, Turn, turned_back, turned_forth
from pipeline.results.adjustment_record import AdjustmentRecord
from pipeline.results.comparator_file import comparator_from_pixel, pixel_from_comparator
from pipeline.results.measured_record import MeasuredScan
from pipeline.types import Array, Mask

_WIDEST = 2.0  # half width of a fisheye's ideal image, in principal distances
_EDGE_POINTS = 65  # points per side of the scan's outline
_NODES_PX = 16  # px between the nodes at which the chain is evaluated; cubic interpolation between them
_BEYOND = 3  # nodes beyond each side of a tile, for the interpolation


@dataclass(frozen=True)
class FrameChain:
    """Transformations from the scan to the camera's frame, in this order: pitch, turn, scanner bend, film, lens.

    lens None: the frame keeps the lens distortion. turn: of a digital picture.
    """

    pitch_um: tuple[float, float]
    film: Film
    bend: Bend = NO_BEND
    bend_parameters: Array = field(default_factory=lambda: np.empty(0))
    lens: Lens | None = None
    turn: Turn = NOT_TURNED

    def scan_from_frame(self, xy_mm: Array) -> tuple[Array, Mask]:
        """Pixels (n, 2), column and row, of camera coordinates (n, 2) in mm; mask of the places that have an image."""
        observed, is_imaged = xy_mm, np.ones(len(xy_mm), dtype=bool)
        if self.lens is not None:
            ray = (xy_mm - self.lens.interior[1:]) / self.lens.interior[0]
            observed, is_imaged = self.lens.camera_from_ray(ray)
        comparator, on_film = self.film.comparator_from_camera(observed)
        place, on_glass = self.bend.inverse(self.bend_parameters, comparator)
        return pixel_from_comparator(turned_forth(place, *self.turn), self.pitch_um), is_imaged & on_film & on_glass

    def frame_from_scan(self, col_row: Array) -> tuple[Array, Mask]:
        """Camera coordinates (n, 2) in mm of pixels (n, 2); mask of the pixels for which the lens can be inverted."""
        sensor = turned_back(comparator_from_pixel(col_row, self.pitch_um), *self.turn)
        comparator = self.bend.apply(self.bend_parameters, sensor)
        observed = self.film.camera_from_comparator(comparator)
        if self.lens is None:
            return observed, np.ones(len(observed), dtype=bool)
        return self.lens.ideal_from_observed(observed)


def image_chain(
    name: str, adjustment: AdjustmentRecord, pitch_um: tuple[float, float], middle_mm: Array, with_lens: bool
) -> FrameChain:
    """Chain of an image from an adjustment record. middle_mm (2,): a place near the centre of the image, in the
    comparator."""
    image = adjustment.images[name]
    scanner = adjustment.scanners.get(image.scanner)
    bend = (NO_BEND, np.empty(0)) if scanner is None else scanner.bend()
    lens = adjustment.cameras[adjustment.image_camera(name)].lens() if with_lens else None
    return FrameChain(pitch_um, image.transformation.film(middle_mm), *bend, lens)


def measured_chain(measured: MeasuredScan, taking_lens: Lens | None = None) -> FrameChain | None:
    """Chain from the fiducials of a scan alone; None where too few were found. taking_lens: of the camera that
    photographed the film."""
    matrix = measured.frame.pixel_from_camera
    if matrix is None:
        return None
    back = Affine(comparator_from_pixel(matrix.T, measured.pitch_um).T).inverse
    known = dict(zip(("a2", "a3", "a1", "b2", "b3", "b1"), back.matrix.ravel().tolist(), strict=True))
    parameters = np.array([known[name] for name in film_parameter_names("affine")])
    return FrameChain(measured.pitch_um, Film("affine", parameters, middle_mm(measured)), Bend(lens=taking_lens))


def middle_mm(measured: MeasuredScan) -> Array:
    """(2,) centre of a scan in the comparator."""
    middle_px = np.array([measured.width_px - 1, measured.height_px - 1]) / 2.0
    return comparator_from_pixel(middle_px, measured.pitch_um)


@dataclass(frozen=True)
class Canvas:
    """Pixel grid of a resampled frame.

    x_mm, y_mm: camera coordinates of the centre of the first pixel; col = (x' - x_mm) / pitch_mm, row = (y_mm - y') /
    pitch_mm.
    """

    x_mm: float
    y_mm: float
    pitch_mm: float
    width_px: int
    height_px: int

    def camera_from_pixel(self, pixels: Array) -> Array:
        """Camera coordinates (..., 2) of columns and rows (..., 2)."""
        return np.asarray((self.x_mm, self.y_mm) + pixels * (self.pitch_mm, -self.pitch_mm))

    def pixel_from_camera(self, places_mm: Array) -> Array:
        """Columns and rows (..., 2) of camera coordinates (..., 2)."""
        return np.asarray((places_mm - np.array([self.x_mm, self.y_mm])) / (self.pitch_mm, -self.pitch_mm))

    def camera_mm(self, col: Array, row: Array) -> Array:
        """Camera coordinates (rows, cols, 2) of columns (cols,) and rows (rows,)."""
        return self.camera_from_pixel(np.stack(np.meshgrid(col, row), axis=-1))


def outline_canvas(scans: Sequence[tuple[FrameChain, Window]], pitch_mm: float) -> Canvas:
    """Canvas that contains the outlines of windows of scans. Pixels lie at whole multiples of the pitch.

    The ideal image of a fisheye is unbounded: it is cut off where it would be stretched by a factor of five (63
    degrees).

    Raises MeasurementError where the lens or the film folds within the scan, or a value of theirs is missing.
    """
    outline = np.concatenate([_outline_mm(*scan) for scan in scans])
    if not np.isfinite(outline).all():
        raise MeasurementError(
            "a value of its film transformation or of its camera is missing in adjustment.json; adjust again"
        )
    (left, bottom), (right, top) = outline.min(axis=0) / pitch_mm, outline.max(axis=0) / pitch_mm
    first, last = (ceil(left), floor(top)), (floor(right), ceil(bottom))
    return Canvas(first[0] * pitch_mm, first[1] * pitch_mm, pitch_mm, last[0] - first[0] + 1, first[1] - last[1] + 1)


def _outline_mm(chain: FrameChain, window: Window) -> Array:
    """(n, 2) places along a window's edge in the camera frame, mm."""
    across, down = (
        np.linspace(first - 0.5, first + size - 0.5, _EDGE_POINTS)
        for first, size in zip(window[:2], window[2:], strict=True)
    )
    sides = [(across, np.full_like(across, row)) for row in (down[0], down[-1])]
    sides += [(np.full_like(down, col), down) for col in (across[0], across[-1])]
    outline, found = chain.frame_from_scan(np.concatenate([np.stack(side, axis=1) for side in sides]))
    if chain.lens is not None and not family(chain.lens.distortion.family).is_pinhole_at_zero:
        corners_mm = chain.lens.interior[1:] + _WIDEST * chain.lens.interior[0] * np.array([[-1.0], [1.0]])
        outline = np.clip(outline, *corners_mm) if found.all() else corners_mm
    elif not found.all():
        raise MeasurementError("its distortion folds the image over within the scan: resample without --lens.")
    return outline


def scan_places(chain: FrameChain, canvas: Canvas, col0: int, row0: int, side: int) -> tuple[Array, Array]:
    """Columns and rows of the scan, (side, side) each, at the pixels of a tile of the canvas; NaN where there is none.

    The chain is smooth: cubic splines through nodes 16 px apart are within 1e-4 px of it.
    """
    nodes = _nodes(side)
    places_mm = canvas.camera_mm(col0 + nodes, row0 + nodes)
    pixels, found = chain.scan_from_frame(places_mm.reshape(-1, 2))
    pixels = pixels.reshape(len(nodes), len(nodes), 2)
    at = np.arange(side, dtype=float)
    if not found.all():  # where a lens folds the chain is not smooth: evaluate it at each pixel
        exact, known = chain.scan_from_frame(canvas.camera_mm(col0 + at, row0 + at).reshape(-1, 2))
        exact[~known] = np.nan
        return exact[:, 0].reshape(side, side), exact[:, 1].reshape(side, side)
    from_nodes = _cubic_from_nodes(side)
    return from_nodes @ pixels[..., 0] @ from_nodes.T, from_nodes @ pixels[..., 1] @ from_nodes.T


def _nodes(side: int) -> Array:
    return np.arange(-_BEYOND * _NODES_PX, side + _BEYOND * _NODES_PX + 1, _NODES_PX, dtype=float)


@cache
def _cubic_from_nodes(side: int) -> Array:
    """(side, nodes) matrix that evaluates cubic splines through values at the nodes at the pixels of a tile."""
    nodes = _nodes(side)
    return np.asarray(make_interp_spline(nodes, np.eye(len(nodes)))(np.arange(side)))
