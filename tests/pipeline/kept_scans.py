"""Scans that nobody has measured just now, kept as `reseau measure` would keep them."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from pipeline.archive.checked_statuses import JudgedScan, judge, judged_records, judging_of
from pipeline.archive.measurement import tell_place
from pipeline.archive.results_database import Kept, Store
from pipeline.provenance import Identity, file_state, parts_hash
from pipeline.results.comparator_file import measurement_of
from pipeline.results.measured_record import MeasuredScan, record_of


def keep_scans(path: Path, scans: Sequence[MeasuredScan], made_from: Mapping[str, str] | None = None) -> str:
    """In the store at `path` of the project whose folder is above its own; the digest of their judging."""
    folder = path.parent.parent.resolve()
    with Store(path) as store:
        tell_place(store, folder)
        frames = []
        for scan in scans:
            record, name = record_of(scan, folder), scan.frame.image
            identity = Identity(file_state(Path(scan.scan), folder), parts_hash(Path(scan.scan)))
            frames.append(JudgedScan(name, store.keep(Kept(identity, "{}", record), name, current=True), record))
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
        judging = judging_of(store, measurement_of(comparator)) if comparator.exists() else None
        return b"" if judging is None else repr([judging.digest, *judged_records(store, judging)]).encode()
