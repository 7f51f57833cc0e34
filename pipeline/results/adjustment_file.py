"""`adjustment.json`, the adjustment with its input, and `adjustment.npz`, its covariance."""

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from adjust.solution.result import Adjustment
from pipeline.errors import InputError
from pipeline.provenance import hash_file
from pipeline.results.adjustment_content import adjustment_record
from pipeline.results.adjustment_record import AdjustmentRecord
from pipeline.results.covariance_file import AGAIN, covariance_arrays, covariance_path
from pipeline.results.record_json import json_text, read_record
from pipeline.text.files import atomic_path
from pipeline.types import Array


def write_adjustment(
    adjustment: Adjustment,
    path: Path,
    made_from: Mapping[str, str] | None = None,
    frames_mm: Mapping[str, tuple[float, float]] | None = None,
) -> None:
    """Write the adjustment to `path` and its covariance to `adjustment.npz` in the same folder, atomically.

    Angles are in degrees in the JSON file and in rad in the covariance. Cameras without images and unobserved points
    are left out. If no object point is observed, the exterior orientations are null, and the cameras keep their given
    values with null sigmas.

    Parameters
    ----------
    made_from
        Fingerprints of the input; the covariance file holds the fingerprint of the JSON file.
    frames_mm
        Frame size (width, height) by camera.

    Raises
    ------
    InputError
        If a file cannot be written.
    """
    write_with_covariance(
        path, json_text(adjustment_record(adjustment, frames_mm, made_from)), lambda: covariance_arrays(adjustment)
    )


def write_with_covariance(
    path: Path, text: Iterable[str], arrays: Callable[[], Mapping[str, NDArray[np.generic]]]
) -> None:
    """Write the pieces of an adjustment.json, then the arrays of its covariance with its fingerprint.

    Both files are complete before either is replaced, so that the covariance always matches the adjustment.
    """
    with atomic_path(covariance_path(path)) as covariance, atomic_path(path) as result:
        with result.open("w", encoding="utf-8", newline="\n") as file:
            file.writelines(text)
        with covariance.open("wb") as data:
            np.savez_compressed(data, allow_pickle=False, fingerprint=np.array(hash_file(result)), **arrays())


def observed_mm(path: Path, content: AdjustmentRecord, camera: str) -> Array:
    """Camera coordinates (n, 2) of a camera's observations, mm. Raises InputError if it has none."""
    places = content.observed_mm(camera)
    if not len(places):
        raise InputError(f"{path}: no image of {camera!r} has an observation, so nothing says how large its frame is.")
    return places


def read_adjustment(path: Path) -> AdjustmentRecord:
    """Read `adjustment.json`.

    Raises
    ------
    InputError
        If the file is missing, is not JSON, lacks a key, or has an invalid value.
    """
    try:
        return read_record(AdjustmentRecord, path, AGAIN)
    except FileNotFoundError:
        raise InputError(f"{path}: there is no such file. Run `reseau adjust` first.") from None
    except IsADirectoryError:
        raise InputError(f"{path}: is a folder; an adjustment.json is needed here.") from None
