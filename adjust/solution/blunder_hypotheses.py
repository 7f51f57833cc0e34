"""Test whether a blunder of the whole network explains its contradictions.

Such a blunder leaves residuals everywhere, and tests of single observations would reject good ones.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from adjust.array_types import Array, Mask
from adjust.problem.network import EXTERIOR_NAMES, Exterior, Network
from adjust.problem.parameter import Parameter
from adjust.solution.network_hypotheses import AXES, FACTORS, NetworkHypothesis, Trials, network_hypotheses, unit_words
from adjust.solution.result import Adjustment

CLEARLY = 3.0  # factor by which an explanation must reduce sigma0
NEAR = 0.3  # fraction of its distance from the field's centre that a station may lie off its given place
PITCHES = (10.0, 25.4, 100.0, 1000.0, 2.0)  # ratios of principal distances by another unit or pixel pitch
ROUND = 0.05  # relative tolerance of these ratios
FLAT = 1e-3  # relative thickness of a flat field, which is mirrored by mirroring the stations
MIRRORED = "the points are mirrored: the sign of X, Y or Z of all of them is wrong, or two axes are exchanged"


def blunder_sentence(network: Network, given: Adjustment | None, trials: Trials) -> str:
    """Describe the blunder of a whole network without which all observations agree; empty where there is none.

    given: adjustment of the network as given, None where it cannot start. A hypothesis explains the contradictions
    where v'Pv without the blunder is not significant (`Trials.explains`) and sigma0 is CLEARLY smaller. Hypotheses with
    identical residuals are tried once, without the given orientations, which then distinguish them.
    """
    if given is None:  # perhaps only the given approximations are wrong
        given = trials.adjust(network)
    if trials.explains(given):
        return ""
    bare = replace(network, images=tuple(replace(image, exterior=None) for image in network.images))
    if _given_stations(network):
        alone = trials.adjust(bare)
        if alone is not None and trials.explains(alone):
            return stations_elsewhere(network, alone)
    for alike in network_hypotheses(network, bare, given, trials):
        found = trials.adjust(alike[0].network)
        better = found is not None and (given is None or CLEARLY * found.sigma0 < given.sigma0 or not given.converged)
        if found is not None and better and trials.explains(found):
            return _sentence(_as_stations_are_given(network, alike, found), found, given, trials.family)
    return ""


def _sentence(slips: Sequence[NetworkHypothesis], found: Adjustment, given: Adjustment | None, family: float) -> str:
    words = [each.words for each in slips]
    if len(words) >= len(AXES):  # the mirrored axis cannot be identified
        words = [MIRRORED, *words[len(AXES) :]]
    what = "; or ".join(words) + _found_distance(*slips[0].distance, found)
    if given is None:
        stands = "nothing can be adjusted"
    elif not given.converged:
        stands = "the iteration does not come to rest"
    else:
        stands = f"σ₀ is {given.sigma0:.3g} (p < {family:g})"
    return (
        f"{what[0].upper()}{what[1:]}. Without this all {len(found.network.observations)} observations agree "
        f"(σ₀ = {found.sigma0:.2f}); as it stands, {stands}. {slips[0].remedy}"
    )


def _found_distance(camera: str, given_mm: float, found: Adjustment) -> str:
    """Describe the estimated principal distance, and whether it is the given one in another unit or pixel pitch."""
    if not camera:
        return ""
    c = found.value(Parameter.interior(camera, "c"))
    times = max(c / given_mm, given_mm / c)
    how = "long" if c < given_mm else "short"
    is_unit = any(abs(times / each - 1.0) < ROUND for each in PITCHES)
    why = f", so that it is given {times:.3g} times too {how}: another unit, or a wrong pitch_um" if is_unit else ""
    return f": it is found as {c:.6g} mm{why}"


def _as_stations_are_given(
    network: Network, alike: Sequence[NetworkHypothesis], found: Adjustment
) -> Sequence[NetworkHypothesis]:
    """Keep the hypotheses with identical residuals whose stations lie near the given ones; all if none does."""
    given = _given_stations(network)
    if len(alike) == 1 or not given:
        return alike
    back = np.linalg.inv(alike[0].moved)
    stations, depths = _stations(found, given)
    places = np.array(list(given.values()))
    return [each for each in alike if _near(stations @ (each.moved @ back).T, places, depths).all()] or alike


def _given_stations(network: Network) -> dict[str, Array]:
    exteriors: dict[str, Exterior | None] = {image.name: image.exterior for image in network.images}
    return {
        name: exterior.center
        for name, exterior in exteriors.items()
        if exterior is not None and name not in network.unoriented
    }


def _stations(result: Adjustment, images: dict[str, Array]) -> tuple[Array, Array]:
    """Adjusted stations (n, 3) of some images, and their distances (n,) from the centre of the points."""
    frames = [result.network.image_by_name[name].frame for name in images]
    exterior = (Parameter.exterior(frame, element) for frame in frames for element in EXTERIOR_NAMES[:3])
    stations = result.values_of(exterior).reshape(-1, 3)
    return stations, np.linalg.norm(stations - _points(result).mean(axis=0), axis=1)


def _points(result: Adjustment) -> Array:
    ids = [point.id for point in result.network.points if point.id in result.network.observed_points]
    return result.values_of(Parameter.point(id_, axis) for id_ in ids for axis in "XYZ").reshape(-1, 3)


def _near(stations: Array, given: Array, depths: Array) -> Mask:
    return np.asarray(np.linalg.norm(stations - given, axis=1) < NEAR * depths)


def stations_elsewhere(network: Network, result: Adjustment) -> str:
    """Explain stations that lie far from where they are given; empty where nothing does.

    Possible causes: another unit, exchanged frames, or mirrored points of a flat field.
    """
    given = _given_stations(network)
    if result.termination == "singular" or len(given) < 2 or not network.observed_points:
        return ""
    names, places = list(given), np.array(list(given.values()))
    stations, depths = _stations(result, given)
    off = np.flatnonzero(~_near(stations, places, depths))
    if len(off) == 2 and _near(stations[off], places[off[::-1]], depths[off]).all():
        one, other = (names[i] for i in off)
        return (
            f"The frames {one} and {other} lie each where the other's orientation is given: their names "
            f"are exchanged, in the scans or in images.csv."
        )
    if 2 * len(off) <= len(names):
        return ""
    for words, candidate, scale in _moved_stations(result, stations):
        if _near(candidate, places, scale * depths).all():
            return (
                f"By the points the stations lie nowhere near where they are given, but all {len(names)} would with "
                f"another reading of the points: {words}. Correct the points, or the stations."
            )
    return ""


def _moved_stations(result: Adjustment, stations: Array) -> Iterator[tuple[str, Array, float]]:
    """Generate blunders in words, with the stations without them and the scale."""
    for factor in FACTORS:
        yield unit_words(factor), factor * stations, factor
    points = _points(result)
    middle = points.mean(axis=0)
    _, extents, axes = np.linalg.svd(points - middle, full_matrices=False)
    if extents[-1] <= FLAT * extents[0]:
        reflected = stations - 2.0 * np.outer((stations - middle) @ axes[-1], axes[-1])
        yield from ((words, reflected @ by.T, 1.0) for words, by in AXES.items())
