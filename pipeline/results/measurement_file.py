"""measurement.json: what comparator.csv has no room for: poses and their evidence, covariances, qualities, problems."""

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path

from pipeline.errors import InputError
from pipeline.results.measured_record import record_of, scan_of
from pipeline.results.measured_scan import MeasuredScan
from pipeline.text.atomic import write_atomically
from pipeline.text.text_file import read_json


def write_measurement(
    path: Path, scans: Sequence[MeasuredScan], folder: Path | None = None, made_from: Mapping[str, str] | None = None
) -> None:
    """Write measurement.json. Raises InputError where it cannot be written.

    folder: where it is to stand, if not at `path`. made_from: fingerprints of what was measured and how.
    """
    images = {scan.frame.image: record_of(scan, folder or path.parent) for scan in scans}
    content = {"reseau": version("reseau"), "made_from": dict(made_from or {}), "images": images}
    write_atomically(path, json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False) + "\n")


def read_measurement(path: Path, folder: Path | None = None) -> tuple[MeasuredScan, ...]:
    """Read it back. Raises InputError for a file that is broken. folder: as above."""
    with _told(path):
        images = read_json(path)["images"]
        return tuple(scan_of(name, image, folder or path.parent) for name, image in images.items())


def read_made_from(path: Path) -> Mapping[str, str]:
    """The fingerprints of what was measured and how. Raises InputError for a file that is broken."""
    with _told(path):
        return dict(read_json(path).get("made_from", {}))


@contextmanager
def _told(path: Path) -> Iterator[None]:
    try:
        yield
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: cannot be read as a measurement ({error}). Run `reseau measure` again.") from error
