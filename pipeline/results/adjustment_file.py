"""`adjustment.json`, the result with everything it came from, and `adjustment.npz`, its full covariance."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from adjust.solution.result import Adjustment
from pipeline.errors import InputError
from pipeline.provenance import hash_file
from pipeline.results.adjustment_content import adjustment_record
from pipeline.results.adjustment_record import AdjustmentRecord
from pipeline.results.covariance_file import AGAIN, covariance_arrays, covariance_path
from pipeline.results.record_json import json_text, read_record
from pipeline.text.atomic import atomic_path
from pipeline.types import Array


def write_adjustment(
    adjustment: Adjustment,
    path: Path,
    made_from: Mapping[str, str] | None = None,
    frames_mm: Mapping[str, tuple[float, float]] | None = None,
) -> None:
    """Write the result to `path` and its covariance beside it, each by way of a temporary file.

    Angles are in degrees in the JSON file and in rad in the covariance. A camera without an image and a point that no
    image shows are not in it. Where no object point is observed, there is no exterior orientation (null) and no
    calibration (a camera's values are those given, their sigmas null).

    Parameters
    ----------
    made_from
        Fingerprints of all that was adjusted; the covariance has that of the JSON file.
    frames_mm
        By camera the size of its frame.

    Raises
    ------
    InputError
        Where a file cannot be written.
    """
    record = adjustment_record(adjustment, frames_mm, made_from)
    # Both are whole before either takes its place: a covariance belongs to its adjustment.
    with atomic_path(covariance_path(path)) as covariance, atomic_path(path) as result:
        with result.open("w", encoding="utf-8", newline="\n") as file:
            file.writelines(json_text(record))
        del record
        fingerprint, arrays = np.array(hash_file(result)), covariance_arrays(adjustment)
        with covariance.open("wb") as data:
            np.savez_compressed(data, allow_pickle=False, fingerprint=fingerprint, **arrays)


def observed_mm(path: Path, content: AdjustmentRecord, camera: str) -> Array:
    """Where a camera has observations (n, 2), in its frame. Raises InputError where it has none."""
    places = content.observed_mm(camera)
    if not len(places):
        raise InputError(f"{path}: no image of {camera!r} has an observation, so nothing says how large its frame is.")
    return places


def read_adjustment(path: Path) -> AdjustmentRecord:
    """Read `adjustment.json`.

    Raises
    ------
    InputError
        For a file that is missing, no JSON, or lacks a key or has a wrong value at one.
    """
    try:
        return read_record(AdjustmentRecord, path, AGAIN)
    except FileNotFoundError:
        raise InputError(f"{path}: there is no such file. Run `reseau adjust` first.") from None
    except IsADirectoryError:
        raise InputError(f"{path}: is a folder; an adjustment.json is needed here.") from None
