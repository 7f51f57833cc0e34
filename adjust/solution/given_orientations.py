"""Compare given exterior orientations with those that the points give: mistakes of images.csv, or of the points.

Exchanged names, wrong signs, units or columns of all rows; wrong values of a few; approximations far from the result.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.spatial import procrustes
from scipy.special import chdtrc

from adjust.array_types import Array, Mask
from adjust.functional_model.rotation import angles_from_rotation, rotation_from_angles
from adjust.problem.estimates import adjusted_image, adjusted_places
from adjust.problem.network import EXTERIOR_NAMES, Network
from adjust.problem.parameter import shortened
from adjust.solution.result import Adjustment
from adjust.solution.wrong_names import NAMED

CLEARLY = 3.0  # factor by which an explanation must reduce errors
TOLERATED = 2.0  # factor on the given standard deviations up to which residuals need no explanation
NEAR = 0.3  # fraction of its distance from the field's centre that a station may lie off its given place; rad of angles
MOST_WRONG, ELEMENTS = 1 / 3, 3  # fraction of the images that are given wrongly at most; elements of each told
FLAT = 1e-3  # relative thickness of a flat field, which is mirrored by mirroring the stations
UNITS = (1000.0, 100.0, 10.0, 0.3048, 25.4)  # ratios of length units: m, dm, cm, mm, feet, inches
FACTORS = (*UNITS, *(1.0 / each for each in UNITS))
AXES = {  # blunders that mirror the points, and the matrices that correct them
    **{f"the sign of {'XYZ'[i]} of all points is wrong": np.diag(1.0 - 2.0 * np.eye(3)[i]) for i in range(3)},
    **{
        f"{axes} of all points are exchanged": np.eye(3)[order]
        for axes, order in (("X and Y", [1, 0, 2]), ("X and Z", [2, 1, 0]), ("Y and Z", [0, 2, 1]))
    },
}

UNIT = "the coordinates of the points are {} for the stations or distances: another unit"


def times_too(factor: float) -> str:
    """Words on values that a factor corrects."""
    return f"{max(factor, 1.0 / factor):.4g} times too {'large' if factor < 1.0 else 'small'}"


Reading = Callable[[Array], Array]
ANGLES: dict[str, Reading] = {  # mistakes of the angles of images.csv, and how to read these then
    **{
        f"{what} with the other sign": partial(np.multiply, signs)
        for what, signs in (
            ("omega", (-1.0, 1.0, 1.0)),
            ("phi", (1.0, -1.0, 1.0)),
            ("kappa", (1.0, 1.0, -1.0)),
            ("all angles", (-1.0, -1.0, -1.0)),
        )
    },
    "omega and phi exchanged": lambda angles: angles[:, [1, 0, 2]],
    "omega and kappa exchanged": lambda angles: angles[:, [2, 1, 0]],
    "phi and kappa exchanged": lambda angles: angles[:, [0, 2, 1]],
    "angles in gon, not degrees": partial(np.multiply, 0.9),
    "angles in radians, not degrees": partial(np.multiply, 180.0 / np.pi),
    "angles of the rotation from camera to object": lambda angles: angles_from_rotation(
        rotation_from_angles(angles).swapaxes(1, 2)
    ),
    "angles of a camera with y down and z forward": lambda angles: angles_from_rotation(
        np.diag([1.0, -1.0, -1.0]) @ rotation_from_angles(angles)
    ),
    **{
        f"kappa {degrees} degrees larger": partial(np.add, (0.0, 0.0, np.radians(degrees)))
        for degrees in (90, 180, 270)
    },
}
STATIONS: dict[str, Reading] = {  # the same of the stations
    **{f"{'XYZ'[i]}0 with the other sign": partial(np.multiply, 1.0 - 2.0 * np.eye(3)[i]) for i in range(3)},
    "X0 and Y0 exchanged": lambda stations: stations[:, [1, 0, 2]],
    "X0 and Z0 exchanged": lambda stations: stations[:, [2, 1, 0]],
    "Y0 and Z0 exchanged": lambda stations: stations[:, [0, 2, 1]],
    **{f"Z0 {factor:.4g} times as large: another unit": partial(np.multiply, (1.0, 1.0, factor)) for factor in FACTORS},
    **{UNIT.format(times_too(1.0 / factor)): partial(np.multiply, factor) for factor in FACTORS},
}


def given_stations(network: Network) -> dict[str, Array]:
    images = (image for image in network.images if image.name not in network.unoriented)
    return {image.name: image.exterior.center for image in images if image.exterior is not None}


def adjusted_stations(result: Adjustment, given: Mapping[str, Array]) -> tuple[Array, Array, Array]:
    """Adjusted stations (n, 3), their distances (n,) from the centre of the points, and the given stations (n, 3)."""
    stations = np.array([adjusted_image(result, name).station for name in given])
    depths = np.linalg.norm(stations - _points(result).mean(axis=0), axis=1)
    return stations, depths, np.array([*given.values()])


def _points(result: Adjustment) -> Array:
    shown = result.network.observed_points
    return adjusted_places(result, [each.id for each in result.network.points if each.id in shown])


def is_near(stations: Array, given: Array, depths: Array) -> Mask:
    return np.asarray(np.linalg.norm(stations - given, axis=1) < NEAR * depths)


@dataclass(frozen=True)
class _Compared:
    """Adjusted orientations of images, and those given.

    Attributes
    ----------
    names : of the images.
    stations, places : (n, 3) adjusted and given stations.
    depths : (n,) distances of the adjusted stations from the centre of the points.
    rotations : (n, 3, 3), adjusted.
    angles : (n, 3) rad, given.
    """

    names: list[str]
    stations: Array
    places: Array
    depths: Array
    rotations: Array
    angles: Array

    @staticmethod
    def from_result(network: Network, result: Adjustment, given: Mapping[str, Array]) -> "_Compared":
        stations, depths, places = adjusted_stations(result, given)
        rotations = np.array([adjusted_image(result, name).rotation for name in given])
        exterior = {image.name: image.exterior for image in network.images if image.exterior is not None}
        angles = np.array([exterior[name].values[3:] for name in given])
        return _Compared(list(given), stations, places, depths, rotations, angles)


def orientations_elsewhere(network: Network, result: Adjustment, is_observed: bool = False) -> str:
    """Explain orientations that are not as they are given by mistakes of their table; empty where none does.

    Possible causes: exchanged names, wrong signs, units or columns of stations or angles, or mirrored points of a flat
    field. is_observed: whether standard deviations tell that the orientations contradict the images.
    """
    if result.termination == "singular" or not network.observed_points:
        return ""
    is_open = len(network.known_places) < 2  # in scale, rotation and position
    plan = {
        point.id: np.array([point.X.value, point.Y.value])
        for point in network.points
        if is_open and point.X and point.Y and point.id in result.network.observed_points
    }
    if plan and (words := _other_unit(adjusted_places(result, list(plan))[:, :2], np.array([*plan.values()]))):
        return words.replace("stations or distances", "approximate X and Y")
    given = given_stations(network)
    if len(given) < 2:
        return ""
    compared = _Compared.from_result(network, result, given)
    return (
        (_other_unit(compared.stations, compared.places) if is_open else "")
        or _misread_table(compared, is_observed)
        or _mirrored_points(compared, _points(result))
    )


def _misread_table(compared: _Compared, is_observed: bool) -> str:
    """Describe exchanged names, or another reading of all rows; empty where neither explains the orientations."""
    stations, places, depths, angles = compared.stations, compared.places, compared.depths, compared.angles
    off = np.flatnonzero(~is_near(stations, places, depths))
    turned, is_turned = _best_reading(
        ANGLES, angles, lambda values: _rotation_errors(values, compared.rotations), is_observed
    )
    moved, is_moved = _best_reading(
        STATIONS, places, lambda values: np.linalg.norm(values - stations, axis=1) / depths, is_observed
    )
    found = list[str]()
    nearest = np.linalg.norm(stations[off, None] - places[off], axis=2).argmin(axis=1) if len(off) else off
    if (
        len(off) > 1
        and len(set(nearest)) == len(off)
        and is_near(stations[off], places[off[nearest]], depths[off]).all()
    ):
        # Exchanged names exchange attitudes too.
        rotations = compared.rotations[off]
        exchanged, kept = (np.linalg.norm(_rotation_errors(angles[rows], rotations)) for rows in (off[nearest], off))
        if not moved or CLEARLY * kept >= exchanged:
            sentence = (
                f"The frames {shortened([compared.names[i] for i in off], NAMED)} each lie where another's orientation "
                "is given: their names are exchanged, in the scans or in images.csv."
            )
            if CLEARLY * exchanged < kept or not moved:
                return sentence
            found = [f"{sentence[:-1]}; or:"]
    if not ((is_turned and turned) or (is_moved and moved)):
        return ""
    words = "; ".join(each for each in (moved, turned) if each)
    found.append(
        f"The orientations of all {len(angles)} images are not those that the points give, but would be with another "
        f"reading: {words}. Correct images.csv, or the points."
    )
    return " ".join(found)


def _mirrored_points(compared: _Compared, points: Array) -> str:
    """Describe what mirrors the points of a flat field, whose stations then lie on its other side; empty if nothing."""
    stations, places, depths = compared.stations, compared.places, compared.depths
    if 2 * (~is_near(stations, places, depths)).sum() <= len(stations):
        return ""
    middle = points.mean(axis=0)
    _, extents, axes = np.linalg.svd(points - middle, full_matrices=False)
    if extents[-1] > FLAT * extents[0]:
        return ""
    reflected = stations - 2.0 * np.outer((stations - middle) @ axes[-1], axes[-1])
    for words, by in AXES.items():
        if is_near(reflected @ by.T, places, depths).all():
            return (
                "By the points the stations lie nowhere near where they are given, but all "
                f"{len(stations)} would with another reading of the points: {words}. Correct the points, or the "
                "stations."
            )
    return ""


def _other_unit(found: Array, given: Array) -> str:
    """Describe another unit of points that leave the datum in plan open, by other places (n, k); empty if none."""
    spreads = [float(np.linalg.norm(each - each.mean(axis=0))) for each in (found, given)]
    if not all(spreads) or procrustes(given, found)[2] > NEAR**2:
        return ""
    words = (UNIT.format(times_too(f)) for f in FACTORS if abs(np.log(f * spreads[0] / spreads[1])) < NEAR)
    remedy = "Give both in the unit that [object] unit names."
    return next((f"{each[0].upper()}{each[1:]}. {remedy}" for each in words), "")


def unlike_approximations(network: Network, result: Adjustment) -> str:
    """Note images whose given approximations are far from their adjusted orientations; empty where none is."""
    approximate = {image.name for image in network.images if not image.is_observed}
    stations = {name: each for name, each in given_stations(network).items() if name in approximate}
    if not result.converged or not stations or not network.observed_points:
        return ""
    both = _Compared.from_result(network, result, stations)
    is_far = ~is_near(both.stations, both.places, both.depths)
    is_turned = _rotation_errors(both.angles, both.rotations) > NEAR
    rows = list[str]()
    for k in np.flatnonzero(is_far | is_turned).tolist():
        parts = []
        if is_far[k]:
            parts.append(f"the station ({_numbers(both.places[k])}) is found at ({_numbers(both.stations[k])})")
        if is_turned[k]:
            own = np.degrees(angles_from_rotation(both.rotations[k : k + 1])[0])
            parts.append(f"omega, phi, kappa ({_numbers(np.degrees(both.angles[k]))}) as ({_numbers(own)}) degrees")
        rows.append(f"{both.names[k]}: {', '.join(parts)}")
    if not rows:
        return ""
    return (
        f"The orientations given approximately for {len(rows)} of {len(stations)} images are far from those found, "
        f"which do not depend on them: {'; '.join(rows[:NAMED])}{', ...' * (len(rows) > NAMED)}. Correct images.csv."
    )


def _numbers(values: Array) -> str:
    return ", ".join(f"{value:.7g}" for value in values)


def wrong_orientations(network: Network, alone: Adjustment, family: float) -> tuple[str, Network] | None:
    """Describe observed orientations of a few images that contradict the points; also return the network without them.

    alone: adjustment without the given orientations, which agrees; family: significance level. None where there are no
    such images, or more than MOST_WRONG.
    """
    observed, wrong = [image for image in network.images if image.is_observed], dict[str, str]()
    units = np.where(np.arange(6) < 3, 1.0, np.degrees(1.0))
    for image in observed:
        exterior, at = image.exterior, alone.run.problem.unknowns.exterior[image.name]
        if exterior is None:
            continue
        off = exterior.values - alone.values[at]
        off[3:] = (off[3:] + np.pi) % (2.0 * np.pi) - np.pi
        covariance = TOLERATED**2 * (alone.cofactor.part(at) + np.diag(exterior.sigmas**2))
        if chdtrc(len(at), off @ np.linalg.pinv(covariance) @ off) > family / len(observed):
            continue
        sizes = np.abs(off) / np.sqrt(np.diag(covariance))
        worst = [k for k in np.argsort(-sizes)[:ELEMENTS].tolist() if sizes[k] > CLEARLY] or [int(np.argmax(sizes))]
        values = [(EXTERIOR_NAMES[k], units[k] * exterior.values[k], units[k] * alone.values[at[k]]) for k in worst]
        wrong[image.name] = ", ".join(f"{name} = {given:.7g} is found as {found:.7g}" for name, given, found in values)
    if not 0 < len(wrong) <= MOST_WRONG * len(observed):
        return None
    freed = (replace(image, exterior=None) if image.name in wrong else image for image in network.images)
    rows = "; ".join(f"{name}: {words}" for name, words in list(wrong.items())[:NAMED])
    what = f"the orientations given for {len(wrong)} of {len(observed)} images contradict their marks ({rows})"
    return what, replace(network, images=tuple(freed))


def _rotation_errors(angles: Array, rotations: Array) -> Array:
    """(n,) rad, angles between given attitudes (n, 3) and rotations (n, 3, 3)."""
    cosine = (np.einsum("nij,nij->n", rotation_from_angles(angles), rotations) - 1.0) / 2.0
    return np.asarray(np.arccos(np.clip(cosine, -1.0, 1.0)))


def _best_reading(
    readings: Mapping[str, Callable[[Array], Array]], given: Array, errors: Callable[[Array], Array], is_observed: bool
) -> tuple[str, bool]:
    """The reading of given values (n, 3) that makes the errors of all images CLEARLY smaller; empty where none does.

    Also returns whether the values as given contradict the images.
    """
    as_given, trials = np.linalg.norm(errors(given)), {words: errors(read(given)) for words, read in readings.items()}
    best = min(trials, key=lambda words: float(np.linalg.norm(trials[words])))
    error = np.linalg.norm(trials[best])
    alike = [words for words, each in trials.items() if np.linalg.norm(each) < CLEARLY / 2.0 * error]
    fits = CLEARLY * error < as_given and trials[best].max() < NEAR
    return " or ".join(alike) if fits else "", bool(is_observed or errors(given).max() > NEAR)
