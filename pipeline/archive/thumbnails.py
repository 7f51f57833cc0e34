"""out/thumbnails.db: small pictures of all that was measured, so that nobody opens the scans again to look at a mark.

It holds nothing that the scans do not: it may be deleted, and then pictures are cut from the scans again.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Self

from pipeline.archive.schema import STORE_ERRORS, Schema, opened, store_error
from pipeline.results.thumbnail import StoredThumbnail

_FIRST = """
create table thumbnail (
    fingerprint text not null,               -- of the result in measurement.db
    point text not null, kind text not null, -- of the mark; '' and 'frame' of the whole scan
    col_px real not null, row_px real not null,   -- in the scan, of the centre of the picture's top-left pixel
    step_px real not null,                   -- pixels of the scan to one of the picture
    jpeg blob not null,
    primary key (fingerprint, point, kind)
);
"""
_DIGESTS = "alter table thumbnail add column digest text"  # BLAKE2b of the picture and where it lies; null: not known
_SCHEMA = Schema(0x52455354, (_FIRST, _DIGESTS), "thumbnails")  # "REST"
_DIGEST = "row_digest(point, kind, col_px, row_px, step_px, jpeg)"
_COLUMNS = "point, kind, col_px, row_px, step_px, jpeg"


class ThumbnailStore:
    """The thumbnails beside a store of measurements, open. Closed behind the `with` block."""

    def __init__(self, path: Path) -> None:
        """Raises InputError for a file that is no such store."""
        self._path, self._db = path, opened(path, _SCHEMA)

    @classmethod
    def beside(cls, measurement: Path) -> "ThumbnailStore":
        """Those of a store of measurements."""
        return cls(thumbnails_path(measurement))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        """Raises InputError for what SQLite refused of this file in the block."""
        self.close()
        if isinstance(error, STORE_ERRORS):
            raise store_error(self._path, "thumbnails", error) from error

    def close(self) -> None:
        self._db.close()

    def keep(self, fingerprint: str, thumbnails: Sequence[StoredThumbnail]) -> None:
        """Of one result, all or none."""
        self._db.execute("begin immediate")
        self._db.executemany(
            f"insert or replace into thumbnail (fingerprint, {_COLUMNS}) values (?, ?, ?, ?, ?, ?, ?)",
            ((fingerprint, one.point, one.kind, *one.origin_px, one.step_px, one.jpeg) for one in thumbnails),
        )
        self._db.execute(f"update thumbnail set digest = {_DIGEST} where fingerprint = ?", (fingerprint,))
        self._db.execute("commit")

    def of(self, fingerprint: str, point: str = "", kind: str = "frame") -> StoredThumbnail | None:
        """That of a mark of a result, or of the whole scan; None where there is none that is as it was written."""
        where = f"fingerprint = ? and point = ? and kind = ? and digest is {_DIGEST}"
        try:
            found = self._db.execute(
                f"select {_COLUMNS} from thumbnail where {where}", (fingerprint, point, kind)
            ).fetchone()
        except STORE_ERRORS:  # the scan itself is there
            return None
        if found is None:
            return None
        point, kind, col_px, row_px, step_px, jpeg = found
        return StoredThumbnail(point, kind, (col_px, row_px), step_px, jpeg)

    def rekey(self, keys: Mapping[str, str]) -> None:
        """Results have other fingerprints now; keys: the new ones by the old."""
        self._db.execute("begin immediate")
        self._db.executemany(
            "update or ignore thumbnail set fingerprint = ? where fingerprint = ?",
            ((new, old) for old, new in keys.items()),
        )
        self._db.execute("commit")

    def take(self, measurements: Sequence[Path]) -> None:
        """Those beside other stores of measurements, as far as there are any."""
        for path in filter(Path.is_file, map(thumbnails_path, measurements)):
            opened(path, _SCHEMA).close()
            self._db.execute("attach ? as other", (str(path),))
            columns = f"fingerprint, {_COLUMNS}, digest"
            self._db.execute(f"insert or ignore into thumbnail ({columns}) select {columns} from other.thumbnail")
            self._db.execute("detach other")


def thumbnails_path(measurement: Path) -> Path:
    """Where the thumbnails of a store of measurements stand."""
    return measurement.with_name(f"thumbnails{measurement.name.removeprefix('measurement')}")
