"""The pictures of the marks as the report asks for them: kept when they were measured, or cut from their scans."""

from collections.abc import Collection, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Self

import numpy as np

from measure.errors import MeasurementError
from measure.results import MarkMeasurement
from measure.scans.opening import open_scan
from measure.scans.remote import scan_path
from measure.scans.scan import Scan
from pipeline.archive.thumbnails import ThumbnailStore, thumbnails_path
from pipeline.errors import InputError
from pipeline.results.measured_scan import MeasuredScan
from pipeline.results.thumbnail import Thumbnail, cut

_OFF_MIDDLE = 0.25  # of a picture's width: a mark farther off was measured again since


class Thumbnails:
    """Windows about marks, by image, point and kind; one scan is open at a time, none behind the `with` block."""

    def __init__(
        self,
        scans: Collection[MeasuredScan],
        max_pixels: int | None = None,
        measurement: Path | None = None,
        fingerprints: Mapping[str, str] | None = None,
    ) -> None:
        """measurement: the store beside which thumbnails were kept; fingerprints: by image, of the results in it."""
        self._max_pixels = max_pixels
        self._scans = {scan.frame.image: scan for scan in scans}
        self._marks = {
            (s.frame.image, mark.point, mark.kind == "fiducial"): mark for s in scans for mark in s.frame.marks
        }
        self._fingerprints = fingerprints or {}
        is_kept = measurement is not None and thumbnails_path(measurement).exists()
        self._kept: ThumbnailStore | None = None
        if is_kept and measurement is not None:
            with suppress(InputError):  # of a damaged file, without which pictures are cut from the scans
                self._kept = ThumbnailStore.beside(measurement)
        self._open: tuple[Path, Scan] | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._open is not None:
            self._open[1].close()
        if self._kept is not None:
            self._kept.close()

    def of(self, image: str, point: str, kind: str) -> Thumbnail | None:
        """The picture of a mark; None where it has no place, or its scan cannot be read any more."""
        mark = self._marks.get((image, point, kind == "fiducial"))
        if mark is None or mark.center_px is None:
            return None
        if (kept := self._kept_of(image, mark)) is not None:
            return kept
        try:
            return cut(self._scan(scan_path(self._scans[image].scan)), mark)
        except MeasurementError:
            return None

    def _kept_of(self, image: str, mark: MarkMeasurement) -> Thumbnail | None:
        stored = self._kept and self._kept.of(self._fingerprints.get(image, ""), mark.point, mark.kind)
        if not stored or mark.center_px is None:
            return None
        thumbnail = stored.thumbnail
        width_px = np.array(thumbnail.pixels.shape[::-1]) * thumbnail.step_px
        middle_px = thumbnail.origin_px + (width_px - thumbnail.step_px) / 2.0
        return thumbnail if (np.abs(mark.center_px - middle_px) < _OFF_MIDDLE * width_px).all() else None

    def _scan(self, path: Path) -> Scan:
        if self._open is None or self._open[0] != path:
            if self._open is not None:
                self._open[1].close()
            self._open = (path, open_scan(path, self._max_pixels))
        return self._open[1]
