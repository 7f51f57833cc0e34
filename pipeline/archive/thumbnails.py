"""out/thumbnails.db: thumbnails of all measured marks, so that viewing a mark does not reopen its scan.

It may be deleted: thumbnails are then cut from the scans again.
"""

from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Self

import numpy as np

from measure.errors import MeasurementError
from measure.scans.opening import open_scan
from measure.scans.remote import scan_path
from measure.scans.scan import Scan
from pipeline.archive.schema import DATABASE_ERRORS, THUMBNAILS, Database, Schema
from pipeline.errors import InputError
from pipeline.results.measured_record import MeasuredScan
from pipeline.results.thumbnail import WHOLE, Thumbnail, ThumbnailRow, cut

_FIRST = """
create table thumbnail (
    fingerprint text not null,               -- of the result in measurement.db
    point text not null, kind text not null, -- of the mark; '' and 'frame' of the whole scan
    col_px real not null, row_px real not null,   -- in the scan, of the centre of the picture's top-left pixel
    step_px real not null,                   -- pixels of the scan to one of the picture
    jpeg blob not null,
    digest text,                             -- BLAKE2b of the thumbnail and its location
    primary key (fingerprint, point, kind)
);
"""
_COLUMNS = "point, kind, col_px, row_px, step_px, jpeg"
_DIGEST = f"row_digest({_COLUMNS})"
_OFF_MIDDLE = 0.25  # fraction of a thumbnail's width: a mark farther off its middle was measured again since


class ThumbnailDatabase(Database):
    """Open database of thumbnails beside a results database; closed at the end of the `with` block."""

    schema = Schema(THUMBNAILS, 2, (_FIRST,), "thumbnails")

    def __init__(self, measurement: Path) -> None:
        """Open the thumbnails of a results database."""
        super().__init__(thumbnails_path(measurement))

    def keep(self, fingerprint: str, thumbnails: Sequence[ThumbnailRow]) -> None:
        """Store the thumbnails of one result, all or none."""
        with self.writing():
            self.connection.executemany(
                f"insert or replace into thumbnail (fingerprint, {_COLUMNS}) values (?, ?, ?, ?, ?, ?, ?)",
                ((fingerprint, *row) for row in thumbnails),
            )
            self.connection.execute(f"update thumbnail set digest = {_DIGEST} where fingerprint = ?", (fingerprint,))

    def get(self, fingerprint: str, point: str = WHOLE[0], kind: str = WHOLE[1]) -> Thumbnail | None:
        """Thumbnail of a mark, or of the whole scan; None where it is missing or damaged."""
        where = f"fingerprint = ? and point = ? and kind = ? and digest is {_DIGEST}"
        try:
            found = self.connection.execute(
                f"select {_COLUMNS} from thumbnail where {where}", (fingerprint, point, kind)
            ).fetchone()
        except DATABASE_ERRORS:  # fall back to the scan itself
            return None
        return None if found is None else Thumbnail.from_row(found)

    def rekey(self, keys: Mapping[str, str]) -> None:
        """Replace fingerprints of results. keys: {old: new}."""
        with self.writing():
            update = "update or ignore thumbnail set fingerprint = ?2 where fingerprint = ?1"
            self.connection.executemany(update, keys.items())

    def take(self, measurements: Sequence[Path]) -> None:
        """Import the thumbnails of other results databases that have some."""
        columns = f"fingerprint, {_COLUMNS}, digest"
        for measurement in measurements:
            if (path := thumbnails_path(measurement)).is_file():
                ThumbnailDatabase(measurement).close()
                self.connection.execute("attach ? as other", (str(path),))
                self.connection.execute(
                    f"insert or ignore into thumbnail ({columns}) select {columns} from other.thumbnail"
                )
                self.connection.execute("detach other")


def thumbnails_path(measurement: Path) -> Path:
    """Path of the thumbnails of a results database."""
    return measurement.with_name(f"thumbnails{measurement.name.removeprefix('measurement')}")


class Thumbnails:
    """Windows around marks, by image, point and kind. One scan is open at a time, until the end of the `with` block."""

    def __init__(
        self,
        scans: Collection[MeasuredScan],
        max_pixels: int | None,
        measurement: Path,
        fingerprints: Mapping[str, str],
    ) -> None:
        """Prepare the windows of the scans' marks.

        measurement: results database, beside which thumbnails may be stored; fingerprints: {image: that of its result}.
        """
        self._max_pixels = max_pixels
        self._scans = {scan.frame.image: scan for scan in scans}
        self._marks = {(s.frame.image, m.point, m.kind == "fiducial"): m for s in scans for m in s.frame.marks}
        self._fingerprints = fingerprints
        self._kept: ThumbnailDatabase | None = None
        if thumbnails_path(measurement).exists():
            with suppress(InputError):  # a damaged file: thumbnails are cut from the scans instead
                self._kept = ThumbnailDatabase(measurement)
        self._open: tuple[Path, Scan] | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._open is not None:
            self._open[1].close()
        if self._kept is not None:
            self._kept.close()

    def get(self, image: str, point: str, kind: str) -> Thumbnail | None:
        """Thumbnail of a mark; None where the mark has no place or its scan cannot be read."""
        mark = self._marks.get((image, point, kind == "fiducial"))
        if mark is None or mark.center_px is None:
            return None
        if kept := self._kept and self._kept.get(self._fingerprints.get(image, ""), mark.point, mark.kind):
            width_px = np.array(kept.pixels.shape[::-1]) * kept.step_px
            middle_px = kept.origin_px + (width_px - kept.step_px) / 2.0
            if (np.abs(mark.center_px - middle_px) < _OFF_MIDDLE * width_px).all():
                return kept
        try:
            return cut(self._scan(scan_path(self._scans[image].scan)), mark)
        except MeasurementError:
            return None

    def _scan(self, path: Path) -> Scan:
        if self._open is None or self._open[0] != path:
            if self._open is not None:
                self._open[1].close()
            self._open = (path, open_scan(path, self._max_pixels))
        return self._open[1]
