"""Hypotheses on one frame that contradicts the others as a whole: names of its fiducials, its film, its camera.

Each is tested in the adjustment of all frames. Of those with which all observations agree, the one with the smallest
v'Pv plus twice the unknowns is told (Akaike).
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from adjust.functional_model.lens import INTERIOR_NAMES, Prior
from adjust.problem.network import Network
from adjust.problem.parameter import Parameter
from adjust.solution.blunder_hypotheses import Trials
from adjust.solution.model_hypotheses import OTHERS, RICHER, Estimate, group_words
from adjust.solution.result import Adjustment
from adjust.solution.wrong_names import renamed_words, turned_layouts


def frame_cause(network: Network, frame: str, rest: Adjustment, trials: Trials) -> str:
    """Describe what is wrong with a frame by the best hypothesis with which all agree; empty where there is none.

    rest: adjustment without it.
    """
    found = list[tuple[float, str]]()
    for words, changed in _frame_hypotheses(network, frame, rest):
        result = trials.adjust(changed)
        if result is not None and result.converged and trials.explains(result):
            criterion = result.vpv + 2.0 * result.unknowns
            found.append((criterion, words or _interior_words(result, frame)))
    return min(found, default=(0.0, ""))[1]


def _frame_hypotheses(network: Network, frame: str, rest: Adjustment) -> Iterator[tuple[str, Network]]:
    """Generate words and networks; a frame with an interior orientation of its own has its words from the adjustment.

    A frame that was scanned in parts has none.
    """
    (image, *parts) = (each for each in network.images if each.frame == frame)
    if parts:
        return
    camera, observations = network.camera_by_name[image.camera], network.observations
    own = (np.array(observations.image) == image.name) & observations.is_fiducial
    shown = sorted({observations.point[row] for row in np.flatnonzero(own)})
    for renamed in turned_layouts({name: camera.fiducials[name] for name in shown}):
        rows = zip(observations.point, own, strict=True)
        point = tuple(renamed.get(name, name) if is_own else name for name, is_own in rows)
        yield (
            f"the fiducials of image {frame} have each other's names: {renamed_words(renamed)}. Correct the names.",
            replace(network, observations=replace(observations, point=point)),
        )
    for kind in RICHER.get(image.transformation, ()):
        images = tuple(replace(each, transformation=kind) if each is image else each for each in network.images)
        yield (
            f"the film of image {frame} is deformed by more than its transformation ({image.transformation}) models; "
            f"with {kind} all agree. Look for stretched or torn film, and scan it again.",
            replace(network, images=images),
        )

    def estimated(quantity: str, sigma: float = 0.0) -> Prior:
        return Prior(rest.value(Parameter.interior(camera.name, quantity)), sigma)

    lens = replace(camera.distortion, parameters={name: estimated(name) for name in camera.distortion.parameters})
    other = replace(
        camera,
        name=f"{camera.name}{OTHERS}",
        principal_distance_mm=estimated("c", np.inf),
        x0_mm=None,
        y0_mm=None,
        distortion=lens,
    )
    images = tuple(replace(each, camera=other.name) if each is image else each for each in network.images)
    yield "", replace(network, images=images, cameras=(*network.cameras, other))


def _interior_words(result: Adjustment, frame: str) -> str:
    """Describe a frame by an interior orientation of its own."""
    other = next(image.camera for image in result.network.images if image.frame == frame)
    cameras = (other, other.removesuffix(OTHERS))
    names = [Parameter.interior(name, quantity) for name in cameras for quantity in INTERIOR_NAMES]
    covariance = result.sigma0**2 * result.cofactor_of(names)
    estimate = Estimate(result.values_of(names), np.sqrt(np.diag(covariance)), covariance)
    cause, remedy = group_words(f"the marks of image {frame}", estimate)
    return f"{cause[0].lower()}{cause[1:]}. {remedy}"
