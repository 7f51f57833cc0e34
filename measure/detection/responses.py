"""Responses of a reduced scan to marks: normalised cross-correlation with their templates, over the whole scan or in
windows about expected places. A mark alone gives false peaks on every film: the constellation decides."""

from collections import OrderedDict
from collections.abc import Collection, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Generic, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from measure.array_types import Array, Mask
from measure.detection.correlation import WIDE, Map, Surroundings, correlation, variation
from measure.detection.mark_views import MarkView, distinct_templates, ground_detail_px, search_reduction
from measure.detection.peaks import highest_about, local_maxima
from measure.matching.window import FAINT
from measure.scans.parallel import map_in_threads
from measure.scans.scan import SINGLE_CHANNELS, Scan

Cached = TypeVar("Cached")
Key = tuple[int, int]  # a kind of template, and the sign of the mark

_GRID_PX = 16  # of the reduced scan: places so near to one another share a window
_LEAST_RESPONSE = 0.2  # of a candidate
_CANDIDATES = 100  # of each template
_NARROWED = 0.7  # of the tolerance, once a placement is refined
LEAST_TOLERANCE_PX = 1.5  # of the reduced scan: where a response is highest is known no better
_BACKGROUND_PERCENT = 95  # of places that stay below what the background answers
_SAMPLED = slice(None, None, 3)  # rows and columns from which that is estimated: neighbours answer alike


def narrow_tolerance_px(tolerance_px: float) -> float:
    """The tolerance of a refined placement."""
    return max(_NARROWED * tolerance_px, LEAST_TOLERANCE_PX)


@dataclass(frozen=True)
class Effort:
    """How much a search takes. cache_bytes: of correlations, at a time. half_px: how far about its point a cross is
    drawn at most, in the reduced scan: where one arm is far longer the middle tells enough. all_orientations: whether
    one that shows the same marks in the same places as another has placements of its own."""

    cache_bytes: int
    half_px: int
    all_orientations: bool

    def scan_cache_bytes(self, pixels: int) -> int:
        """What all searches of a scan of so many pixels cache together: some maps of a small one."""
        return min(self.cache_bytes, max(_SMALL_MAPS * 4 * pixels, _LEAST_CACHED))


_SMALL_MAPS = 32  # not reduced
_LEAST_CACHED = 32 << 20  # bytes
_SIXTEEN_MAPS = 768 << 20  # bytes: of four marks that differ, in a large scan
FULL = Effort(cache_bytes=_SIXTEEN_MAPS, half_px=1000, all_orientations=True)


class ByteCache(Generic[Cached]):
    """Things by a key each. The one used longest ago goes first where there is no room."""

    def __init__(self, limit_bytes: int) -> None:
        self.limit_bytes = limit_bytes
        self._entries: OrderedDict[Hashable, tuple[Cached, int]] = OrderedDict()
        self._bytes = 0

    def get(self, key: Hashable) -> Cached | None:
        """What is cached of a key, None if nothing is."""
        if key not in self._entries:
            return None
        self._entries.move_to_end(key)
        return self._entries[key][0]

    def put(self, key: Hashable, value: Cached, size_bytes: int) -> None:
        """Cache what is not cached yet."""
        self.make_room(size_bytes)
        self._entries[key] = value, size_bytes
        self._bytes += size_bytes

    def make_room(self, size_bytes: int) -> None:
        """Drop the oldest until so much more has room, or nothing is left."""
        while self._entries and self._bytes + size_bytes > self.limit_bytes:
            self._bytes -= self._entries.popitem(last=False)[1][1]


@dataclass(frozen=True)
class TemplateSet:
    """templates: of the kinds of mark views; details_px: of the reduced scan, the width of what is no ground beside
    each; signs: lighter (+1) or darker (-1) than the ground; faint_dn: contrast that is rounding."""

    templates: Sequence[Array]
    details_px: Sequence[float]
    signs: Collection[int]
    surroundings: Surroundings
    faint_dn: float

    @property
    def half_px(self) -> int:
        """How far beyond its maps a picture has to reach."""
        return max(len(template) for template in self.templates) // 2

    def maps(self, kinds: Sequence[int], pictures: Sequence[Map] | Iterator[Map]) -> dict[Key, Map]:
        """The correlation maps of kinds that are alike in detail, at every place the highest of all channels' pictures.
        Where the same pixels count, as in one template in eight orientations, the picture's variation is the same."""
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
    """The correlation maps of the whole of a reduced scan, made when they are used. Marks that look otherwise in every
    orientation have dozens, each as large as the reduced scan: what all searches of a scan cache together is limited,
    and what is not cached any more is made again."""

    def __init__(
        self,
        scan: Scan,
        reduction: int,
        template_set: TemplateSet,
        cache: ByteCache[Map],
    ) -> None:
        self._scan, self._reduction, self._set, self._cache = scan, reduction, template_set, cache
        self._own = object()  # stands for these maps in the cache

    def __getitem__(self, key: Key) -> Map:
        map_ = self._cache.get((self._own, key))
        return self._make(key[0])[key] if map_ is None else map_

    def __iter__(self) -> Iterator[Key]:
        return ((kind, sign) for kind in range(len(self._set.templates)) for sign in self._set.signs)

    def __len__(self) -> int:
        return len(self._set.templates) * len(self._set.signs)

    def _make(self, first: int) -> dict[Key, Map]:
        """The maps of a kind and of as many later ones alike in detail as have room: they share most of their work."""
        height, width = self._scan.height_px // self._reduction, self._scan.width_px // self._reduction
        kind_bytes = 4 * height * width * len(self._set.signs)
        most = max(self._cache.limit_bytes // kind_bytes, 1)
        details, sign = self._set.details_px, next(iter(self._set.signs))
        missing = [
            kind
            for kind in range(first, len(details))
            if details[kind] == details[first] and self._cache.get((self._own, (kind, sign))) is None
        ][:most]
        self._cache.make_room(len(missing) * kind_bytes)
        maps = self._set.maps(missing, self._pictures())
        for key, map_ in maps.items():
            self._cache.put((self._own, key), map_, map_.nbytes)
        return maps

    def _pictures(self) -> Iterator[Map]:
        """The reduced scan in every channel, its edge repeated beyond it."""
        half = self._set.half_px
        for weights in _channels(self._scan):
            grey = self._scan.reduced(self._reduction, weights)
            yield np.asarray(cv2.copyMakeBorder(grey, half, half, half, half, cv2.BORDER_REPLICATE), np.float32)


class Dilation:
    """The highest response within a radius of every place, area_px large, and what the background answers: nineteen in
    twenty places stay below it."""

    def __init__(self, map_: Map, origin: NDArray[np.int_], radius_px: float) -> None:
        size = 2 * round(radius_px) + 1
        disk = np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)), np.uint8)
        self.map, self.origin, self.area_px = np.asarray(cv2.dilate(map_, disk)), origin, int(disk.sum())
        self.background = max(float(np.percentile(self.map[_SAMPLED, _SAMPLED], _BACKGROUND_PERCENT)), 0.0)

    def share(self, place: Array) -> float:
        """Of all places, those that answer as strongly as the one (2,) of the reduced scan."""
        return float(np.mean(self.map >= self.height(place)))

    def height(self, place: Array) -> float:
        """The highest response within the radius of a place (2,) of the reduced scan."""
        col, row = np.clip(np.rint(place).astype(int) - self.origin, 0, np.array(self.map.shape[::-1]) - 1)
        return float(self.map[row, col])

    def strength(self, places: NDArray[np.int_]) -> tuple[Array, Mask]:
        """How much the places (n, 2) of the reduced scan answer beyond the background, and which of them lie in the
        map; those that do not have no answer."""
        rows, cols = self.map.shape
        col, row = (places - self.origin).T
        inside = (col >= 0) & (row >= 0) & (col < cols) & (row < rows)
        response = np.where(inside, self.map[np.clip(row, 0, rows - 1), np.clip(col, 0, cols - 1)], 0.0).astype(float)
        return np.maximum(np.maximum(response, 0.0) ** 2 - self.background**2, 0.0), inside


class ResponseMap:
    """The responses to one template, and what every orientation and hypothesis that shares them derives from them."""

    def __init__(self, responses: "Responses", key: Key) -> None:
        self._responses, self._key = responses, key
        self._own = object()  # stands for this map in the cache, which would else hold the map that holds it
        self.origin = np.zeros(2, dtype=int) if responses.origins is None else responses.origins[key[0]]

    @property
    def map(self) -> Map:
        return self._responses.maps[self._key]

    @cached_property
    def candidates(self) -> Array:
        """(n, 2) px of the reduced scan."""
        return np.asarray(local_maxima(self.map, _CANDIDATES, _LEAST_RESPONSE)[0] + self.origin)

    def dilated(self, radius_px: float) -> Dilation:
        """Dilated by a radius, to whole pixels."""
        key, cache = (self._own, round(radius_px)), self._responses.cache
        dilation = cache.get(key)
        if dilation is None:
            dilation = Dilation(self.map, self.origin, radius_px)
            cache.put(key, dilation, dilation.map.nbytes)
        return dilation

    def highest_about(self, places: Array, radius_px: float) -> tuple[Array, Array]:
        """The highest responses about places (n, 2) of the reduced scan, and (n,) how high; 0 outside of the map."""
        tops, heights = highest_about(self.map, places - self.origin, radius_px)
        return tops + self.origin, heights


@dataclass(frozen=True, eq=False)
class Responses:
    """Correlations with the templates of mark views, over the reduced scan.

    maps: by the kind of template and the sign, +1 or -1, (rows, columns) of how much the place looks like the mark
    lighter or darker than its ground. kinds: of each mark view. reduction: by which the scan was reduced. cache: of
    dilations, and of others of the scan. origins: (kinds, 2) column and row of the reduced scan where the maps of each
    kind begin; None: they hold all of it. surroundings: what counts about a mark.
    """

    maps: Mapping[Key, Map]
    kinds: tuple[int, ...]
    reduction: int
    cache: ByteCache[Dilation]
    origins: NDArray[np.int_] | None = None
    surroundings: Surroundings = WIDE

    @cached_property
    def by_key(self) -> dict[Key, ResponseMap]:
        """By the kind of template and the sign."""
        return {key: ResponseMap(self, key) for key in self.maps}

    def reduced_px(self, scan_px: Array) -> Array:
        """Scan pixels (..., 2) in pixels of the reduced scan."""
        return np.asarray((scan_px - (self.reduction - 1) / 2) / self.reduction)

    def scan_px(self, reduced_px: Array) -> Array:
        """Pixels of the reduced scan (..., 2) in scan pixels."""
        return np.asarray(reduced_px * self.reduction + (self.reduction - 1) / 2)


def correlate_scan(
    scan: Scan,
    views: Sequence[MarkView],
    signs: Collection[int],
    surroundings: Surroundings,
    caches: tuple[ByteCache[Map], ByteCache[Dilation]],
    half_px: int = FULL.half_px,
) -> Responses:
    """The responses of the whole scan to mark views, lighter (+1) or darker (-1) than the ground as signs says.

    caches: of correlation maps and of dilations. half_px: of the reduced scan, how far about its point a cross is drawn
    at most.
    """
    reduction = search_reduction(scan, views)
    templates, kinds = distinct_templates(views, reduction, half_px)
    details = [ground_detail_px(views[kinds.index(kind)], reduction) for kind in range(len(templates))]
    template_set = TemplateSet(templates, details, signs, surroundings, scan.full_scale_dn * FAINT)
    maps = ScanMaps(scan, reduction, template_set, caches[0])
    return Responses(maps, kinds, reduction, caches[1], surroundings=surroundings)


def correlate_windows(
    scan: Scan,
    views: Sequence[MarkView],
    places_px: Array,
    reach_px: float,
    signs: Collection[int],
    cache: ByteCache[Dilation],
    half_px: int = FULL.half_px,
) -> Responses:
    """The responses to each mark view about its place (n, 2) in the scan alone, as far as reach_px and a little
    farther: of the file only these windows are read. A kind is a template at one place."""
    reduction = search_reduction(scan, views)
    templates, template_numbers = distinct_templates(views, reduction, half_px)
    details = [ground_detail_px(views[0], reduction)] * len(templates)
    template_set = TemplateSet(templates, details, signs, WIDE, scan.full_scale_dn * FAINT)
    reach, half = int(np.ceil(reach_px / reduction)), template_set.half_px
    # Row by row: strips of the file that windows share are still decoded for the next one.
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
