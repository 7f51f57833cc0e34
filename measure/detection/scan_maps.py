"""The correlations of a whole scan with the looks of marks, made when they are asked for, and the last of them held."""

from collections import OrderedDict
from collections.abc import Collection, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from measure.detection.correlation import Map, Surroundings, correlation, variation
from measure.scans.scan import Scan

Array = NDArray[np.float64]

Kept = TypeVar("Kept")

Key = tuple[int, int]


class Held(Generic[Kept]):
    """Things by a key each. The one asked for longest ago goes first where there is no room."""

    def __init__(self, limit_bytes: int) -> None:
        self.limit_bytes = limit_bytes
        self._kept: OrderedDict[Hashable, tuple[Kept, int]] = OrderedDict()
        self._bytes = 0

    def find(self, key: Hashable) -> Kept | None:
        """What is held of a key, None if nothing is."""
        if key not in self._kept:
            return None
        self._kept.move_to_end(key)
        return self._kept[key][0]

    def keep(self, key: Hashable, kept: Kept, size_bytes: int) -> None:
        """Hold what is not held yet."""
        self.make_room(size_bytes)
        self._kept[key] = kept, size_bytes
        self._bytes += size_bytes

    def make_room(self, size_bytes: int) -> None:
        """Let go of the oldest until so much more can be held, or nothing is."""
        while self._kept and self._bytes + size_bytes > self.limit_bytes:
            self._bytes -= self._kept.popitem(last=False)[1][1]


@dataclass(frozen=True)
class Sought:
    """What is sought: templates of the kinds of looks; details_px: of the reduced scan, the width of what is no ground
    beside each; lighter (+1) or darker (-1) than their surroundings, as signs says; contrast of faint_dn is rounding.
    """

    templates: Sequence[Array]
    details_px: Sequence[float]
    signs: Collection[int]
    surroundings: Surroundings
    faint_dn: float

    @property
    def half_px(self) -> int:
        """How far beyond its maps a picture has to reach."""
        return max(len(template) for template in self.templates) // 2

    def maps(self, kinds: Iterable[int], pictures: Iterable[Map]) -> dict[Key, Map]:
        """The maps of kinds that are alike in detail, by kind and sign, from the pictures that all channels show: the
        one that answers best at a place counts there. Where the same pixels count, as in one chip in its eight poses,
        the picture's variation is the same."""
        kinds, maps = list(kinds), dict[Key, Map]()
        detail_px = self.details_px[kinds[0]]
        for picture in pictures:
            image = self.surroundings.flattened(picture, detail_px, self.faint_dn)
            patterns = {kind: self.surroundings.pattern(self.templates[kind], detail_px, image) for kind in kinds}
            inner = tuple(side - 2 * self.half_px for side in image.shape)
            for own in _grouped(kinds, {kind: patterns[kind][1].tobytes() for kind in kinds}):
                varied = variation(image, patterns[own[0]][1])
                for kind in own:
                    _strongest(maps, kind, self.signs, _within(correlation(image, *patterns[kind], varied), inner))
        return maps


class ScanMaps(Mapping[Key, Map]):
    """The maps of what is sought in the whole of a reduced scan. Marks that look otherwise in every pose have dozens,
    each as large as the reduced scan: what all searches of a scan hold together is limited, and what is not held any
    more is made again."""

    def __init__(
        self, scan: Scan, reduction: int, channels: Sequence[Sequence[float]], sought: Sought, held: Held[Map]
    ) -> None:
        self._scan, self._reduction, self._channels, self._sought, self._held = scan, reduction, channels, sought, held
        self._own = object()  # stands for these maps in what is held
        self.shape = scan.height_px // reduction, scan.width_px // reduction

    def __getitem__(self, key: Key) -> Map:
        map_ = self._held.find((self._own, key))
        return self._made(key[:1])[key] if map_ is None else map_

    def __iter__(self) -> Iterator[Key]:
        return ((kind, sign) for kind in range(len(self._sought.templates)) for sign in self._sought.signs)

    def __len__(self) -> int:
        return len(self._sought.templates) * len(self._sought.signs)

    def expect(self, kinds: Sequence[int], later: Sequence[int]) -> None:
        """Kinds that are asked for next, and those later on. If any of the next is missing, all are made that can be
        held: kinds of one chip share most of their work."""
        if all(self._is_held(kind) for kind in dict.fromkeys(kinds)):
            return
        every = list(dict.fromkeys([*kinds, *later]))[: max(self._held.limit_bytes // self._kind_bytes, 1)]
        missing = [kind for kind in every if not self._is_held(kind)]
        for own in _grouped(missing, dict(enumerate(self._sought.details_px))):
            self._made(own)

    @property
    def _kind_bytes(self) -> int:
        return 4 * self.shape[0] * self.shape[1] * len(self._sought.signs)

    def _is_held(self, kind: int) -> bool:
        return all(self._held.find((self._own, (kind, sign))) is not None for sign in self._sought.signs)

    def _made(self, kinds: Sequence[int]) -> dict[Key, Map]:
        """The maps of kinds that are alike in detail, from now on held."""
        self._held.make_room(len(kinds) * self._kind_bytes)
        maps = self._sought.maps(kinds, self._pictures())
        for key, map_ in maps.items():
            self._held.keep((self._own, key), map_, map_.nbytes)
        return maps

    def _pictures(self) -> Iterator[Map]:
        """The reduced scan in every channel, its edge repeated beyond it."""
        half = self._sought.half_px
        for weights in self._channels:
            grey = self._scan.reduced(self._reduction, weights)
            yield np.asarray(cv2.copyMakeBorder(grey, half, half, half, half, cv2.BORDER_REPLICATE), np.float32)


def _grouped(kinds: Iterable[int], key: Mapping[int, object]) -> list[list[int]]:
    """The kinds whose keys are equal, together."""
    groups: dict[object, list[int]] = {}
    for kind in kinds:
        groups.setdefault(key[kind], []).append(kind)
    return list(groups.values())


def _strongest(maps: dict[Key, Map], kind: int, signs: Collection[int], response: Map) -> None:
    """Keep at every place the strongest response of all channels."""
    for sign in signs:
        signed = response if sign > 0 else -response
        known = maps.setdefault((kind, sign), signed)
        np.maximum(known, signed, out=known)


def _within(response: Map, shape: tuple[int, ...]) -> Map:
    """The middle (rows, columns) of a response that reaches as far beyond it on every side."""
    row0, col0 = ((whole - part) // 2 for whole, part in zip(response.shape, shape, strict=True))
    return response[row0 : row0 + shape[0], col0 : col0 + shape[1]]
