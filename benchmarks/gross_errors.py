"""Gross errors of ten standard deviations: how many are found and named, one at a time and two at once.

python -m benchmarks gross_errors [PLACES]

The five-image case (ten control points, eight fiducials), with given fiducials of 5 um and control of 0.05 m, for
with priors of 1 mm, or fixed points, no error of that kind could be seen or be made. Every run draws all errors anew.
"""

import sys
import time
from dataclasses import dataclass, field, replace
from itertools import combinations_with_replacement

import numpy as np
from realisations import Exact, exact, realisation
from reference_cases import load
from scipy import special

from adjust.problem.network import Network
from adjust.problem.probabilities import Probabilities
from adjust.quality.snooping import Suspect
from adjust.solution.adjustment import Options, adjust
from adjust.solution.result import Adjustment

SIGMAS = 10.0
KINDS = ("fiducial", "datum", "control", "target")
WORDS = {
    "fiducial": "fiducial reading",
    "datum": "given fiducial",
    "control": "control point",
    "target": "target",
}


@dataclass(frozen=True)
class Place:
    """Where a gross error is made: the number of what is tested, which coordinate of it, and its name."""

    unit: int
    axis: int
    name: str


@dataclass
class Count:
    """What became of the errors of some runs.

    expected: how many the theory lets be named, each alone. alike: another was named, with the right one among those
    that cannot be told apart from it. missed: the redundancy numbers of those that were not named.
    """

    made: int = 0
    named: int = 0
    expected: float = 0.0
    alike: int = 0
    missed: list[float] = field(default_factory=list)
    false_alarms: int = 0


def main() -> None:
    """Print how many errors of every kind, and of every pair of kinds, are named."""
    places = int(sys.argv[1]) if len(sys.argv) > 1 else 100
    case = exact(load("i_five_images_affine_reduced"), fiducial_sigma_mm=0.005, control_sigma=0.05)
    clean = adjust(case.network, case.start)
    begin = time.perf_counter()
    print(f"{'error of 10 sigma in':38} {'made':>5} {'named':>6} {'expected':>9} {'alike':>6} {'missed':>7}", end="")
    print(f" {'with r of':>10} {'false':>6}")
    for kinds in [(kind,) for kind in KINDS] + list(combinations_with_replacement(KINDS, 2)):
        count = study(case, clean, kinds, places)
        among = f"{min(count.missed):.2f}-{max(count.missed):.2f}" if count.missed else ""
        words = " and ".join(WORDS[kind] for kind in kinds)
        print(f"{words:38} {count.made:5d} {count.named:6d} {count.expected:9.1f} {count.alike:6d}", end="")
        print(f" {len(count.missed):7d} {among:>10} {count.false_alarms:6d}", flush=True)
    print(f"{time.perf_counter() - begin:.0f} s")


def study(case: Exact, clean: Adjustment, kinds: tuple[str, ...], runs: int) -> Count:
    """Make errors of some kinds together, in so many random places."""
    count = Count()
    for run in range(runs):
        rng = np.random.default_rng([len(kinds), *(KINDS.index(kind) for kind in kinds), run])
        chosen = draw(clean, kinds, rng)
        network = realisation(case.network, rng)
        for place in chosen:
            network = with_error(network, clean, place, SIGMAS * rng.choice([-1.0, 1.0]))
        found = adjust(network, case.start, Options(snooping=True)).suspects
        judge(count, found, chosen, clean)
    return count


def draw(clean: Adjustment, kinds: tuple[str, ...], rng: np.random.Generator) -> list[Place]:
    """Different places of some kinds."""
    assert clean.reliability is not None
    tested = clean.reliability.tested
    chosen: list[Place] = []
    for kind in kinds:
        members = [i for i, each in enumerate(tested) if each.group == kind and i not in [p.unit for p in chosen]]
        unit = int(rng.choice(members))
        axis = int(rng.integers(len(tested[unit].coordinates)))
        chosen.append(Place(unit, axis, tested[unit].name))
    return chosen


def judge(count: Count, found: tuple[Suspect, ...], chosen: list[Place], clean: Adjustment) -> None:
    """Compare what was named with what was made."""
    assert clean.reliability is not None
    names = {suspect.tested.name for suspect in found}
    likely = {name for suspect in found for name in suspect.alike}
    made = {place.name for place in chosen}
    count.made += len(chosen)
    for place in chosen:
        count.expected += power(clean, place)
        if place.name in names:
            count.named += 1
        elif place.name in likely:
            count.alike += 1
        else:
            count.missed.append(float(clean.reliability.redundancy[place.unit, place.axis]))
    count.false_alarms += sum(
        suspect.tested.name not in made and not made.intersection(suspect.alike) for suspect in found
    )


def power(clean: Adjustment, place: Place) -> float:
    """The probability of an error alone being named: that of its test exceeding its critical value."""
    reliability, probabilities = clean.reliability, Probabilities()
    assert reliability is not None
    size = int(reliability.sizes[place.unit])
    critical = probabilities.critical(reliability.sizes, int((reliability.sizes > 0).sum()))[place.unit]
    sigma = given_sigma(clean, place)
    shift = probabilities.noncentrality(1) * SIGMAS * sigma / reliability.smallest[place.unit, place.axis]
    return 1.0 - float(special.chndtr(critical, size, shift**2))


def given_sigma(clean: Adjustment, place: Place) -> float:
    """The standard deviation that the coordinate was given."""
    assert clean.reliability is not None
    tested = clean.reliability.tested[place.unit]
    if tested.group in ("target", "fiducial"):
        return float(np.sqrt(clean.network.observations.covariance_mm2[place.unit, place.axis, place.axis]))
    coordinate = tested.coordinates[place.axis]
    if tested.group == "control":
        return float(getattr(clean.network.point_by_id[tested.point], coordinate).sigma)
    return float(getattr(clean.network.cameras[0].fiducials[tested.point], f"{coordinate}_mm").sigma)


def with_error(network: Network, clean: Adjustment, place: Place, sigmas: float) -> Network:
    """The network with one wrong coordinate."""
    assert clean.reliability is not None
    tested = clean.reliability.tested[place.unit]
    if tested.group in ("target", "fiducial"):
        observations = network.observations
        xy = observations.xy_mm.copy()
        xy[place.unit, place.axis] += sigmas * given_sigma(clean, place)
        return replace(network, observations=replace(observations, xy_mm=xy))
    coordinate = tested.coordinates[place.axis]
    if tested.group == "control":
        points = list(network.points)
        at = [point.id for point in points].index(tested.point)
        prior = getattr(points[at], coordinate)
        points[at] = replace(points[at], **{coordinate: replace(prior, value=prior.value + sigmas * prior.sigma)})
        return replace(network, points=tuple(points))
    camera = network.cameras[0]
    mark = camera.fiducials[tested.point]
    key = f"{coordinate}_mm"
    prior = getattr(mark, key)
    wrong = replace(mark, **{key: replace(prior, value=prior.value + sigmas * prior.sigma)})
    return replace(network, cameras=(replace(camera, fiducials=dict(camera.fiducials) | {tested.point: wrong}),))


if __name__ == "__main__":
    main()
