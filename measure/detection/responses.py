"""NCC of a reduced scan with the templates of marks, over the whole scan or in windows around expected places.

A single mark gives false peaks on every film: the constellation decides.
"""

from collections import OrderedDict
from collections.abc import Collection, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Generic, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from measure.array_types import Array, Mask
from measure.detection.correlation import WIDE, Map, Surroundings, correlation, highest_about, local_maxima, variation
from measure.detection.mark_views import MarkView, distinct_templates, ground_detail_px, search_reduction
from measure.matching.window import FAINT
from measure.scans.parallel import map_in_threads
from measure.scans.scan import SINGLE_CHANNELS, Scan

Cached = TypeVar("Cached")
Key = tuple[int, int]  # a kind of template, and the sign of the mark

_GRID_PX = 16  # px of the reduced scan: places in one cell of this grid share a window
_LEAST_RESPONSE = 0.2  # smallest NCC of a candidate
_CANDIDATES = 100  # largest number per template
_NARROWED = 0.7  # factor of the tolerance for refined placements
LEAST_TOLERANCE_PX = 1.5  # px of the reduced scan, accuracy of correlation peaks
_BACKGROUND_PERCENT = 95  # percentile of the NCC that defines the background's response
_LEAST_BACKGROUND = 0.5  # fraction of the map taken for background at least
_SAMPLED = slice(None, None, 3)  # subsampling for that estimate, since neighbours are correlated


def narrow_tolerance_px(tolerance_px: float) -> float:
    """Tolerance of a refined placement."""
    return max(_NARROWED * tolerance_px, LEAST_TOLERANCE_PX)


@dataclass(frozen=True)
class Effort:
    """Effort of a search.

    cache_bytes: size of the cache of correlation maps; half_px: largest half size of the template of a cross, px of the
    reduced scan, since the centre suffices where one arm is far longer; all_orientations: whether scan orientations
    that show the same marks in the same places are searched separately.
    """

    cache_bytes: int
    half_px: int
    all_orientations: bool

    def scan_cache_bytes(self, pixels: int) -> int:
        """Size of the cache shared by all searches of a scan with this number of pixels; limited for small scans."""
        return min(self.cache_bytes, max(_SMALL_MAPS * 4 * pixels, _LEAST_CACHED))


_SMALL_MAPS = 32  # maps of a small scan at full resolution
_LEAST_CACHED = 32 << 20  # bytes
_SIXTEEN_MAPS = 768 << 20  # bytes, maps of four different marks in a large scan
FULL = Effort(cache_bytes=_SIXTEEN_MAPS, half_px=1000, all_orientations=True)


class ByteCache(Generic[Cached]):
    """Least-recently-used cache, limited by size in bytes."""

    def __init__(self, limit_bytes: int) -> None:
        self.limit_bytes = limit_bytes
        self._entries: OrderedDict[Hashable, tuple[Cached, int]] = OrderedDict()
        self._bytes = 0

    def get(self, key: Hashable) -> Cached | None:
        """Cached value of a key; None if absent."""
        if key not in self._entries:
            return None
        self._entries.move_to_end(key)
        return self._entries[key][0]

    def put(self, key: Hashable, value: Cached, size_bytes: int) -> None:
        """Add a value, in place of an earlier one of the same key."""
        self._bytes -= self._entries.pop(key, (value, 0))[1]
        self.make_room(size_bytes)
        self._entries[key] = value, size_bytes
        self._bytes += size_bytes

    def make_room(self, size_bytes: int) -> None:
        """Drop the least recently used entries until size_bytes fit or the cache is empty."""
        while self._entries and self._bytes + size_bytes > self.limit_bytes:
            self._bytes -= self._entries.popitem(last=False)[1][1]


@dataclass(frozen=True)
class TemplateSet:
    """Templates of the distinct kinds of mark views.

    Attributes
    ----------
    templates : one per kind.
    details_px : width of the finest structure that is not background, px of the reduced scan, one per kind.
    signs : lighter (+1) or darker (-1) than the background.
    surroundings : treatment of the background.
    faint_dn : contrast at the level of rounding.
    """

    templates: Sequence[Array]
    details_px: Sequence[float]
    signs: Collection[int]
    surroundings: Surroundings
    faint_dn: float

    @property
    def half_px(self) -> int:
        """Margin (px) by which an image must exceed its correlation map."""
        return max(len(template) for template in self.templates) // 2

    def maps(self, kinds: Sequence[int], pictures: Sequence[Map] | Iterator[Map]) -> dict[Key, Map]:
        """Correlation maps of kinds with equal detail width, the maximum over the images of all channels. Kinds with
        the same mask, such as one template in eight orientations, share the image's variation."""
        maps, detail_px = dict[Key, Map](), self.details_px[kinds[0]]
        for picture in pictures:
            image = self.surroundings.flattened(picture, detail_px, self.faint_dn)
            height, width = (side - 2 * self.half_px for side in image.shape)
            variations = dict[bytes, Map]()
            for kind in kinds:
                chip, counts = self.surroundings.pattern(self.templates[kind], detail_px, image)
                if counts.tobytes() not in variations:
                    variations[counts.tobytes()] = variation(image, counts)
                response = correlation(image, chip, counts, variations[counts.tobytes()])
                margin = self.half_px - len(chip) // 2
                response = response[margin : margin + height, margin : margin + width]
                for sign in self.signs:
                    signed = response if sign > 0 else -response
                    known = maps.setdefault((kind, sign), signed)
                    np.maximum(known, signed, out=known)
        return maps


class ScanMaps(Mapping[Key, Map]):
    """Correlation maps of a whole reduced scan, computed on demand.

    Marks that look different in every orientation have dozens of maps, each as large as the reduced scan. The cache
    shared by all searches of a scan is therefore limited, and dropped maps are recomputed.
    """

    def __init__(
        self,
        scan: Scan,
        reduction: int,
        template_set: TemplateSet,
        cache: ByteCache[Map],
    ) -> None:
        self._scan, self._reduction, self._set, self._cache = scan, reduction, template_set, cache
        self._own = object()  # identifies these maps in the cache

    def __getitem__(self, key: Key) -> Map:
        map_ = self._cache.get((self._own, key))
        return self._make(key[0])[key] if map_ is None else map_

    def __iter__(self) -> Iterator[Key]:
        return ((kind, sign) for kind in range(len(self._set.templates)) for sign in self._set.signs)

    def __len__(self) -> int:
        return len(self._set.templates) * len(self._set.signs)

    def _make(self, first: int) -> dict[Key, Map]:
        """Compute the maps of a kind and of as many later ones with equal detail width as fit: they share most of the
        computation."""
        height, width = self._scan.height_px // self._reduction, self._scan.width_px // self._reduction
        kind_bytes = 4 * height * width * len(self._set.signs)
        most = max(self._cache.limit_bytes // kind_bytes, 1)
        details = self._set.details_px
        missing = [
            kind
            for kind in range(first, len(details))
            if details[kind] == details[first]
            and any(self._cache.get((self._own, (kind, sign))) is None for sign in self._set.signs)
        ][:most]
        self._cache.make_room(len(missing) * kind_bytes)
        maps = self._set.maps(missing, self._pictures())
        for key, map_ in maps.items():
            self._cache.put((self._own, key), map_, map_.nbytes)
        return maps

    def _pictures(self) -> Iterator[Map]:
        """Reduced scan in every channel, with its edge replicated as a margin."""
        half = self._set.half_px
        for weights in _channels(self._scan):
            grey = self._scan.reduced(self._reduction, weights)
            yield np.asarray(cv2.copyMakeBorder(grey, half, half, half, half, cv2.BORDER_REPLICATE), np.float32)


class Dilation:
    """Correlation map dilated by a disk. area_px: of the disk; background: 95th percentile beside the marks, at least
    0."""

    def __init__(self, map_: Map, origin: NDArray[np.int_], radius_px: float, marks: int) -> None:
        size = 2 * round(radius_px) + 1
        disk = np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)), np.uint8)
        self.map, self.origin, self.area_px = np.asarray(cv2.dilate(map_, disk)), origin, int(disk.sum())
        # The disks about the marks of a dense lattice cover a tenth of the scan: they would be the background.
        percent = _BACKGROUND_PERCENT * max(1 - marks * self.area_px / map_.size, _LEAST_BACKGROUND)
        self.background = max(float(np.percentile(self.map[_SAMPLED, _SAMPLED], percent)), 0.0)

    def share(self, place: Array) -> float:
        """Fraction of all places whose response is at least that of a place (2,) of the reduced scan."""
        return float(np.mean(self.map >= self.height(place)))

    def height(self, place: Array) -> float:
        """Highest response within the radius of a place (2,) of the reduced scan."""
        col, row = np.clip(np.rint(place).astype(int) - self.origin, 0, np.array(self.map.shape[::-1]) - 1)
        return float(self.map[row, col])

    def strength(self, places: NDArray[np.int_]) -> tuple[Array, Mask]:
        """(n,) squared responses in excess of the background at places (n, 2) of the reduced scan, and mask of those
        inside the map; 0 for others."""
        rows, cols = self.map.shape
        col, row = (places - self.origin).T
        inside = (col >= 0) & (row >= 0) & (col < cols) & (row < rows)
        response = np.where(inside, self.map[np.clip(row, 0, rows - 1), np.clip(col, 0, cols - 1)], 0.0).astype(float)
        return np.maximum(np.maximum(response, 0.0) ** 2 - self.background**2, 0.0), inside


class ResponseMap:
    """Responses to one template, with derived quantities shared by all orientations and hypotheses."""

    def __init__(
        self, maps: Mapping[Key, Map], key: Key, cache: ByteCache[Dilation], origin: NDArray[np.int_], marks: int
    ) -> None:
        # No reference to the `Responses` that hold this map: in a cycle their large maps would outlive the search.
        self._maps, self._key, self._cache, self.origin, self._marks = maps, key, cache, origin, marks
        self._own = object()  # identifies this map in the cache; self would create a reference cycle

    @property
    def map(self) -> Map:
        return self._maps[self._key]

    @cached_property
    def candidates(self) -> Array:
        """(n, 2) candidates, px of the reduced scan."""
        return np.asarray(local_maxima(self.map, _CANDIDATES, _LEAST_RESPONSE)[0] + self.origin)

    def dilated(self, radius_px: float) -> Dilation:
        """Dilate the map by a radius, rounded to whole pixels."""
        key = self._own, round(radius_px)
        dilation = self._cache.get(key)
        if dilation is None:
            dilation = Dilation(self.map, self.origin, radius_px, self._marks)
            self._cache.put(key, dilation, dilation.map.nbytes)
        return dilation

    def highest_about(self, places: Array, radius_px: float) -> tuple[Array, Array]:
        """Places (n, 2) of the highest responses around places (n, 2) of the reduced scan, and (n,) heights; 0 outside
        the map."""
        tops, heights = highest_about(self.map, places - self.origin, radius_px)
        return tops + self.origin, heights


@dataclass(frozen=True, eq=False)
class Responses:
    """Correlations of the reduced scan with the templates of mark views.

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
    cache: ByteCache[Dilation]
    origins: NDArray[np.int_] | None = None
    surroundings: Surroundings = WIDE
    marks: int = 0

    @cached_property
    def by_key(self) -> dict[Key, ResponseMap]:
        """Response maps by kind of template and sign."""
        origins = np.zeros((len(self.maps), 2), dtype=int) if self.origins is None else self.origins
        return {key: ResponseMap(self.maps, key, self.cache, origins[key[0]], self.marks) for key in self.maps}

    def reduced_px(self, scan_px: Array) -> Array:
        """Convert scan pixels (..., 2) to pixels of the reduced scan."""
        return np.asarray((scan_px - (self.reduction - 1) / 2) / self.reduction)

    def scan_px(self, reduced_px: Array) -> Array:
        """Convert pixels of the reduced scan (..., 2) to scan pixels."""
        return np.asarray(reduced_px * self.reduction + (self.reduction - 1) / 2)


def correlate_scan(
    scan: Scan,
    views: Sequence[MarkView],
    signs: Collection[int],
    surroundings: Surroundings,
    caches: tuple[ByteCache[Map], ByteCache[Dilation]],
    half_px: int = FULL.half_px,
    marks: int = 0,
) -> Responses:
    """Correlate the whole scan with mark views.

    Parameters
    ----------
    signs : lighter (+1) or darker (-1) than the background.
    caches : of correlation maps and of dilations.
    half_px : largest half size of the template of a cross, px of the reduced scan.
    marks : number of marks in the frame.
    """
    reduction = search_reduction(scan, views)
    templates, kinds = distinct_templates(views, reduction, half_px)
    details = [ground_detail_px(views[kinds.index(kind)], reduction) for kind in range(len(templates))]
    template_set = TemplateSet(templates, details, signs, surroundings, scan.full_scale_dn * FAINT)
    maps = ScanMaps(scan, reduction, template_set, caches[0])
    return Responses(maps, kinds, reduction, caches[1], surroundings=surroundings, marks=marks)


def correlate_windows(
    scan: Scan,
    views: Sequence[MarkView],
    places_px: Array,
    reach_px: float,
    signs: Collection[int],
    cache: ByteCache[Dilation],
    half_px: int = FULL.half_px,
) -> Responses:
    """Correlate windows around the expected places (n, 2) of mark views, up to reach_px and slightly beyond.

    Only these windows of the file are read. A kind is a template at one place.
    """
    reduction = search_reduction(scan, views)
    templates, template_numbers = distinct_templates(views, reduction, half_px)
    details = [ground_detail_px(views[0], reduction)] * len(templates)
    template_set = TemplateSet(templates, details, signs, WIDE, scan.full_scale_dn * FAINT)
    reach, half = int(np.ceil(reach_px / reduction)), template_set.half_px
    # Row by row, so that file strips shared by windows are still decoded for the next one.
    squares = np.floor(places_px[:, ::-1] / reduction / _GRID_PX)
    corners, numbers = np.unique(squares, axis=0, return_inverse=True)
    origins = corners[:, ::-1].astype(int) * _GRID_PX - reach
    size = _GRID_PX + 2 * reach + 2 * half
    pairs = list(zip(numbers.tolist(), template_numbers, strict=True))
    kinds = sorted(set(pairs))

    def window_maps(corner: int) -> dict[Key, Map]:
        col0, row0 = (origins[corner] - half).tolist()
        pictures = [scan.reduced_window(reduction, col0, row0, size, size, weights) for weights in _channels(scan)]
        maps = template_set.maps([template for own, template in kinds if own == corner], pictures)
        return {(kinds.index((corner, template)), sign): map_ for (template, sign), map_ in maps.items()}

    maps = {key: map_ for each in map_in_threads(window_maps, range(len(corners))) for key, map_ in each.items()}
    own_origins = origins[[corner for corner, _ in kinds]]
    return Responses(maps, tuple(kinds.index(pair) for pair in pairs), reduction, cache, own_origins)


def _channels(scan: Scan) -> tuple[tuple[float, ...], ...]:
    return ((1.0,),) if scan.channels == 1 else SINGLE_CHANNELS
