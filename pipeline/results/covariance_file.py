"""`adjustment.npz`: covariance matrix of all quantities of an adjustment; for a large network, blocks of it."""

import io
import zipfile
from collections import Counter
from collections.abc import Iterable, Sequence
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
from pipeline.text.files import MOST_MB, read_bytes
from pipeline.types import Array, Indices

AGAIN = "Run `reseau adjust` again; it writes both files."
AFFORDABLE = 3000  # largest number of quantities whose covariance is written as one matrix


@dataclass(frozen=True)
class Covariance:
    """A-posteriori covariance of the unknowns, in mm, object units and rad.

    Attributes
    ----------
    parameters, values : (n,).
    matrix : (n, n) covariance matrix.
    adjustment : fingerprint of the adjustment.json to which it belongs; "" if the file has none.
    clusters : jackknife covariance of camera parameters, leaving out one image at a time, for correlated errors within
        images; None if it was not computed.
    """

    parameters: tuple[Parameter, ...]
    values: Array
    matrix: Array
    adjustment: str = ""
    clusters: "Covariance | None" = None

    def select(self, parameters: Iterable[Parameter | str]) -> Array:
        """Covariance (k, k) of unknowns given by keys or by their texts in the file; zero for fixed ones, which the
        file does not list."""
        at = np.array([self._positions.get(as_parameter(each), -1) for each in parameters], dtype=int)
        block: Array = self.matrix[np.ix_(at, at)]
        block[at < 0, :] = 0.0
        block[:, at < 0] = 0.0
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


def covariance_path(path: Path) -> Path:
    """Path of the covariance file of an `adjustment.json`."""
    return path.with_suffix(".npz")


def covariance_arrays(adjustment: Adjustment) -> dict[str, NDArray[np.generic]]:
    """Arrays of the covariance file by name; mm, object units, rad.

    names (n), values (n) and matrix (n, n) hold all quantities if there are at most AFFORDABLE; otherwise those of
    cameras and images; if these exceed it too, those of cameras. The remaining points (and images) are stored as
    diagonal blocks, without covariances between them: point_names (p, 3), point_values (p, 3), point_matrices
    (p, 3, 3), image_names (i, k) and so on, padded with empty names and zeros for images with fewer than k quantities.
    """
    whole, blocks = _parts(adjustment)
    arrays = _named(adjustment, whole) | {"matrix": adjustment.sigma0**2 * adjustment.cofactor.part(whole)}
    for kind, groups in blocks.items():
        padded = np.full((len(groups), max(map(len, groups))), -1, dtype=np.intp)
        for row, group in zip(padded, groups, strict=True):
            row[: len(group)] = group
        matrices = np.zeros((*padded.shape, padded.shape[1]))
        lengths = (padded >= 0).sum(axis=1)
        for length in np.unique(lengths):
            cofactors = adjustment.cofactor.parts(padded[lengths == length, :length])
            matrices[lengths == length, :length, :length] = adjustment.sigma0**2 * cofactors
        named = _named(adjustment, padded) | {"matrices": matrices}
        arrays |= {f"{kind}_{name}": array for name, array in named.items()}
    return arrays | _cluster_arrays(adjustment)


def _cluster_arrays(adjustment: Adjustment) -> dict[str, NDArray[np.generic]]:
    """cluster_names (k), cluster_matrix (k, k) of the interior orientations, if an unmodelled error was estimated."""
    keys = [key for key in adjustment.parameters if key.kind == "interior"] if adjustment.unmodelled_mm else []
    matrix = adjustment.cluster_covariance_of(keys) if keys else None
    if matrix is None:
        return {}
    return {"cluster_names": np.array([key.text for key in keys], dtype=np.str_), "cluster_matrix": matrix}


def covariance_note(adjustment: Adjustment) -> str:
    """State which parts of the covariance the file holds."""
    count, alone = len(adjustment.parameters), " and every ".join(_parts(adjustment)[1])
    if not alone:
        return "adjustment.npz holds the covariance of all quantities."
    whole = "cameras" if "image" in alone else "cameras and images"
    return (
        f"adjustment.npz holds the covariance of the {whole} together and of every {alone} by itself: the matrix of "
        f"all {count} quantities would be too large."
    )


def _parts(adjustment: Adjustment) -> tuple[Indices, dict[str, list[Indices]]]:
    """Positions of the quantities in the matrix, and by kind of those in each diagonal block."""
    parameters = adjustment.parameters
    whole = np.arange(len(parameters))
    groups: dict[str, list[Indices]] = {}
    # The quantities of a point or an image are contiguous and begin with X or X0.
    for kind, kinds, first in (("point", ("point",), "X"), ("image", ("exterior", "film"), "X0")):
        members = np.array([parameters[i].kind in kinds for i in whole], dtype=bool)
        if len(whole) <= AFFORDABLE or not members.any():
            continue
        positions = whole[members]
        begins = [j for j, i in enumerate(positions) if parameters[i].quantity == first]
        groups[kind] = np.split(positions, begins[1:])
        whole = whole[~members]
    return whole, groups


def _named(adjustment: Adjustment, positions: Indices) -> dict[str, NDArray[np.generic]]:
    """Names and values at positions; "" and 0 at -1."""
    names = np.array([*adjustment.names, ""], dtype=np.str_)
    return {"names": names[positions], "values": np.append(adjustment.values, 0.0)[positions]}


def read_covariance(path: Path) -> Covariance:
    """Read the covariance of the `adjustment.json` at `path`. Raises InputError if it is missing or damaged."""
    file = covariance_path(path)
    try:
        data = read_bytes(file)
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
        clusters = Covariance(keys, np.full(len(keys), np.nan), scatter, adjustment)
    return Covariance(parameters, values.astype(np.float64), matrix, adjustment, clusters)


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


def read_own_covariance(path: Path) -> Covariance:
    """Read the covariance as `read_covariance` does. Raises InputError if it belongs to another adjustment."""
    covariance = read_covariance(path)
    if covariance.adjustment not in ("", hash_file(path)):
        raise InputError(
            f"{covariance_path(path)}: is of another adjustment than {path}. Bring both files of one adjustment "
            "together, or run `reseau adjust` again."
        )
    return covariance


def _array(data: bytes, name: str, file: Path) -> NDArray[Any]:
    """Read an array of an npz file, limited to the size allowed for any file."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive, archive.open(f"{name}.npy") as member:
            unpacked = io.BytesIO(member.read(MOST_MB * 1_000_000))
        return np.asarray(np.lib.format.read_array(unpacked, allow_pickle=False))
    except Exception as error:  # zipfile, zlib and numpy raise various errors for a damaged file
        raise InputError(f"{file}: is not a covariance file ({name}: {error}). {AGAIN}") from None
