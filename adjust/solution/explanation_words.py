"""Sentences on what explains large residuals: the cause with its figures, and the remedy.

run: the adjustment with the hypothesis in the model; explained_um: rms of what it takes of residuals.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from adjust.functional_model.families import EXTENDED, family
from adjust.problem.camera import Camera
from adjust.quality.cofactor import free_cofactor
from adjust.solution.model_hypotheses import OTHERS, ModelHypothesis
from adjust.solution.noise_hypothesis import AddedNoise
from adjust.solution.reweighting import Run

Array = NDArray[np.float64]

NAMED = 5  # images
ALIKE = 7.0  # difference of chi-square plus twice the unknowns within which two readings explain alike
UM_PER_MM = 1000.0


def noise_words(noise: AddedNoise, run: Run) -> tuple[str, str]:
    """The cause and the remedy of standard deviations that are too small everywhere."""
    covariance = run.problem.network.observations.covariance_mm2
    given_um = UM_PER_MM * float(np.sqrt(np.median(np.trace(covariance, axis1=1, axis2=2) / 2.0)))
    added_um = UM_PER_MM * noise.sigma_mm
    cause = (
        f"The standard deviations given to the {noise.marks} are too small everywhere: the residuals are plain noise, "
        f"alike in all images; {added_um:.3g} µm added to the {given_um:.3g} µm given (in quadrature) explains all"
    )
    key = "sigma_fiducial_um" if noise.marks == "fiducials" else "sigma_target_um"
    return cause, (
        f"Give film_sigma_um = {added_um:.3g} under [adjust], which is added to the sigma of every mark, or larger "
        f"sigmas in comparator.csv or {key}."
    )


def together(images: Sequence[str], count: int) -> str:
    """Images in words: "a, b and 3 more (5 of 12)"."""
    shown = ", ".join(images[:NAMED]) + (f" and {len(images) - NAMED} more" if len(images) > NAMED else "")
    return f"{shown} ({len(images)} of {count})"


def radial_words(hypothesis: ModelHypothesis, run: Run, explained_um: float) -> tuple[str, str]:
    """Of a lens that lacks radial terms."""
    degrees = ", ".join(name.removeprefix("+r") for name in _added_terms(hypothesis, run))
    return _lens_words(hypothesis, run, "radial", f"a radial pattern, of the degrees {degrees} in r", explained_um)


def decentering_words(hypothesis: ModelHypothesis, run: Run, explained_um: float) -> tuple[str, str]:
    """Of a lens that lacks decentering terms."""
    return _lens_words(hypothesis, run, "decentering", "a tangential pattern (decentering)", explained_um)


def _lens_words(hypothesis: ModelHypothesis, run: Run, group: str, what: str, rms_um: float) -> tuple[str, str]:
    camera = run.problem.network.camera_by_name[hypothesis.camera]
    cause = f"The lens model of camera {camera.name} is too simple: the residuals have {what}, {rms_um:.2g} µm rms"
    return cause, _lens_remedy(camera, group)


def _lens_remedy(camera: Camera, group: str) -> str:
    base = camera.distortion.family.removesuffix(EXTENDED)
    free = {name for name, prior in camera.distortion.parameters.items() if prior.sigma > 0.0}
    fixed = [name for name in dict(family(base).groups).get(group, ()) if name not in free]
    if base == "none":
        names = "k1 and k2" if group == "radial" else "p1 and p2"
        return f'Give the camera a [distortion] of the family "brown", say, with {names} free.'
    if fixed:
        return f'Free {", ".join(fixed)} under [distortion.sigma] of the camera ("free").'
    return "Choose a distortion family with more terms, legendre(5) say; `reseau adjust --choose` compares some."


def _added_terms(hypothesis: ModelHypothesis, run: Run) -> list[str]:
    camera = run.problem.network.camera_by_name[hypothesis.camera]
    positions = run.problem.unknowns.camera[camera.name].tolist()
    return [family(camera.distortion.family).parameters[positions.index(int(at)) - 3] for at in hypothesis.added]


def pixel_words(hypothesis: ModelHypothesis, run: Run, _: float) -> tuple[str, str]:
    """Of pixels that are not square."""
    network = run.problem.network
    value, covariance = _estimate(run, hypothesis.added)
    if hypothesis.added[0] not in run.problem.unknowns.camera[hypothesis.camera]:
        half_mm, times = network.scanners[0].half_mm[0], 2.0
    else:
        half_mm, times = network.camera_by_name[hypothesis.camera].distortion.half_mm[0], 1.0
    ratio = 1.0 - times * float(value[0]) / half_mm
    sigma = times * float(np.sqrt(covariance[0, 0])) / half_mm
    cause = (
        f"The pixels of camera {hypothesis.camera} are not square: their width is "
        f"{ratio:.6f} ± {sigma:.6f} times their height (b1 = {1.0 - ratio:+.2g})"
    )
    return cause, (
        f"Give pitch_um as [x, y] with x / y = {ratio:.6f}, or free the affinity b1 of the distortion (families brown, "
        "opencv)."
    )


def board_words(hypothesis: ModelHypothesis, run: Run, _: float) -> tuple[str, str]:
    """Of a board that is not flat."""
    value, covariance = _estimate(run, hypothesis.added)
    sigma = np.sqrt(np.diag(covariance))
    cause = (
        f"The board of the given points is not flat: its middle stands {value[0]:.3g} ± {sigma[0]:.1g} off along its "
        f"first axis and {value[1]:.3g} ± {sigma[1]:.1g} along its second (object units)"
    )
    return cause, 'Put it on a flat plate, or let its bend be adjusted: board_bend = "free" under [object].'


def group_words(hypothesis: ModelHypothesis, run: Run, _: float) -> tuple[str, str]:
    """Of two groups of images with an interior orientation each, in the readings that fit their difference."""
    camera, values = hypothesis.camera, run.end.state.values
    own = run.problem.unknowns.camera[camera][:3]
    base = values[own]
    positions = np.concatenate([hypothesis.added, own])
    covariance = _estimate(run, positions)[1]
    difference = values[hypothesis.added] - base
    by_both = np.hstack([np.eye(3), -np.eye(3)])
    spread = by_both @ covariance @ by_both.T
    count = sum(image.camera in (camera, camera + OTHERS) for image in run.problem.network.images)
    who = f"the images {together(hypothesis.images, count)} of camera {camera}"
    sigma = np.sqrt(np.diag(spread))
    remedy = "Give these images a camera of their own (column camera of images.csv)."
    scale = 1.0 + float(difference @ base) / float(base @ base)
    readings = (
        (
            np.eye(3)[:, :1],
            f"{who} have another principal distance than the others, by {difference[0]:+.4g} ± {sigma[0]:.1g} mm "
            "(zoom or focus changed)",
        ),
        (
            np.eye(3)[:, 1:],
            f"{who} have another principal point than the others, by ({difference[1]:+.4g}, {difference[2]:+.4g}) ± "
            f"({sigma[1]:.1g}, {sigma[2]:.1g}) mm: images of different sizes in one camera (cropped)",
        ),
        (
            base[:, None] / np.linalg.norm(base),
            f"{who} are {scale:.5g} times as large as the others: images of different sizes in one camera (scaled)",
        ),
        (np.eye(3), f"{who} have another interior orientation than the others"),
    )
    costs = [_misfit(difference, spread, along) + 2.0 * along.shape[1] for along, _cause in readings]
    fitting = [each for each, cost in zip(readings, costs, strict=True) if cost < min(costs) + ALIKE]
    special = [cause for along, cause in fitting if along.shape[1] < len(base)]
    causes = "; or ".join(special or [cause for _, cause in fitting])
    return f"{causes[0].upper()}{causes[1:]}", remedy


def _misfit(difference: Array, covariance: Array, along: Array) -> float:
    """Chi-square of a difference (3,) that is held to some directions."""
    weight = np.linalg.pinv(covariance, hermitian=True)
    normal = along.T @ weight @ along
    rest = difference - along @ np.linalg.pinv(normal, hermitian=True) @ (along.T @ weight @ difference)
    return float(rest @ weight @ rest)


def _estimate(run: Run, positions: NDArray[np.intp]) -> tuple[Array, Array]:
    """Values (k,) of some unknowns and their covariance (k, k), of unit weight or the larger one that was found."""
    cofactor = free_cofactor(run.numbering, run.end.state, run.factor)
    return run.end.state.values[positions], cofactor.part(positions)
