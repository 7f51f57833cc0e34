"""`adjustment.json` and `adjustment.npz` read back, and refused where they are not what was written."""

import io
import math
import zipfile
from collections import Counter, defaultdict
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adjust.functional_model.families import parameter_names
from adjust.functional_model.lens import Distortion, Lens
from adjust.functional_model.transformation import Film, film_parameter_names
from adjust.problem.parameter import (
    Parameter,
    parameter_from_text,
    parameter_of,
    parameters_from_texts,
)
from pipeline.errors import InputError
from pipeline.provenance import of_file
from pipeline.results.json_form import NUMBER, Each, check_form
from pipeline.text.text_file import MOST_MB, read_bytes, read_json

Array = NDArray[np.float64]
Json = dict[str, Any]


@dataclass(frozen=True)
class Covariance:
    """The a-posteriori covariance of all unknowns: parameters (n), values (n,), matrix (n, n); mm, object units, rad.

    adjustment: the fingerprint of the adjustment.json that it belongs to; "" where the file does not say it.
    """

    parameters: tuple[Parameter, ...]
    values: Array
    matrix: Array
    adjustment: str = ""

    def of(self, parameters: Iterable[Parameter | str]) -> Array:
        """The covariance (k, k) of some unknowns, by keys or by their texts in the file; one that is not listed was
        fixed, its row is zero."""
        at = np.array([self._positions.get(parameter_of(each), -1) for each in parameters], dtype=int)
        block: Array = self.matrix[np.ix_(at, at)]
        block[at < 0, :] = 0.0
        block[:, at < 0] = 0.0
        return block

    @cached_property
    def _positions(self) -> dict[Parameter, int]:
        return {each: i for i, each in enumerate(self.parameters)}


def covariance_path(path: Path) -> Path:
    """Where the covariance of `adjustment.json` stands."""
    return path.with_suffix(".npz")


def read_adjustment(path: Path) -> Json:
    """The contents of `adjustment.json`, checked as far as readers rely on it.

    Raises InputError for a file that is missing, no JSON, or lacks a key or has a wrong value at one.
    """
    try:
        content = read_json(path)
    except FileNotFoundError:
        raise InputError(f"{path}: there is no such file. Run `reseau adjust` first.") from None
    except IsADirectoryError:
        raise InputError(f"{path}: is a folder; an adjustment.json is needed here.") from None
    check_form(content, _ADJUSTMENT, path, _AGAIN)
    check_form(content.get("made_from", {}), Each(dict, str), path, _AGAIN, "made_from")
    _check_names(content, path)
    redundancy = content["redundancy"]
    whole = {"redundancy": redundancy, "a_priori": redundancy <= 0, "left_out": []}  # of files of earlier versions
    content = {**content, "sigma0_from": content.get("sigma0_from", whole)}
    check_form(content["sigma0_from"], _SIGMA0_FROM, path, _AGAIN, "sigma0_from")
    return content


def _check_names(content: Json, path: Path) -> None:
    """Refuse texts that name no quantity where readers take them apart."""
    reliability = content["reliability"] or {}
    texts = [text for each in (*content["singular"], *content["correlations"]) for text in each["parameters"]]
    texts += [each["parameter"] for each in reliability.get("outer", ())]
    texts += [each["name"] for each in content["calibrations"]]
    texts += [each["name"] for test in content.get("calibration_tests", ()) for each in test["direction"]]
    for text in texts:
        try:
            parameter_from_text(text)
        except ValueError as error:
            raise InputError(f"{path}: {error}. {_AGAIN}") from None


def read_covariance(path: Path) -> Covariance:
    """The covariance beside the `adjustment.json` at `path`. Raises InputError where it is missing or broken."""
    file = covariance_path(path)
    try:
        data = read_bytes(file)
    except (FileNotFoundError, IsADirectoryError):
        raise InputError(f"{file}: there is no such file; it belongs to {path.name}. {_AGAIN}") from None
    names, values, matrix = (_array(data, name, file) for name in ("names", "values", "matrix"))
    if names.dtype.kind != "U" or values.dtype.kind != "f" or matrix.dtype.kind != "f":
        kinds = ", ".join(f"{array.dtype}" for array in (names, values, matrix))
        raise InputError(f"{file}: names, values and matrix are to be text and real numbers, not {kinds}. {_AGAIN}")
    if names.ndim != 1 or values.shape != names.shape or matrix.shape != (*names.shape, *names.shape):
        raise InputError(f"{file}: {names.size} names do not fit a matrix of shape {matrix.shape}. {_AGAIN}")
    texts = tuple(str(name) for name in names)
    twice = next((name for name, count in Counter(texts).items() if count > 1), None)
    if twice is not None:
        raise InputError(f"{file}: {twice!r} is named twice. {_AGAIN}")
    adjustment = str(_array(data, "fingerprint", file)) if b"fingerprint.npy" in data else ""
    try:
        parameters = parameters_from_texts(texts)
    except ValueError as error:
        raise InputError(f"{file}: {error}. {_AGAIN}") from None
    return Covariance(parameters, values.astype(np.float64), matrix.astype(np.float64), adjustment)


def read_own_covariance(path: Path) -> Covariance:
    """The same, refused where it says that it is of another adjustment than that at `path`."""
    covariance = read_covariance(path)
    if covariance.adjustment not in ("", of_file(path)):
        raise InputError(
            f"{covariance_path(path)}: belongs to another adjustment than {path}. Bring both files of one adjustment "
            "together, or run `reseau adjust` again."
        )
    return covariance


def _array(data: bytes, name: str, file: Path) -> NDArray[Any]:
    """One array of an npz file, unpacked up to the size that is read of any file."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive, archive.open(f"{name}.npy") as member:
            unpacked = io.BytesIO(member.read(MOST_MB * 1_000_000))
        return np.asarray(np.lib.format.read_array(unpacked, allow_pickle=False))
    except Exception as error:  # whatever zipfile, zlib and numpy's reader of headers raise at a damaged file
        raise InputError(f"{file}: is not a covariance file ({name}: {error}). {_AGAIN}") from None


def calibrated_lens(camera: Json) -> Lens:
    """The lens of a camera's entry in adjustment.json, without its covariance."""
    stored = camera["distortion"]
    half = stored.get("half_mm", (0.0, 0.0))
    distortion = Distortion(
        stored["family"],
        decentering=stored.get("decentering", "reduced"),
        r0_mm=stored.get("r0_mm", 0.0),
        half_mm=(half[0], half[1]),
    )
    point = camera["principal_point_mm"]
    interior = [camera["principal_distance_mm"]["value"], point["x"]["value"], point["y"]["value"]]
    values = [stored.get(parameter, {"value": 0.0})["value"] for parameter in parameter_names(distortion.family)]
    return Lens(distortion, np.array(interior, dtype=float), np.array(values, dtype=float))


def stored_films(content: Json, images: Iterable[str]) -> dict[str, Film]:
    """The film transformations of some images in the contents of adjustment.json, by image in their order."""
    places = defaultdict[str, list[tuple[float, float]]](list)
    for row in content["residuals"]:
        places[row["image"]].append((row["x_mm"], row["y_mm"]))
    films = {}
    for image in images:
        stored = content["images"][image]["transformation"]
        names = film_parameter_names(stored["kind"])
        values = [math.radians(stored["angle_deg"]["value"]) if n == "angle" else stored[n]["value"] for n in names]
        low, high = np.min(places[image], axis=0), np.max(places[image], axis=0)
        films[image] = Film(stored["kind"], np.array(values, dtype=float), 0.5 * (low + high), stored["mirrored"])
    return films


_AGAIN = "Run `reseau adjust` again; it writes both files."


_RESIDUAL_NUMBERS = (
    "vx_um", "vy_um", "redundancy_x", "redundancy_y", "w", "weight", "sx_um", "sy_um",
    "camera_x_mm", "camera_y_mm", "camera_vx_um", "camera_vy_um",
)  # fmt: skip
FURTHER_NUMBERS = ("sigma", "v", "redundancy", "w", "detectable")
_NAMED = {"name": str, **dict.fromkeys(("value", *FURTHER_NUMBERS), NUMBER)}
_QUANTITY = {"value": NUMBER, "sigma": NUMBER}
_SIGMA0_FROM = {
    "redundancy": (float, int),
    "a_priori": bool,
    "left_out": Each(list, {"group": str, "owner": str}),
}
_ADJUSTMENT = {
    "reseau": str,
    "converged": bool,
    "termination": str,
    "iterations": int,
    "observations": int,
    "conditions": int,
    "unknowns": int,
    "redundancy": int,
    "sigma0": NUMBER,
    "singular": Each(list, {"parameters": list, "cause": str, "remedy": str}),
    "cameras": Each(
        dict,
        {
            "principal_distance_mm": _QUANTITY,
            "principal_point_mm": {"x": _QUANTITY, "y": _QUANTITY},
            "distortion": {"family": str},
            "fiducials": Each(dict, {"x_mm": _QUANTITY, "y_mm": _QUANTITY, "rho": NUMBER}),
        },
    ),
    "images": Each(
        dict,
        {
            "transformation": {"kind": str},
            "exterior": dict.fromkeys(("X0", "Y0", "Z0", "omega_deg", "phi_deg", "kappa_deg"), _QUANTITY),
        },
    ),
    "points": Each(dict, {"X": _QUANTITY, "Y": _QUANTITY, "Z": _QUANTITY}),
    "residuals": Each(list, dict.fromkeys(("image", "point", "kind"), str) | dict.fromkeys(_RESIDUAL_NUMBERS, NUMBER)),
    "distances": Each(
        list,
        dict.fromkeys(("from", "to"), str) | dict.fromkeys(("distance", *FURTHER_NUMBERS), NUMBER),
    ),
    "correlations": Each(list, {"parameters": list, "rho": NUMBER, "cause": str, "remedy": str}),
    "calibrations": Each(list, _NAMED),
    "antennas": Each(list, _NAMED),
    "warnings": Each(list, str),
    "variance_factors": Each(dict, NUMBER),
    "variance_sigmas": Each(dict, NUMBER),
    "suspects": Each(
        list,
        {"name": str, "group": str, "owner": str, "point": str, "alike": list, "error": list, "removed": bool}
        | dict.fromkeys(("statistic", "critical", "w", "tau", "critical_tau"), NUMBER),
    ),
    "reliability": (dict, type(None)),
    "groups": Each(dict, dict.fromkeys(("sigma0", "rms_x_um", "rms_y_um", "redundancy"), NUMBER)),
}
