"""`adjustment.json`, the adjustment with its input, and `adjustment.npz`, its covariance: writers and readers."""

import io
import zipfile
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adjust.problem.parameter import Parameter, as_parameter, parameters_from_texts
from adjust.quality.cofactor import larger_covariance
from adjust.solution.result import Adjustment
from pipeline.errors import InputError
from pipeline.provenance import hash_file
from pipeline.results.adjustment_content import adjustment_record, covariance_arrays
from pipeline.results.adjustment_record import AdjustmentRecord
from pipeline.results.record_json import json_text, read_record
from pipeline.text.files import RESULT_MB, FilePath, atomic_path, read_bytes
from pipeline.types import Array

AGAIN = "Run `reseau adjust` again; it writes both files."
_ARRAY_MB = 600  # names of the parameters of 50,000 images, of 80 letters each, have 190


@dataclass(frozen=True)
class ParameterCovariance:
    """A-posteriori covariance of the unknowns, in mm, object units and rad.

    Attributes
    ----------
    parameters, values : (n,).
    matrix : (n, n) covariance matrix.
    adjustment : fingerprint of the adjustment.json to which it belongs; "" if the file has none.
    clusters : jackknife covariance of camera parameters, leaving out one image at a time, for correlated errors within
        images; None if it was not computed.
    images : of a large network, whose matrix lacks the quantities of images: those of each image by themselves.
    """

    parameters: tuple[Parameter, ...]
    values: Array
    matrix: Array
    adjustment: str = ""
    clusters: "ParameterCovariance | None" = None
    images: "tuple[ParameterCovariance, ...]" = ()

    def select(self, parameters: Iterable[Parameter | str]) -> Array:
        """Covariance (k, k) of unknowns given by keys or by their texts in the file.

        It is zero for fixed ones, which the file does not list, and where a large network's file does not hold it.
        """
        keys = [as_parameter(each) for each in parameters]
        at = np.array([self._positions.get(key, -1) for key in keys], dtype=int)
        block: Array = self.matrix[np.ix_(at, at)]
        block[at < 0, :] = 0.0
        block[:, at < 0] = 0.0
        for image in {self._image_numbers[key] for key in keys if key in self._image_numbers}:
            own = [i for i, key in enumerate(keys) if self._image_numbers.get(key) == image]
            block[np.ix_(own, own)] = self.images[image].select(keys[i] for i in own)
        return block

    def select_larger(self, parameters: Sequence[Parameter]) -> Array:
        """Covariance as by `select`, enlarged in each direction in which that of `clusters` is larger."""
        block = self.select(parameters)
        return block if self.clusters is None else larger_covariance(block, self.clusters.select(parameters))

    def arrays(self) -> dict[str, NDArray[np.generic]]:
        """Arrays of the covariance file by name; without values for `clusters`."""
        names = np.array([each.text for each in self.parameters], dtype=np.str_)
        own = {"names": names, "values": self.values, "matrix": self.matrix}
        clusters = {} if self.clusters is None else self.clusters.arrays()
        return own | {f"cluster_{name}": clusters[name] for name in ("names", "matrix") if clusters}

    @cached_property
    def _positions(self) -> dict[Parameter, int]:
        return {each: i for i, each in enumerate(self.parameters)}

    @cached_property
    def _image_numbers(self) -> dict[Parameter, int]:
        return {each: i for i, image in enumerate(self.images) for each in image.parameters}


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
    record = adjustment_record(adjustment, frames_mm or {}, made_from or {})
    write_with_covariance(path, record, lambda: covariance_arrays(adjustment))


def write_with_covariance(
    path: Path, record: AdjustmentRecord, arrays: Callable[[], Mapping[str, NDArray[np.generic]]]
) -> None:
    """Write an adjustment.json, then the arrays of its covariance with its fingerprint.

    Both files are complete before either is replaced, so that the covariance always matches the adjustment.
    """
    with atomic_path(covariance_path(path)) as covariance, atomic_path(path) as result:
        with result.open("w", encoding="utf-8", newline="\n") as file:
            file.writelines(json_text(record))
        with covariance.open("wb") as data:
            np.savez_compressed(data, allow_pickle=False, fingerprint=np.array(hash_file(result)), **arrays())


def observed_mm(path: Path, content: AdjustmentRecord, camera: str) -> Array:
    """Camera coordinates (n, 2) of a camera's observations, mm. Raises InputError if it has none."""
    places = content.observed_mm(camera)
    if not len(places):
        raise InputError(f"{path}: no image of {camera!r} has an observation, so nothing says how large its frame is.")
    return places


def read_adjustment(path: FilePath) -> AdjustmentRecord:
    """Read `adjustment.json`.

    Raises
    ------
    InputError
        If the file is missing, is not JSON, lacks a key, or has an invalid value.
    """
    try:
        return read_record(AdjustmentRecord, Path(path), AGAIN)
    except FileNotFoundError:
        raise InputError(f"{path}: there is no such file. Run `reseau adjust` first.") from None
    except IsADirectoryError:
        raise InputError(f"{path}: is a folder; an adjustment.json is needed here.") from None


def covariance_path(path: Path) -> Path:
    """Path of the covariance file of an `adjustment.json`."""
    return path.with_suffix(".npz")


def read_covariance(path: Path) -> ParameterCovariance:
    """Read the covariance of the `adjustment.json` at `path`. Raises InputError if it is missing or damaged."""
    file = covariance_path(path)
    try:
        data = read_bytes(file, RESULT_MB)
    except (FileNotFoundError, IsADirectoryError):
        raise InputError(f"{file}: there is no such file; it goes with {path.name}. {AGAIN}") from None
    values = _array(data, "values", file)
    parameters, matrix = _named_matrix(data, "", file)
    if values.dtype.kind != "f" or values.shape != (len(parameters),):
        raise InputError(f"{file}: {len(parameters)} names do not fit values of shape {values.shape}. {AGAIN}")
    adjustment = str(_array(data, "fingerprint", file)) if b"fingerprint.npy" in data else ""
    clusters = None
    if b"cluster_names.npy" in data:
        keys, scatter = _named_matrix(data, "cluster_", file)
        clusters = ParameterCovariance(keys, np.full(len(keys), np.nan), scatter, adjustment)
    images = _images(data, file) if b"image_names.npy" in data else ()
    return ParameterCovariance(parameters, values.astype(np.float64), matrix, adjustment, clusters, images)


def _images(data: bytes, file: Path) -> tuple[ParameterCovariance, ...]:
    """Read the covariances of images that stand by themselves. Raises InputError if shapes or types do not match."""
    names, values, matrices = (_array(data, f"image_{name}", file) for name in ("names", "values", "matrices"))
    fits = names.ndim == 2 and values.shape == names.shape and matrices.shape == (*names.shape, names.shape[-1])
    if not fits or (names.dtype.kind, values.dtype.kind, matrices.dtype.kind) != ("U", "f", "f"):
        shapes = f"{names.shape}, {values.shape} and {matrices.shape}"
        raise InputError(f"{file}: names, values and matrices of images do not fit one another: {shapes}. {AGAIN}")
    blocks = []
    for own, value, matrix in zip(names, values, matrices, strict=True):
        count = int(np.count_nonzero(own != ""))
        try:
            parameters = parameters_from_texts([str(name) for name in own[:count]])
        except ValueError as error:
            raise InputError(f"{file}: {error}. {AGAIN}") from None
        blocks.append(ParameterCovariance(parameters, value[:count], matrix[:count, :count]))
    return tuple(blocks)


def _named_matrix(data: bytes, prefix: str, file: Path) -> tuple[tuple[Parameter, ...], Array]:
    """Read parameters and their covariance matrix. Raises InputError if their shapes or types do not match."""
    names, matrix = (_array(data, prefix + name, file) for name in ("names", "matrix"))
    if names.dtype.kind != "U" or matrix.dtype.kind != "f":
        kinds = f"{names.dtype} and {matrix.dtype}"
        raise InputError(f"{file}: names and matrix are to be text and real numbers, not {kinds}. {AGAIN}")
    if names.ndim != 1 or matrix.shape != (*names.shape, *names.shape):
        raise InputError(f"{file}: {names.size} names do not fit a matrix of shape {matrix.shape}. {AGAIN}")
    texts = tuple(str(name) for name in names)
    twice = next((name for name, count in Counter(texts).items() if count > 1), None)
    if twice is not None:
        raise InputError(f"{file}: {twice!r} is named twice. {AGAIN}")
    try:
        return parameters_from_texts(texts), matrix.astype(np.float64)
    except ValueError as error:
        raise InputError(f"{file}: {error}. {AGAIN}") from None


def read_own_covariance(path: Path) -> ParameterCovariance:
    """Read the covariance as `read_covariance` does. Raises InputError if it belongs to another adjustment."""
    covariance = read_covariance(path)
    if covariance.adjustment not in ("", hash_file(path)):
        raise InputError(
            f"{covariance_path(path)}: is of another adjustment than {path}. Bring both files of one adjustment "
            "together, or run `reseau adjust` again."
        )
    return covariance


def _array(data: bytes, name: str, file: Path) -> NDArray[Any]:
    """Read an array of an npz file, of limited size."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive, archive.open(f"{name}.npy") as member:
            unpacked = io.BytesIO(member.read(_ARRAY_MB * 1_000_000))
        return np.asarray(np.lib.format.read_array(unpacked, allow_pickle=False))
    except Exception as error:  # zipfile, zlib and numpy raise various errors for a damaged file
        raise InputError(f"{file}: is not a covariance file ({name}: {error}). {AGAIN}") from None
