"""Scans that nobody has measured just now, kept as `reseau measure` would keep them."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from pipeline.archive.checked_statuses import CheckedResult, checked_scans, find_judging, judge
from pipeline.archive.measurement import remember_place
from pipeline.archive.results_database import Kept, Store
from pipeline.provenance import Identity, file_state, parts_hash
from pipeline.results.comparator_file import read_measurement_hash
from pipeline.results.measured_record import MeasuredScan, mark_row, scan_detail


def keep_scans(path: Path, scans: Sequence[MeasuredScan], made_from: Mapping[str, str] | None = None) -> str:
    """In the store at `path` of the project whose folder is above its own; the digest of their judging."""
    folder = path.parent.parent.resolve()
    with Store(path) as store:
        remember_place(store, folder)
        frames = []
        for scan in scans:
            identity = Identity(file_state(Path(scan.scan), folder), parts_hash(Path(scan.scan)))
            row = store.keep(Kept(identity, "{}", scan), scan.frame.image, current=True)
            frames.append(CheckedResult(row, scan))
        return judge(store, made_from or {}, "kept", frames)


def content(file: Path) -> bytes:
    """Of a result; of a store what it says of the marks that stand in comparator.csv, and not which page it stands on
    nor when it was measured; of thumbnails, which may be deleted, nothing."""
    if file.name.startswith("thumbnails"):
        return b""
    if file.suffix != ".db":
        return file.read_bytes()
    comparator = file.parents[1] / "comparator.csv"
    with Store(file) as store:
        judging = find_judging(store, read_measurement_hash(comparator)) if comparator.exists() else None
        scans = () if judging is None else checked_scans(store, judging, file.parent)
        kept = [[scan_detail(scan, ""), *map(mark_row, scan.frame.marks)] for scan in scans]
        return b"" if judging is None else repr([judging.digest, *kept]).encode()
