"""Wrong names of points and fiducials, shown by each image alone before the network is adjusted.

The projective transformation of the given points to an image tells wrong numbers without a camera: with right ones it
fits but for the distortion, which all images share. Images that it fits worse by far are tried with other numbers. An
affine transformation of the given fiducials to a frame shows which of them have each other's names.
"""

import re
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import combinations, product
from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from adjust.array_types import Array, Indices, Mask
from adjust.initial_values.dlt import equations_by_point, linear_transformations, residual_squares
from adjust.problem.camera import Fiducial
from adjust.problem.network import Image, Network
from adjust.problem.parameter import shortened

NAMED = 5  # images named in a message
FEWEST = 8  # points of an image that tell by a linear transformation what is wrong with it
FEWEST_IMAGES = 3  # images needed for a median misfit
WORSE, LARGE = 4.0, 0.01  # times the median misfit of the images, and misfit above which other numbers are tried
BETTER, MUCH_BETTER = 3.0, 10.0  # ratio by which right numbers lower the misfit of an image worse than most, or alike
MOST_OFF = 30  # largest shift of numbers tried
QUARTERS = ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))  # cosine and sine
MOST_SHIFTED, FEWEST_SHIFTED = 3, 3  # rows by which a run of a table is shifted at most, and those of the shortest run
BREAKS, RUN_IMAGES = 40, 4  # rows where runs are first tried to begin and end; images with most points that show them
AS_GOOD = 2.0  # ratio of the squares of misfits up to which runs are alike: a wrong row multiplies them
FEW_HEIGHTS, DRAWS = 7, 4  # points of an image all combinations of whose heights are tried, and how often
FEWEST_FIDUCIALS = 4  # of a frame, that tell by an affine transformation which are exchanged
# Scan orientations: turned by quarters, and mirrored; the unmirrored ones first.
TURNS = [flip @ np.array([[c, -s], [s, c]]) for flip in (np.eye(2), np.diag([-1.0, 1.0])) for c, s in QUARTERS]


def misnumbered_images(network: Network) -> dict[str, str]:
    """Find the frames whose point numbers are off, with the reasons; empty where all may be right.

    All frames where numbers of the given points are: see `shifted_run`.
    """
    places, observations, fields = network.known_places, network.observations, transformed_fields(network)
    limit = WORSE * float(np.median([each.misfit for each in fields])) if fields else 0.0
    doubted = [each for each in fields if each.misfit > min(limit, LARGE)]
    if not doubted:
        return {}
    in_order = sorted(places, key=_natural)
    place_of, xyz = {name: k for k, name in enumerate(in_order)}, np.array([places[name] for name in in_order])
    orders, frames, left = list(_orders(xyz)), defaultdict[str, list[str]](list), list[TransformedField]()
    for each in doubted:
        numbers = [place_of[observations.point[row]] for row in each.rows]
        reordered = np.array([xyz[order[numbers]] for _, order in orders])
        xy_mm = np.broadcast_to(observations.xy_mm[each.rows], (*reordered.shape[:2], 2))
        misfits = linear_transformations(reordered, xy_mm).misfit
        best, better = int(np.argmin(misfits)), BETTER if each.misfit > limit else MUCH_BETTER
        if len(fields) >= FEWEST_IMAGES and better * misfits[best] < each.misfit:
            frames[orders[best][0]].append(each.image.frame)
        else:
            left.append(each)
    if 2 * len(left) > len(fields) and (words := _shifted_points(network, left)):
        return dict.fromkeys((image.frame for image in network.images), words)
    for each in left if len(fields) >= FEWEST_IMAGES else ():
        names = [observations.point[row] for row in each.rows]
        shown, all_present = np.array([places[name] for name in names]), np.ones((1, len(names)), dtype=bool)
        run = shifted_run(shown, observations.xy_mm[each.rows][None], all_present)
        if run is not None and run.times > (BETTER if each.misfit > limit else MUCH_BETTER):
            where = f"{names[run.low]} to {names[run.high - 1]}"
            frames[f"the marks {where} have the coordinates of the {_rows_on(run.shift)}"].append(each.image.frame)
    return {
        frame: f"the points of {shortened(some, NAMED)} are not numbered as they are given: {words}. Correct them."
        for words, some in frames.items()
        for frame in some
    }


def _shifted_points(network: Network, fields: Sequence["TransformedField"]) -> str:
    """Describe a run of the given points whose coordinates are those of other ones; empty where there is none."""
    names = [point.id for point in network.points if point.id in network.known_places]
    row_of = {name: row for row, name in enumerate(names)}
    fields = sorted(fields, key=lambda each: -len(each.rows))[:RUN_IMAGES]
    xy_mm, present = np.zeros((len(fields), len(names), 2)), np.zeros((len(fields), len(names)), dtype=bool)
    for image, field in enumerate(fields):
        rows = [row_of[network.observations.point[row]] for row in field.rows]
        xy_mm[image, rows], present[image, rows] = network.observations.xy_mm[field.rows], True
    run = shifted_run(np.array([network.known_places[name] for name in names]), xy_mm, present)
    if run is None or run.times < BETTER:
        return ""
    first, last = names[run.low + run.shift], names[run.high - 1 + run.shift]
    return (
        f"the points {first} to {last} are given with the coordinates of the {_rows_on(-run.shift)}: without this "
        f"linear transformations of the points fit the images {run.times:.2g} times better. Look for a row that is "
        f"left out or inserted near {first} and near {last}, in the points or in the marks of all images."
    )


def _rows_on(shift: int) -> str:
    """Name a row by the rows from another."""
    if abs(shift) == 1:
        return "next row" if shift > 0 else "row before"
    return f"row {abs(shift)} rows {'on' if shift > 0 else 'before'}"


class ShiftedRun(NamedTuple):
    """Rows low to high - 1 of a table, each of which is that of the name `shift` rows on.

    times: ratio of the misfits of linear transformations to the images as given and with it.
    """

    low: int
    high: int
    shift: int
    times: float


def shifted_run(xyz: Array, xy_mm: Array, present: Mask) -> ShiftedRun | None:
    """Find the run of a table's rows with which linear transformations fit best; None with too few rows.

    xyz (n, 3): points of the rows; xy_mm (m, n, 2), present (m, n): places of the rows' names in m images. In the run
    the places of a row are those of the point some rows on.
    """
    count = len(xyz)
    if count < FEWEST + FEWEST_SHIFTED or (present.sum(axis=1) < FEWEST).any():
        return None
    equations, step = equations_by_point(xyz, xy_mm, present), -(-count // BREAKS)

    def sums(shift: int) -> Array:
        """(m, n + 1, ...) sums of the normal equations of the first rows."""
        rows = equations(np.clip(np.arange(count) + shift, 0, count - 1))
        sums = (rows.swapaxes(-1, -2) @ rows).cumsum(axis=1)
        return np.concatenate([np.zeros_like(sums[:, :1]), sums], axis=1)

    def best_run(shift: int, runs: Iterable[tuple[int, int]], as_good: float = 1.0) -> ShiftedRun | None:
        """The best run, or the longest of those that are as good."""
        least = abs(shift) + FEWEST_SHIFTED
        some = [(low, high) for low, high in runs if low >= 0 and high <= count and least <= high - low < count]
        if not some:
            return None
        (first, last), shifted = np.array(some).T, sums(shift)
        # Rows that take from beyond the run, or give nothing to it, are left out.
        low, high = np.maximum(first, first - shift), np.minimum(last, last - shift)
        normal = given[:, first] + shifted[:, high] - shifted[:, low] + given[:, -1:] - given[:, last]
        squares = residual_squares(normal).sum(axis=0)
        alike = np.flatnonzero(squares <= as_good * squares.min())
        best = int(alike[np.argmax((high - low)[alike])])
        return ShiftedRun(int(low[best]), int(high[best]), shift, float(np.sqrt(as_given / squares[best])))

    given = sums(0)
    as_given = residual_squares(given[:, -1]).sum()
    breaks, shifts = [*range(0, count, step), count], range(-MOST_SHIFTED, MOST_SHIFTED + 1)
    found = [best_run(shift, combinations(breaks, 2)) for shift in shifts if shift]
    run = max((each for each in found if each), key=lambda each: each.times, default=None)
    if run is None:
        return None
    ends = min(run.low, run.low + run.shift), max(run.high, run.high + run.shift)
    reach = step + MOST_SHIFTED
    first, last = (range(end - reach, end + reach + 1) for end in ends)
    # A row that stands twice fits in the run and beyond it.
    return best_run(run.shift, product(first, last), AS_GOOD)


def exchanged_fiducials(network: Network) -> dict[str, str]:
    """Find the frames whose fiducials have each other's names, with the reasons; empty where all may be right.

    An affine transformation of the given coordinates fits them far better under other names.
    """
    reasons = defaultdict[str, list[str]](list)
    for number, image in enumerate(network.images):
        marks = network.camera_by_name[image.camera].fiducials
        rows = np.flatnonzero((network.image_numbers == number) & network.observations.has_kind("fiducial"))
        names = [network.observations.point[row] for row in rows]
        priors = [prior for name in names for prior in (marks[name].x_mm, marks[name].y_mm)]
        if len(names) < FEWEST_FIDUCIALS or not all(np.isfinite(prior.sigma) for prior in priors):
            continue
        given_mm = np.array([prior.value for prior in priors]).reshape(-1, 2)
        order = _other_names(given_mm, network.observations.xy_mm[rows])
        if renamed := {names[k]: names[other] for k, other in enumerate(order) if k != other}:
            reasons[renamed_words(renamed)].append(image.frame)
    return {
        frame: f"by the coordinates given, the fiducials of {shortened(some, NAMED)} have each other's names: {words}. "
        "Correct the names, or the coordinates in the camera file."
        for words, some in reasons.items()
        for frame in some
    }


def _other_names(given_mm: Array, xy_mm: Array) -> list[int]:
    """Index of the given mark (n, 2) that each observed one (n, 2) is, as few as possible exchanged."""
    as_named, (given_mm, xy_mm) = list(range(len(xy_mm))), (each - each.mean(axis=0) for each in (given_mm, xy_mm))
    misfit_mm = _affine_misfit(given_mm, xy_mm)
    found = [(0, as_named)]
    if misfit_mm > LARGE * np.ptp(xy_mm):
        found += [
            (int((order != as_named).sum()), order.tolist())
            for turned in TURNS
            for order in [linear_sum_assignment(cdist(xy_mm, given_mm @ turned.T))[1]]
            if MUCH_BETTER * _affine_misfit(given_mm[order], xy_mm) < misfit_mm
        ]
    return min(found[1:] or found, key=lambda each: each[0])[1]


def _affine_misfit(given_mm: Array, xy_mm: Array) -> float:
    """Root mean square of what an affine transformation of centred places (n, 2) leaves of others."""
    rest = xy_mm - given_mm @ np.linalg.lstsq(given_mm, xy_mm, rcond=None)[0]
    return float(np.sqrt(np.mean(rest**2)))


def renamed_words(renamed: Mapping[str, str]) -> str:
    """Describe right names by the given ones."""
    if len(renamed) == 2:
        return f"{' and '.join(sorted(renamed))} are exchanged"
    return ", ".join(f"{name} is {other}" for name, other in renamed.items())


def turned_layouts(marks: Mapping[str, Fiducial]) -> Iterator[dict[str, str]]:
    """Names of the fiducials, by their own, that lie where these do in a frame turned by quarters, or mirrored."""
    if len(marks) < FEWEST_FIDUCIALS:
        return
    names = list(marks)
    given_mm = np.array([(mark.x_mm.value, mark.y_mm.value) for mark in marks.values()])
    given_mm -= given_mm.mean(axis=0)
    for turned in TURNS:
        distances = cdist(given_mm @ turned.T, given_mm)
        order = linear_sum_assignment(distances)[1]
        renamed = {names[k]: names[other] for k, other in enumerate(order) if k != other}
        if renamed and distances[range(len(order)), order].max() < LARGE * np.ptp(given_mm):
            yield renamed


class TransformedField(NamedTuple):
    """Linear transformation of the given points (n,) of an image to their marks: see `linear_transformations`."""

    image: Image
    rows: Indices
    misfit: float
    handedness: float


def transformed_fields(network: Network) -> list[TransformedField]:
    """Transform the given points of every image that shows FEWEST of them, many images at once."""
    names, number = network.observations.numbered_points
    nowhere, found = np.full(3, np.nan), dict[int, TransformedField]()
    given = np.array([network.known_places.get(name, nowhere) for name in names]).reshape(-1, 3)[number]
    rows = np.flatnonzero(~np.isnan(given[:, 0]) & ~network.observations.is_fiducial)
    counts = np.bincount(network.image_numbers[rows], minlength=len(network.images))
    of_images = np.split(rows[np.argsort(network.image_numbers[rows], kind="stable")], np.cumsum(counts)[:-1])
    for size in np.unique(counts[counts >= FEWEST]):
        images = np.flatnonzero(counts == size)
        some = np.array([of_images[image] for image in images])
        fits = linear_transformations(given[some], network.observations.xy_mm[some])
        columns = [network.images[image] for image in images], some, fits.misfit.tolist(), fits.handedness.tolist()
        found |= zip(images.tolist(), map(TransformedField._make, zip(*columns, strict=True)), strict=True)
    return [found[image] for image in sorted(found)]


def points_with_scaled_heights(network: Network, factor: float) -> tuple[set[str], set[str]]:
    """Names of the given points whose heights times a factor let linear transformations fit far better, and of those
    whose heights this hardly changes; none where all or none would be such."""
    names: dict[str, float] = {}
    fields = transformed_fields(network)
    if not fields or MUCH_BETTER * max(each.misfit for each in fields) < LARGE:
        return set(), set()
    for field in sorted(fields, key=lambda each: -len(each.rows)):
        shown = [network.observations.point[row] for row in field.rows]
        if names.keys() >= set(shown):
            continue
        xyz, xy_mm = np.array([network.known_places[name] for name in shown]), network.observations.xy_mm[field.rows]
        ratios, times = _scaled_heights(xyz, xy_mm, factor)
        if times < BETTER:
            return set(), set()
        names |= dict(zip(shown, ratios.tolist(), strict=True))
    scaled = {name for name, ratio in names.items() if ratio > BETTER}
    doubtful = {name for name, ratio in names.items() if 1.0 / BETTER <= ratio <= BETTER}
    return (scaled, doubtful) if len(scaled) + len(doubtful) < len(names) else (set(), set())


def _scaled_heights(xyz: Array, xy_mm: Array, factor: float) -> tuple[Array, float]:
    """Ratios (n,) of the residuals of points (n, 3) without and with scaled heights, and that of the misfits.

    All combinations are tried on a few points; the transformation of the best tells those of all others.
    """
    generator = np.random.default_rng(0)
    combinations_of_few = np.array(list(product((False, True), repeat=FEW_HEIGHTS)))
    both = np.stack([xyz, xyz * (1.0, 1.0, factor)])
    best = np.inf, np.ones(len(xyz))
    shared = np.broadcast_to(xy_mm, (len(combinations_of_few), *xy_mm.shape))
    for _ in range(DRAWS):
        few = generator.permutation(len(xyz))[:FEW_HEIGHTS]
        masks = np.zeros((len(combinations_of_few), len(xyz)), dtype=bool)
        masks[:, few] = combinations_of_few
        present = np.zeros_like(masks)
        present[:, few] = True
        for _ in range(2):
            fits = linear_transformations(np.where(masks[..., None], both[1], both[0]), shared, present)
            off = np.stack([fits.residuals(np.broadcast_to(each, (len(masks), *xyz.shape)), shared) for each in both])
            masks, present = off[1] < off[0], np.ones_like(present)
        misfits = np.sqrt(np.mean(off.min(axis=0) ** 2, axis=1))
        if misfits.min() < best[0]:
            own = off[:, int(np.argmin(misfits))]
            best = float(misfits.min()), own[0] / np.maximum(own[1], 1e-300)
    given = linear_transformations(xyz[None], xy_mm[None])
    as_given = float(np.sqrt(np.mean(given.residuals(xyz[None], xy_mm[None]) ** 2)))
    return best[1], as_given / best[0]


def _natural(name: str) -> list[tuple[int, str]]:
    """Sorting key by which p10 follows p9."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", name)]


def _orders(xyz: Array) -> Iterator[tuple[str, Indices]]:
    """Other orders of numbered points (p, 3): the point at each number, with words."""
    count = len(xyz)
    for off in range(1, min(MOST_OFF, count // 2) + 1):
        for sign, how in ((1, "high"), (-1, "low")):
            yield f"their numbers are {off} too {how}", (np.arange(count) - sign * off) % count
    steps = np.linalg.norm(np.diff(xyz, axis=0), axis=1)
    ends = np.flatnonzero(steps > 1.5 * np.median(steps)) + 1  # of the lines of a field that is numbered by lines
    if len(ends) and len(set(np.diff([0, *ends, count]).tolist())) == 1:
        lines = np.arange(count).reshape(len(ends) + 1, -1)
        yield "these are numbered by columns, not by rows, or the reverse", lines.T.ravel()
        turned = lines.copy()
        turned[1::2] = lines[1::2, ::-1]
        yield "these are numbered to and fro, or only here not", turned.ravel()
