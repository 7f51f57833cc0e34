"""NCC of a reduced scan with the templates of marks, over the whole scan or in windows around expected places.

A single mark gives false peaks on every film: the constellation decides.
"""

from collections import OrderedDict
from collections.abc import Callable, Collection, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from measure.array_types import Array, Mask
from measure.detection.correlation import WIDE, Map, Surroundings, correlation, highest_about, local_maxima, variation
from measure.geometry import linear_scale, turn_by_quarters
from measure.marks.rendering import detail_px, extent_px, known_picture
from measure.marks.shapes import Bar, Mark, MarkShape, MarkTemplate
from measure.matching.window import FAINT
from measure.scans.parallel import map_in_threads
from measure.scans.scan import SINGLE_CHANNELS, Scan

Key = tuple[int, int]  # a kind of template, and the sign of the mark
Value = TypeVar("Value", bound="Map | Dilation")

_EXTENT_PX = 14.0  # px, smallest extent of the reduced mark
_THINNEST_PX = 1.2  # px, smallest width of its thinnest line, which would otherwise vanish
_BLUR_PX = 0.6  # px, blur of the reduced mark: 0.3 from averaging, and the rest from the scan
_RIM_PX = 2  # px of the reduced scan around the drawing, reach of the blur
_LARGEST_PX = 3000  # px, larger side of the reduced scan; a larger one costs seconds
_ALIKE = 0.8  # NCC above which two templates share one response
_LEARNED = 2.0  # in widths of the finest detail: wide notches and blocks would dominate the median of the background
_GRID_PX = 16  # px of the reduced scan: places in one cell of this grid share a window
_LEAST_RESPONSE = 0.2  # smallest NCC of a candidate
_CANDIDATES = 100  # largest number per template
_BACKGROUND_PERCENT = 95  # percentile of the NCC that defines the background's response
_LEAST_BACKGROUND = 0.5  # fraction of the map taken for background at least
_SAMPLED = slice(None, None, 3)  # subsampling for that estimate, since neighbours are correlated
_MOST_CACHED = 256 << 20  # bytes, enough for four different marks in an orientation of a large scan
_SMALL_MAPS = 14  # maps of a small scan at full resolution: four different marks in an orientation
_LEAST_CACHED = 32 << 20  # bytes
_STEP = 1 / 32767  # NCC, of dilated maps: at 16 bits they take half the memory
_ROUNDING = 1e-9  # of the elements of a turn by a quarter
_AT_ONCE = 1000  # places whose neighbourhoods are held in memory at a time


@dataclass(frozen=True)
class SearchEffort:
    """Effort of a search. cache_bytes: largest size of the cache; half_px: largest half size of the template of a
    cross, px of the reduced scan, since the centre suffices where one arm is far longer; every_pose: also orientations
    in which the marks look the same."""

    cache_bytes: int = _MOST_CACHED
    half_px: int = 1000
    every_pose: bool = True

    def make_cache(self, scan: Scan) -> "ByteCache":
        """Create the cache shared by all searches of a scan; limited for small scans."""
        pixels = scan.width_px * scan.height_px
        return ByteCache(min(self.cache_bytes, max(_SMALL_MAPS * 4 * pixels, _LEAST_CACHED)))


class ByteCache:
    """Least-recently-used cache of maps and dilations, limited by size in bytes.

    Marks that look different in every orientation have dozens of maps, each as large as the reduced scan.
    """

    def __init__(self, limit_bytes: int) -> None:
        self.limit_bytes = limit_bytes
        self._entries = OrderedDict[Hashable, Any]()  # a key always has values of the same type
        self._bytes = 0

    def get(self, key: Hashable, make: Callable[[], Value]) -> Value:
        """Return the value of a key; one that is absent, or was dropped, is made."""
        if key in self._entries:
            self._entries.move_to_end(key)
            kept: Value = self._entries[key]
            return kept
        value = make()
        while self._entries and self._bytes + value.nbytes > self.limit_bytes:
            self._bytes -= self._entries.popitem(last=False)[1].nbytes
        self._entries[key] = value
        self._bytes += value.nbytes
        return value


@dataclass(frozen=True, eq=False)
class MarkView:
    """A mark in one scan orientation. linear: (2, 2) part of pixel_from_mark in the scan."""

    mark: Mark
    linear: Array


@dataclass(frozen=True, eq=False)
class Templates:
    """Distinct templates of mark views.

    Attributes
    ----------
    images : one per kind; nan where a mark is not known.
    details_px : width of the finest structure that is not background, px of the reduced scan, one per kind.
    masks : one per kind; equal ones are the same array.
    surroundings : treatment of the background, which makes the masks.
    kinds : of the template of each view.
    reduction : factor by which the scan is reduced.
    """

    images: Sequence[Array]
    details_px: Sequence[float]
    masks: Sequence[Map]
    surroundings: Surroundings
    kinds: tuple[int, ...]
    reduction: int

    @classmethod
    def render(cls, scan: Scan, views: Sequence[MarkView], half_px: int, surroundings: Surroundings) -> "Templates":
        """Render mark views. half_px: largest half size of the template of a cross, px of the reduced scan."""
        reduction = _search_reduction(scan, views)
        images = _images(views, reduction, half_px)
        own = list({id(image): image for image in images}.values())
        correlations = _correlations(own)
        first: list[int] = []
        kind_by_id: dict[int, int] = {}
        for number, image in enumerate(own):
            if not (correlations[number, first] > _ALIKE).any():
                first.append(number)
            kind_by_id[id(image)] = int(correlations[number, first].argmax())
        kinds = tuple(kind_by_id[id(image)] for image in images)
        details = []
        for view in (views[kinds.index(kind)] for kind in range(len(first))):
            wide = _LEARNED if isinstance(view.mark, MarkTemplate) else 1.0
            details.append(max(wide * detail_px(view.mark, view.linear) / reduction, 1.0))
        images = [own[number] for number in first]
        masks = [surroundings.mask(*each) for each in zip(images, details, strict=True)]
        distinct = {(mask.shape, mask.tobytes()): mask for mask in masks}
        masks = [distinct[mask.shape, mask.tobytes()] for mask in masks]
        return cls(images, details, masks, surroundings, kinds, reduction)

    @property
    def half_px(self) -> int:
        """Margin (px) by which an image must exceed its correlation map."""
        return max(len(image) for image in self.images) // 2


def _search_reduction(scan: Scan, views: Sequence[MarkView]) -> int:
    """Reduction factor of the search: as large as needed, limited so that marks and lines remain visible."""
    limits = []
    # Mirroring changes no extent.
    distinct = {(view.mark, np.abs(view.linear).tobytes()): view for view in views}
    for view in distinct.values():
        least, greatest = extent_px(view.mark, np.column_stack([view.linear, np.zeros(2)]))
        thinnest_px = linear_scale(view.linear) * view.mark.thinnest_mm
        limits.append(min((greatest - least).max() / _EXTENT_PX, thinnest_px / _THINNEST_PX))
    needed = max(scan.width_px, scan.height_px) / _LARGEST_PX
    return min(max(1, int(min(limits)), int(np.ceil(needed))), scan.width_px, scan.height_px)


def _images(views: Sequence[MarkView], reduction: int, half_px: int) -> list[Array]:
    """Templates of views. Equal marks in the same direction share one; quarter turns and mirroring reuse it turned."""
    first: dict[Mark, tuple[Array, Array]] = {}
    drawn: dict[tuple[Mark, bytes], Array] = {}
    for view in views:
        key = view.mark, view.linear.tobytes()
        if key in drawn:
            continue
        if view.mark not in first:
            first[view.mark] = view.linear, _image(view, reduction, half_px)
        linear, image = first[view.mark]
        turn = view.linear @ np.linalg.inv(linear)
        whole = np.rint(turn)
        is_quarter = np.abs(turn - whole).max() < _ROUNDING and (np.abs(whole).sum(axis=0) == 1).all()
        drawn[key] = turn_by_quarters(image, turn) if is_quarter else _image(view, reduction, half_px)
    return [drawn[view.mark, view.linear.tobytes()] for view in views]


def _image(view: MarkView, reduction: int, half_px: int) -> Array:
    place = np.column_stack([view.linear, np.zeros(2)]) / reduction
    half = int(np.ceil(np.abs(np.concatenate(extent_px(view.mark, place))).max())) + _RIM_PX
    if isinstance(view.mark, MarkShape) and any(isinstance(part, Bar) for part in view.mark.parts):
        half = min(half, half_px)
    place[:, 2] = half
    return known_picture(view.mark, place, 2 * half + 1, 2 * half + 1, _BLUR_PX)


def _correlations(images: Sequence[Array]) -> Array:
    """(n, n) correlations of concentric templates; the smaller one of two is padded with zeros."""
    sizes = np.array([len(image) for image in images])
    flat = np.stack([np.pad(np.nan_to_num(each), (sizes.max() - len(each)) // 2).ravel() for each in images])
    sums, count = flat.sum(axis=1), np.maximum(sizes[:, None], sizes) ** 2
    squares = (flat**2).sum(axis=1)
    spread = squares[:, None] - sums[:, None] ** 2 / count
    return np.asarray((flat @ flat.T - np.outer(sums, sums) / count) / np.sqrt(spread * spread.T))


class CorrelationMaps(Mapping[Key, Map]):
    """Correlation maps of a part of the reduced scan by kind and sign: lighter (+1) or darker (-1) than the background.

    They are computed on demand, the maximum over all channels.
    """

    def __init__(
        self,
        channels: Sequence[Callable[[], Map]],
        templates: Templates,
        signs: Collection[int],
        faint_dn: float,
        cache: ByteCache,
    ) -> None:
        """channels: functions that make images which exceed the maps by the templates' half_px; faint_dn: contrast at
        the level of rounding."""
        self._channels, self._templates, self._signs, self._cache = channels, templates, tuple(signs), cache
        self._faint_dn = faint_dn
        self._own = object()  # identifies these maps in the cache; self would create a reference cycle

    def __getitem__(self, key: Key) -> Map:
        kind, sign = key
        extremes = self._cache.get((self._own, kind), partial(self._extremes, kind))
        return np.asarray(extremes[0] if sign > 0 else -extremes[-1])

    def __iter__(self) -> Iterator[Key]:
        return ((kind, sign) for kind in range(len(self._templates.images)) for sign in self._signs)

    def __len__(self) -> int:
        return len(self._templates.images) * len(self._signs)

    def _extremes(self, kind: int) -> Map:
        """(1 or 2, rows, columns) largest and least correlation of a kind over all channels, as the signs ask for; of
        one channel both are the same."""
        first = self._response(kind, 0)
        if len(self._channels) == 1:
            return first[None]
        reduce = [extreme for sign, extreme in ((1, np.maximum), (-1, np.minimum)) if sign in self._signs]
        extremes = np.stack([first] * len(reduce))
        for channel in range(1, len(self._channels)):
            response = self._response(kind, channel)
            for extreme, own in zip(reduce, extremes, strict=True):
                extreme(own, response, out=own)
        return extremes

    def _response(self, kind: int, channel: int) -> Map:
        """Correlation of a kind with a channel."""
        templates = self._templates
        image, detail, mask = templates.images[kind], templates.details_px[kind], templates.masks[kind]
        # Kinds of equal detail share the flattened image, kinds with equal masks its variation under them.
        alike = [other is mask for px, other in zip(templates.details_px, templates.masks, strict=True) if px == detail]
        key = self._own, channel, detail
        flat = self._kept(key, len(alike), partial(self._flatten, channel, detail))
        chip = templates.surroundings.pattern(image, detail, mask, flat)
        varied = self._kept((key, id(mask)), sum(alike), partial(variation, flat, mask))
        response = correlation(flat, chip, mask, varied)
        margin = templates.half_px - len(image) // 2
        rows, cols = (slice(margin, side - margin) for side in response.shape)
        return response[rows, cols]

    def _flatten(self, channel: int, detail_px: float) -> Map:
        return self._templates.surroundings.flatten(self._channels[channel](), detail_px, self._faint_dn)

    def _kept(self, key: Hashable, kinds: int, make: Callable[[], Map]) -> Map:
        """Value that so many kinds share; a single kind needs it once."""
        return self._cache.get(key, make) if kinds > 1 else make()


class Dilation:
    """Correlation map dilated by a disk, in steps of 1 / 32767. area_px: of the disk; background: 95th percentile
    beside the marks, at least 0."""

    def __init__(self, map_: Map, origin: NDArray[np.int_], radius_px: float, marks: int) -> None:
        size = 2 * round(radius_px) + 1
        disk = np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)), np.uint8)
        steps = cv2.addWeighted(map_, 1 / _STEP, map_, 0.0, 0.0, dtype=cv2.CV_16S)
        self.map, self.origin, self.area_px = np.asarray(cv2.dilate(steps, disk)), origin, int(disk.sum())
        # The disks about the marks of a dense lattice cover a tenth of the scan: they would be the background.
        percent = _BACKGROUND_PERCENT * max(1 - marks * self.area_px / map_.size, _LEAST_BACKGROUND)
        self.background = max(_STEP * float(np.percentile(self.map[_SAMPLED, _SAMPLED], percent)), 0.0)

    @property
    def nbytes(self) -> int:
        return self.map.nbytes

    def share(self, place: Array) -> float:
        """Fraction of all places whose response is at least that of a place (2,) of the reduced scan."""
        return np.count_nonzero(self.map >= self._steps(place)) / self.map.size

    def height(self, place: Array) -> float:
        """Highest response within the radius of a place (2,) of the reduced scan."""
        return _STEP * float(self._steps(place))

    def strength(self, places: NDArray[np.int_]) -> tuple[Array, Mask]:
        """(...) squared responses in excess of the background at places (..., 2) of the reduced scan, and mask of those
        inside the map; 0 for others."""
        rows, cols = self.map.shape
        col, row = np.moveaxis(places - self.origin, -1, 0)
        inside = (col >= 0) & (row >= 0) & (col < cols) & (row < rows)
        steps = self.map[np.clip(row, 0, rows - 1), np.clip(col, 0, cols - 1)]
        response = np.where(inside, _STEP * np.maximum(steps, 0), 0.0)
        return np.maximum(response**2 - self.background**2, 0.0), inside

    def _steps(self, place: Array) -> np.int16:
        col, row = np.clip(np.rint(place).astype(int) - self.origin, 0, np.array(self.map.shape[::-1]) - 1)
        return np.int16(self.map[row, col])


@dataclass(frozen=True, eq=False)
class Responses:
    """Correlations of the reduced scan with the templates of mark views, and quantities derived from them.

    Attributes
    ----------
    maps : by kind of template and sign (+1 lighter, -1 darker than the background), (rows, columns) NCC.
    kinds : kind of template of each mark view.
    reduction : factor by which the scan was reduced.
    cache : of dilations, shared with other searches of the scan.
    origins : (kinds, 2) column and row of the reduced scan where the maps of each kind begin; None: maps of the whole
        scan.
    surroundings : treatment of the background.
    marks : number of marks that each map may show.
    """

    maps: Mapping[Key, Map]
    kinds: tuple[int, ...]
    reduction: int
    cache: ByteCache
    origins: NDArray[np.int_] | None = None
    surroundings: Surroundings = WIDE
    marks: int = 0
    _candidates: dict[Key, Array] = field(default_factory=dict)

    @cached_property
    def _own(self) -> object:
        """Identifies the responses in the cache; self would create a reference cycle."""
        return object()

    def origin(self, key: Key) -> NDArray[np.int_]:
        """(2,) column and row of the reduced scan where a map begins."""
        return np.zeros(2, dtype=int) if self.origins is None else np.asarray(self.origins[key[0]])

    def candidates(self, key: Key) -> Array:
        """(n, 2) highest peaks of a map, px of the reduced scan."""
        if key not in self._candidates:
            peaks, _ = local_maxima(self.maps[key], _CANDIDATES, _LEAST_RESPONSE)
            self._candidates[key] = peaks + self.origin(key)
        return self._candidates[key]

    def dilated(self, key: Key, radius_px: float) -> Dilation:
        """Dilate a map by a radius, rounded to whole pixels."""
        own = self._own, key, round(radius_px)
        return self.cache.get(own, lambda: Dilation(self.maps[key], self.origin(key), radius_px, self.marks))

    def highest_about(self, key: Key, places: Array, radius_px: float) -> tuple[Array, Array]:
        """Places (n, 2) of the highest responses around places (n, 2) of the reduced scan, and (n,) heights; 0 outside
        the map."""
        origin, own = self.origin(key), self.maps[key]
        parts = np.array_split(places - origin, len(places) // _AT_ONCE + 1)
        tops, heights = zip(*(highest_about(own, part, radius_px) for part in parts), strict=True)
        return np.concatenate(tops) + origin, np.concatenate(heights)


def correlate_scan(
    scan: Scan,
    views: Sequence[MarkView],
    signs: Collection[int],
    surroundings: Surroundings,
    cache: ByteCache,
    half_px: int,
    marks: int,
) -> Responses:
    """Correlate the whole scan with mark views.

    Parameters
    ----------
    signs : lighter (+1) or darker (-1) than the background.
    half_px : largest half size of the template of a cross, px of the reduced scan.
    marks : number of marks in the frame.
    """
    templates = Templates.render(scan, views, half_px, surroundings)
    half = (templates.half_px,) * 4

    def bordered(weights: Sequence[float]) -> Map:
        grey = scan.reduced(templates.reduction, weights)
        return np.asarray(cv2.copyMakeBorder(grey, *half, cv2.BORDER_REPLICATE), np.float32)

    channels = [partial(bordered, weights) for weights in _channels(scan)]
    maps = CorrelationMaps(channels, templates, signs, scan.full_scale_dn * FAINT, cache)
    return Responses(maps, templates.kinds, templates.reduction, cache, None, surroundings, marks)


def correlate_windows(
    scan: Scan,
    views: Sequence[MarkView],
    places_px: Array,
    reach_px: float,
    signs: Collection[int],
    cache: ByteCache,
    half_px: int,
) -> Responses:
    """Correlate windows around the expected places (n, 2) of mark views, up to reach_px and slightly beyond.

    Only these windows of the file are read. A kind is a template at one place.
    """
    templates = Templates.render(scan, views, half_px, WIDE)
    reduction, half = templates.reduction, templates.half_px
    reach = int(np.ceil(reach_px / reduction))
    # Row by row, so that file strips shared by windows are still decoded for the next one.
    squares = np.floor(places_px[:, ::-1] / reduction / _GRID_PX)
    corners, numbers = np.unique(squares, axis=0, return_inverse=True)
    origins = corners[:, ::-1].astype(int) * _GRID_PX - reach
    size = _GRID_PX + 2 * reach + 2 * half
    pairs = list(zip(numbers.tolist(), templates.kinds, strict=True))
    kinds = sorted(set(pairs))

    def window_maps(corner: int) -> dict[Key, Map]:
        col0, row0 = (origins[corner] - half).tolist()
        window = reduction, col0, row0, size, size
        channels = [partial(scan.reduced_window, *window, weights) for weights in _channels(scan)]
        own_cache = ByteCache(_MOST_CACHED)
        maps = CorrelationMaps(channels, templates, signs, scan.full_scale_dn * FAINT, own_cache)
        own = (pair for pair in kinds if pair[0] == corner)
        return {(kinds.index(pair), sign): maps[pair[1], sign] for pair in own for sign in signs}

    maps = {key: map_ for each in map_in_threads(window_maps, range(len(corners))) for key, map_ in each.items()}
    own_origins = origins[[corner for corner, _ in kinds]]
    return Responses(maps, tuple(kinds.index(pair) for pair in pairs), reduction, cache, own_origins)


def _channels(scan: Scan) -> tuple[tuple[float, ...], ...]:
    return ((1.0,),) if scan.channels == 1 else SINGLE_CHANNELS
