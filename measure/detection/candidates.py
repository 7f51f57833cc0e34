"""Where in a scan something looks like a mark: normalised correlation with the rendered mark, at reduced size.

A mark alone gives false answers on every film, so nothing is decided here: the responses go to the constellation.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from measure.detection.correlation import WIDE, Map, Surroundings
from measure.detection.scan_maps import Held, ScanMaps, Sought
from measure.geometry import linear_scale, quarter_turned
from measure.marks.rendering import extent_px, known_picture
from measure.marks.shapes import Bar, Mark, MarkShape, MarkTemplate, thinnest_mm
from measure.matching.window import FAINT
from measure.scans.parallel import map_in_threads
from measure.scans.scan import SINGLE_CHANNELS, Scan

Array = NDArray[np.float64]
Grid = TypeVar("Grid", NDArray[np.float64], NDArray[np.bool_])

_EXTENT_PX = 14.0  # of the reduced mark
_THINNEST_PX = 1.2  # of its thinnest line: below this the line drowns
_BLUR_PX = 0.6  # of the reduced mark: the averaging's own 0.3, and what is left of the scan's
_RIM_PX = 2  # of the reduced scan, about the drawing: so far the blur takes it
_LARGEST_PX = 3000  # of the reduced scan: a larger one costs seconds
_SHARED_PX = 16  # of the reduced scan: places so near to one another share a window
_ALIKE = 0.8  # correlation above which two pictures of marks share one response
_LEARNED = 2.0  # times its finest detail: a notch or block is wider, and would be most of what ground is the median of


@dataclass(frozen=True, eq=False)
class Responses:
    """Correlations with the looks of the marks, over the reduced scan.

    maps: by the kind of look and +1 or -1, (rows, columns) of how much the place looks like the mark lighter or darker
    than its surroundings; those of a whole scan are made when they are asked for. reduction: by which the scan was
    reduced. origins: (kinds, 2) column and row of the reduced scan where the maps of each kind begin; None: they hold
    all of it. surroundings: what counts about a mark.
    """

    maps: Mapping[tuple[int, int], Map]
    reduction: int
    origins: NDArray[np.int_] | None = None
    surroundings: Surroundings = WIDE

    def origin(self, kind: int) -> NDArray[np.int_]:
        """(2,) pixel of the reduced scan where the maps of a kind begin."""
        return np.zeros(2, dtype=int) if self.origins is None else self.origins[kind]

    def expect(self, kinds: Sequence[int], later: Sequence[int]) -> None:
        """Kinds whose maps are asked for next, and those later on: made together they take less time."""
        if isinstance(self.maps, ScanMaps):
            self.maps.expect(kinds, later)

    def reduced_px(self, scan_px: Array) -> Array:
        """Scan pixels (..., 2) in pixels of the reduced scan."""
        return (scan_px - (self.reduction - 1) / 2) / self.reduction

    def scan_px(self, reduced_px: Array) -> Array:
        """Pixels of the reduced scan (..., 2) in scan pixels."""
        return reduced_px * self.reduction + (self.reduction - 1) / 2


@dataclass(frozen=True)
class Effort:
    """How much a search takes. held_bytes: of correlations, at a time. half_px: how far about its point a cross is
    drawn at most, in the reduced scan: where one arm is far longer the middle tells enough. twins: whether a pose that
    shows the same marks in the same places as another has placements of its own."""

    held_bytes: int
    half_px: int
    twins: bool


_SIXTEEN_LOOKS = 768 << 20  # bytes: of four marks that differ, in a large scan
FULL = Effort(held_bytes=_SIXTEEN_LOOKS, half_px=1000, twins=True)


@dataclass(frozen=True, eq=False)
class Look:
    """A mark as one pose shows it: linear is the (2, 2) part of pixel_from_mark in the scan."""

    mark: Mark
    linear: Array


def respond(
    scan: Scan,
    looks: Sequence[Look],
    signs: Collection[int],
    surroundings: Surroundings,
    held: Held[Map],
    most_px: int = FULL.half_px,
) -> tuple[Responses, tuple[int, ...]]:
    """The responses to the looks that differ, lighter (+1) and darker (-1) than their surroundings as signs says, and
    for every look which of the kinds is its own. held: what there is of these maps, and of others of the scan. most_px:
    of the reduced scan, how far about its point a cross is drawn at most."""
    reduction = _reduction(scan, looks)
    kinds, index = _distinct(_templates(looks, reduction, most_px))
    details = [_reduced_detail_px(looks[index.index(kind)], reduction) for kind in range(len(kinds))]
    sought = Sought(kinds, details, signs, surroundings, scan.full_scale_dn * FAINT)
    maps = ScanMaps(scan, reduction, _channel_weights(scan), sought, held)
    return Responses(maps, reduction, surroundings=surroundings), index


def respond_about(
    scan: Scan,
    looks: Sequence[Look],
    places_px: Array,
    reach_px: float,
    signs: Collection[int] = (1, -1),
    most_px: int = FULL.half_px,
) -> tuple[Responses, tuple[int, ...]]:
    """The same, of each look only about its place (n, 2) in the scan, as far as reach_px and a little farther: of the
    file only these windows are read. A kind is a look at one place."""
    reduction = _reduction(scan, looks)
    shapes, shape_of = _distinct(_templates(looks, reduction, most_px))
    details = [_reduced_detail_px(looks[0], reduction)] * len(shapes)
    sought = Sought(shapes, details, signs, WIDE, scan.full_scale_dn * FAINT)
    reach, half = int(np.ceil(reach_px / reduction)), sought.half_px
    # Row by row: strips of the file that windows share are still decoded for the next one.
    squares = np.floor(places_px[:, ::-1] / reduction / _SHARED_PX)
    corners, corner_of = np.unique(squares, axis=0, return_inverse=True)
    origins = corners[:, ::-1].astype(int) * _SHARED_PX - reach
    size = _SHARED_PX + 2 * reach
    kinds = sorted(set(zip(corner_of.tolist(), shape_of, strict=True)))

    def at_corner(corner: int) -> dict[tuple[int, int], Map]:
        col0, row0 = (origins[corner] - half).tolist()
        greys = (
            scan.reduced_window(reduction, col0, row0, size + 2 * half, size + 2 * half, weights)
            for weights in _channel_weights(scan)
        )
        maps = sought.maps([shape for own, shape in kinds if own == corner], greys)
        return {(kinds.index((corner, shape)), sign): map_ for (shape, sign), map_ in maps.items()}

    every = {key: map_ for maps in map_in_threads(at_corner, range(len(corners))) for key, map_ in maps.items()}
    index = tuple(kinds.index(pair) for pair in zip(corner_of.tolist(), shape_of, strict=True))
    return Responses(every, reduction, origins[[corner for corner, _ in kinds]]), index


def detail_px(mark: Mark, linear: Array) -> float:
    """The width of the mark's finest detail in px, and no less than one."""
    return max(linear_scale(linear) * thinnest_mm(mark), 1.0)


def _reduction(scan: Scan, looks: Sequence[Look]) -> int:
    """The largest that leaves every mark large enough, every line thick enough to be seen, and of the scan a pixel."""
    limits = []
    for look in looks:
        least, greatest = extent_px(look.mark, _centred(look.linear))
        scale = linear_scale(look.linear)
        limits.append(min((greatest - least).max() / _EXTENT_PX, scale * thinnest_mm(look.mark) / _THINNEST_PX))
    needed = max(scan.width_px, scan.height_px) / _LARGEST_PX
    return min(max(1, int(min(limits)), int(np.ceil(needed))), scan.width_px, scan.height_px)


def _reduced_detail_px(look: Look, reduction: int) -> float:
    """In px of the reduced scan, the width of what is no ground: the finest detail, or of a learned picture more."""
    wide = _LEARNED if isinstance(look.mark, MarkTemplate) else 1.0
    return max(wide * detail_px(look.mark, look.linear) / reduction, 1.0)


def _templates(looks: Sequence[Look], reduction: int, most_px: int = FULL.half_px) -> list[Array]:
    """The picture of every look; the same mark in the same direction shares its own, and one turned by quarters or
    mirrored has its picture turned."""
    drawn: dict[Mark, tuple[Array, Array]] = {}
    shown: dict[tuple[Mark, bytes], Array] = {}
    for look in looks:
        key = look.mark, look.linear.tobytes()
        if key in shown:
            continue
        if look.mark not in drawn:
            drawn[look.mark] = look.linear, _template(look, reduction, most_px)
        linear, template = drawn[look.mark]
        turn = look.linear @ np.linalg.inv(linear)
        shown[key] = quarter_turned(template, turn) if _is_quarter(turn) else _template(look, reduction, most_px)
    return [shown[look.mark, look.linear.tobytes()] for look in looks]


def _is_quarter(turn: Array) -> bool:
    whole = np.rint(turn)
    return bool(np.allclose(turn, whole, atol=1e-9) and np.array_equal(np.abs(whole).sum(axis=0), [1, 1]))


def _template(look: Look, reduction: int, most_px: int) -> Array:
    linear = _centred(look.linear) / reduction
    least, greatest = extent_px(look.mark, linear)
    half = int(np.ceil(np.abs(np.concatenate([least, greatest])).max())) + _RIM_PX
    if isinstance(look.mark, MarkShape) and any(isinstance(part, Bar) for part in look.mark.parts):
        half = min(half, most_px)
    linear[:, 2] = half
    return known_picture(look.mark, linear, 2 * half + 1, 2 * half + 1, _BLUR_PX)


def _centred(linear: Array) -> Array:
    return np.column_stack([linear, np.zeros(2)])


def _distinct(templates: Sequence[Array]) -> tuple[list[Array], tuple[int, ...]]:
    """Templates that differ, and which of them stands for each."""
    own = list({id(template): template for template in templates}.values())
    likeness = _likeness(own)
    kinds: list[int] = []
    kind_of: dict[int, int] = {}
    for number, template in enumerate(own):
        alike = likeness[number, kinds]
        if not (alike > _ALIKE).any():
            kinds.append(number)
            alike = likeness[number, kinds]
        kind_of[id(template)] = int(alike.argmax())
    return [own[number] for number in kinds], tuple(kind_of[id(template)] for template in templates)


def _likeness(templates: Sequence[Array]) -> Array:
    """(n, n) correlations of templates about one centre, the smaller of two filled up with nothing."""
    sizes = np.array([template.shape[0] for template in templates])
    flat = np.stack([np.pad(np.nan_to_num(each), (sizes.max() - len(each)) // 2).ravel() for each in templates])
    sums, count = flat.sum(axis=1), np.maximum(sizes[:, None], sizes) ** 2
    squares = (flat**2).sum(axis=1)
    spread = squares[:, None] - sums[:, None] ** 2 / count
    return np.asarray((flat @ flat.T - np.outer(sums, sums) / count) / np.sqrt(spread * spread.T))


def _channel_weights(scan: Scan) -> tuple[tuple[float, ...], ...]:
    if scan.channels == 1:
        return ((1.0,),)
    return SINGLE_CHANNELS
