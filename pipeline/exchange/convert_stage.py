"""`reseau convert`: convert a camera's lens, with its covariance, to another family of distortion models."""

import io
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from adjust.functional_model.families import FAMILY_NAMES, family
from adjust.functional_model.lens import Distortion, Lens, Prior
from adjust.functional_model.lens_conversion import ConvertedLens, convert_lens
from adjust.problem.parameter import Parameter
from pipeline.adjusting.compare_stage import calibrated_lens
from pipeline.errors import InputError
from pipeline.exchange.exchange_stage import check_folder, publish, readme
from pipeline.files.camera_file import CameraFile, camera_text, read_camera
from pipeline.files.mark_table import Picture, picture_file
from pipeline.files.project_file import read_project
from pipeline.provenance import hash_content
from pipeline.results.adjustment_file import (
    ParameterCovariance,
    covariance_path,
    observed_mm,
    read_adjustment,
    read_own_covariance,
)
from pipeline.results.adjustment_record import (
    CameraRecord,
    ConvertedFrom,
    DistortionRecord,
    PrincipalPointRecord,
    Quantity,
)
from pipeline.results.record_json import json_text, record_content
from pipeline.text.files import RESULT_MB, read_bytes
from pipeline.text.wording import did_you_mean, listed
from pipeline.types import Array

LEAST_R0_MM = 1e-3  # whole numbers of such radii to the seventh power can be computed with


@dataclass(frozen=True)
class ConvertOptions:
    """Options of the conversion. parameters: to be fitted in the target family, () for its default ones; camera: name,
    if there are several."""

    family: str
    r0_mm: float = 0.0
    parameters: tuple[str, ...] = ()
    camera: str | None = None


@dataclass(frozen=True)
class Conversion:
    """Result of a conversion.

    Attributes
    ----------
    sigmas : (3 + k,) of c, x0', y0' and the parameters, the larger of model and left-out images; inf: free.
    sentences : lines of the README.
    files : content by name.
    """

    lens: ConvertedLens
    sigmas: Array
    sentences: tuple[str, ...]
    files: dict[str, str | bytes]

    @property
    def misfit_um(self) -> float:
        """Largest difference over the frame, µm."""
        return 1e3 * self.lens.largest_mm

    @property
    def values(self) -> dict[str, tuple[float, float]]:
        """c, x0, y0 and the parameters with their standard deviations."""
        names, pairs = self.lens.lens.quantities, zip(self.lens.lens.values.tolist(), self.sigmas.tolist(), strict=True)
        return dict(zip(names, pairs, strict=True))

    def as_json(self) -> dict[str, object]:
        """Content of `--json`."""
        return {
            **record_content(DistortionRecord.from_distortion(self.lens.lens.distortion, {})),
            "same": self.lens.is_same,
            "largest_um": self.misfit_um,
            "rms_um": 1e3 * self.lens.rms_mm,
            "values": {
                name: {"value": value, "sigma": sigma if math.isfinite(sigma) else "free"}
                for name, (value, sigma) in self.values.items()
            },
        }

    def lines(self) -> Sequence[str]:
        """Lines to be printed: the sentences and the parameters."""
        units = dict.fromkeys(("c", "x0", "y0"), "mm")
        unit = family(self.lens.lens.distortion.family).unit
        numbers = [
            f"  {name:6s} {value:>16.9g}  {f'± {sigma:.2g}' if math.isfinite(sigma) else 'free':9s}  "
            f"{units.get(name) or unit(name)}".rstrip()
            for name, (value, sigma) in self.values.items()
            if value != 0.0 or sigma != 0.0
        ]
        return (*self.sentences, *numbers)


def run_convert(path: Path, folder: Path, options: ConvertOptions) -> Conversion:
    """Convert the camera of a camera file, or of adjustment.json with its covariance, and write it into a folder.

    Raises
    ------
    InputError : unknown family or parameter, a camera without lens or frame, or a folder with other files.
    """
    try:
        target = family(options.family)
    except ValueError as error:
        raise InputError(f"{error}.{did_you_mean(options.family, FAMILY_NAMES)}") from None
    unknown = sorted(set(options.parameters) - set(target.parameters))
    if unknown:
        raise InputError(f"{options.family} has no parameter {listed(unknown)}; it has {listed(target.parameters)}.")
    if target.needs == "r0_mm" and not LEAST_R0_MM <= options.r0_mm < math.inf:
        raise InputError(f"{options.family} needs a radius r0 of {LEAST_R0_MM:g} mm or more: say with --r0-mm which.")
    check_folder(folder)
    is_adjustment = path.suffix == ".json"
    done = _converted_adjustment(path, options) if is_adjustment else _converted_camera(path, folder, options)
    head = [f"From: {path.name}", "", *(f"- {line}" for line in done.sentences)]
    publish(folder, done.files, readme("a lens converted", head, {}))
    return done


def _convert(
    lens: Lens, sigmas: Array, corners_mm: Array, options: ConvertOptions
) -> tuple[ConvertedLens, tuple[str, ...]]:
    """Convert a lens. Returns it with sentences on the result. sigmas (k,): of its parameters."""
    uncertain = [name for name, sigma in zip(lens.quantities[3:], sigmas, strict=True) if sigma > 0.0]
    half = np.abs(corners_mm).max(axis=0) if family(options.family).needs == "half_mm" else np.zeros(2)
    into = Distortion(options.family, r0_mm=options.r0_mm, half_mm=(float(half[0]), float(half[1])))
    found = convert_lens(lens, into, corners_mm, options.parameters or None, uncertain)
    if not math.isfinite(found.largest_mm):
        raise InputError(
            f"{options.family} cannot take this lens ({lens.distortion.family}): the nearest one folds the image over "
            f"within the frame. Convert it into another family, or for a smaller frame_mm."
        )
    size = "{:.4g} x {:.4g} mm".format(*(corners_mm[1] - corners_mm[0]))
    sentence = (
        f"{lens.distortion.family} and {options.family} mean the same here: what is left over {size} is rounding."
        if found.is_same
        else f"{options.family} does not take this lens quite: over {size} it is off by up to "
        f"{1e3 * found.largest_mm:.3g} µm, rms {1e3 * found.rms_mm:.3g} µm a point. "
        "The standard deviations do not count that."
    )
    return found, (sentence, f"Fitted: c, x0', y0' and {listed(found.estimated) or 'no parameter'}.")


def _convert_over_frame(
    camera: CameraRecord, observed: Array, lens: Lens, sigmas: Array, options: ConvertOptions
) -> tuple[ConvertedLens, tuple[str, ...]]:
    """Convert an adjusted lens over its frame; where that is unknown, or the converted lens would fold the image over
    in a part of it, over the extent of the observations (n, 2)."""
    extent_mm = np.array([observed.min(axis=0), observed.max(axis=0)])
    reach, beyond = camera.lens_known, tuple[str, ...]()
    if reach is not None and reach.frame_mm is not None:
        try:
            return _convert(lens, sigmas, np.array(reach.frame_mm), options)
        except InputError:
            beyond = ("That is the extent of the observations: in the frame beyond it the image would be folded over.",)
    found, sentences = _convert(lens, sigmas, extent_mm, options)
    return found, (*sentences, *beyond)


def _converted_adjustment(path: Path, options: ConvertOptions) -> Conversion:
    """Convert one camera's lens within the whole adjustment.json and adjustment.npz."""
    content, covariance = read_adjustment(path), read_own_covariance(path)
    name, given = calibrated_lens(path, content, options.camera)
    known = np.sqrt(np.diag(covariance.select(_parameters(name, given)[3:])))
    lens, sentences = _convert_over_frame(
        content.cameras[name], observed_mm(path, content, name), given, known, options
    )
    moved = _moved_covariance(covariance, name, given, lens)
    keys = _parameters(name, lens.lens)
    model, sigmas = (np.sqrt(np.diag(select(keys))) for select in (moved.select, moved.select_larger))
    entry = _camera_entry(content.cameras[name], given.distortion, lens, model)
    gone = {Parameter.interior(name, each) for each in given.quantities[3:]}
    correlations = tuple(row for row in content.correlations if not gone & set(row.parameters))
    converted = replace(content, cameras={**content.cameras, name: entry}, correlations=correlations)
    text = "".join(json_text(converted))
    arrays = io.BytesIO()
    with np.load(io.BytesIO(read_bytes(covariance_path(path), RESULT_MB)), allow_pickle=False) as stored:
        kept = {key: stored[key] for key in stored.files}
    kept |= moved.arrays()
    kept["fingerprint"] = np.array(hash_content(text.encode("utf-8")))
    np.savez_compressed(arrays, allow_pickle=False, **kept)
    return Conversion(lens, sigmas, sentences, {"adjustment.json": text, "adjustment.npz": arrays.getvalue()})


def _parameters(camera: str, lens: Lens) -> tuple[Parameter, ...]:
    return tuple(Parameter.interior(camera, each) for each in lens.quantities)


def _moved_covariance(
    covariance: ParameterCovariance, camera: str, source: Lens, lens: ConvertedLens
) -> ParameterCovariance:
    """Covariance of all parameters after the conversion of one camera, by the derivatives of its lens."""
    old, new = _parameters(camera, source), _parameters(camera, lens.lens)
    others = tuple(each for each in covariance.parameters if each not in old)
    by_old = np.zeros((len(new) + len(others), len(old) + len(others)))
    by_old[: len(new), : len(old)] = lens.by_source
    by_old[len(new) :, len(old) :] = np.eye(len(others))
    matrix = by_old @ covariance.select((*old, *others)) @ by_old.T
    value = dict(zip(covariance.parameters, covariance.values, strict=True))
    values = np.concatenate([lens.lens.values, [value[each] for each in others]])
    clusters = covariance.clusters and _moved_covariance(covariance.clusters, camera, source, lens)
    return ParameterCovariance((*new, *others), values, (matrix + matrix.T) / 2.0, clusters=clusters)


def _camera_entry(camera: CameraRecord, source: Distortion, lens: ConvertedLens, sigmas: Array) -> CameraRecord:
    c, x0, y0, *parameters = (
        Quantity(float(value), float(sigma)) for value, sigma in zip(lens.lens.values, sigmas, strict=True)
    )
    named = dict(zip(lens.lens.quantities[3:], parameters, strict=True))
    return replace(
        camera,
        principal_distance_mm=c,
        principal_point_mm=PrincipalPointRecord(x0, y0),
        distortion=DistortionRecord.from_distortion(lens.lens.distortion, named),
        significance=(),
        converted=ConvertedFrom(
            DistortionRecord.from_distortion(source, {}), lens.is_same, 1e3 * lens.largest_mm, 1e3 * lens.rms_mm
        ),
    )


def _converted_camera(path: Path, folder: Path, options: ConvertOptions) -> Conversion:
    """Convert the values and standard deviations of a camera file's lens."""
    camera = _read_camera(path)
    distance, point = camera.principal_distance_mm, camera.principal_point_mm
    if distance is None or point is None or camera.frame_mm is None:
        missing = "frame_mm" if camera.frame_mm is None else "principal distance or principal point"
        raise InputError(f"{path}: has no {missing}, and a lens is converted over its frame. Give it there.")
    source = Lens(camera.distortion, np.array([distance, *point]), camera.distortion.values)
    priors = [camera.distortion.parameters.get(name, Prior(0.0)) for name in source.quantities[3:]]
    middle = np.zeros(2) if camera.fiducials else source.interior[1:]
    half = np.array(camera.frame_mm) / 2.0
    corners_mm = np.array([middle - half, middle + half])
    given = np.array([camera.principal_distance_sigma_mm, *camera.principal_point_sigma_mm, *(p.sigma for p in priors)])
    source = replace(source, covariance=np.diag(np.where(np.isinf(given), 0.0, given) ** 2))
    found, sentences = _convert(source, given[3:], corners_mm, options)
    lens, sigmas = found.lens, _sigmas(given, source, found)
    if np.count_nonzero(np.isfinite(sigmas) & (sigmas > 0.0)) > 1:
        sentences += (
            "A camera file holds no correlations: to keep them convert adjustment.json, and name the result there.",
        )
    if camera.calibration is not None:
        sentences += (f"The earlier calibration {camera.calibration.path} is left out: convert it by itself.",)
    sigma = dict(zip(lens.quantities[3:], sigmas[3:].tolist(), strict=True))
    value = dict(zip(sigma, lens.parameters.tolist(), strict=True))
    estimated = {name: Prior(value[name], sigma[name]) for name in found.estimated}
    converted = replace(
        camera,
        path=folder / "camera.toml",
        principal_distance_mm=float(lens.interior[0]),
        principal_point_mm=(float(lens.interior[1]), float(lens.interior[2])),
        principal_distance_sigma_mm=float(sigmas[0]),
        principal_point_sigma_mm=(float(sigmas[1]), float(sigmas[2])),
        distortion=replace(lens.distortion, parameters=estimated),
        calibration=None,
    )
    files: dict[str, str | bytes] = {}

    def save(name: str, picture: Picture) -> str:
        files[f"{name}.tif"] = picture_file(picture)
        return f"{name}.tif"

    files["camera.toml"] = camera_text(converted, save)
    return Conversion(found, sigmas, sentences, files)


def _read_camera(path: Path) -> CameraFile:
    """Read a camera file; for a project, raise InputError that names its own."""
    try:
        return read_camera(path)
    except InputError as error:
        try:
            cameras = read_project(path).cameras.values()
        except InputError:
            raise error from None
        files = listed([str(camera.path) for camera in cameras])
        raise InputError(f"{path}: is a project, and a camera file or adjustment.json is converted: {files}.") from None


def _sigmas(given: Array, source: Lens, found: ConvertedLens) -> Array:
    """(3 + k,) standard deviations, from the uncorrelated ones of the source; what depends on a free one is free."""
    free, lens = np.isinf(given), found.lens
    sigmas = np.sqrt(np.maximum(np.diag(lens.covariance), 0.0))
    is_free = np.zeros(len(sigmas), dtype=bool)
    is_free[:3] = free[:3]
    if free[3:].any():
        is_free[[lens.quantities.index(name) for name in found.estimated]] = True
        is_free[0] |= source.distortion.r0_mm != lens.distortion.r0_mm
    sigmas[is_free] = math.inf
    return np.asarray(sigmas)
