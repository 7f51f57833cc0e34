"""Which disk is which target: the shift that all predictions share, then the one disk at each place."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from measure.noise.robust_estimation import robust_scale
from measure.reason import NO_REASON, Code, Reason

Array = NDArray[np.float64]

_AFFINE_FROM = 8  # targets that agree: from so many on the shared shift may vary over the frame
_VOTE_SHARE = 0.2  # of the farthest link: how far shifts may differ and still count as one
_ROUNDS = 5  # of the shared shift and the gate, each by the other
_FORBIDDEN = 1e9  # px: the cost of a link that there is not


@dataclass(frozen=True, eq=False)
class Links:
    """places (n, 2): predicted; centers (m, 2): of the disks; near: for each place the indices of the disks that may be
    its target."""

    places: Array
    centers: Array
    near: list[list[int]]

    def pairs(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Indices of place and disk of every link."""
        pairs = [(place, disk) for place, disks in enumerate(self.near) for disk in disks]
        place, disk = np.array(pairs, int).reshape(-1, 2).T
        return place, disk


@dataclass(frozen=True)
class Assignment:
    """For each place: chosen, the disk, or None; nearest: the disk that was refused, or None; why_not: the reason."""

    chosen: list[int | None]
    nearest: list[int | None]
    why_not: list[Reason]


def assign(links: Links, gate_sigmas: float, least_gate_px: float) -> Assignment:
    """One disk a place at most, and one place a disk; a place with two disks in its gate gets none."""
    count = len(links.places)
    chosen: list[int | None] = [None] * count
    nearest: list[int | None] = [None] * count
    why_not = [NO_REASON] * count
    place, disk = links.pairs()
    if not len(place):
        return Assignment(chosen, nearest, why_not)
    residuals, gate = _shared_shift_residuals(links, place, disk, gate_sigmas, least_gate_px)
    cost = np.full((count, len(links.centers)), _FORBIDDEN)
    cost[place, disk] = residuals
    gated = np.where(cost <= gate, cost, _FORBIDDEN)
    for one_place, one_disk in zip(*linear_sum_assignment(gated), strict=True):
        if gated[one_place, one_disk] < _FORBIDDEN:
            chosen[int(one_place)] = int(one_disk)
    taken = {index for index in chosen if index is not None}
    for row, own in enumerate(chosen.copy()):
        rivals = [index for index in np.flatnonzero(gated[row] < _FORBIDDEN) if index not in taken]
        if own is not None and rivals:
            chosen[row], nearest[row] = None, own
            why_not[row] = Reason(f"{len(rivals) + 1} disks lie within {gate:.1f} px of its place", Code.AMBIGUOUS)
        elif own is None and links.near[row]:
            best = links.near[row][int(np.argmin(cost[row, links.near[row]]))]
            off = float(cost[row, best])
            nearest[row] = best
            why_not[row] = (
                Reason("the disk at its place is another target", Code.AMBIGUOUS)
                if best in taken and off <= gate
                else Reason(f"what was found lies {off:.1f} px from where the other targets put it", Code.OFF_PLACE)
            )
    return Assignment(chosen, nearest, why_not)


def _shared_shift_residuals(
    links: Links, place: NDArray[np.int64], disk: NDArray[np.int64], gate_sigmas: float, least_gate_px: float
) -> tuple[Array, float]:
    """Lengths of all links less the shift that most of them share, and the gate: a few robust standard deviations of
    the links that share it."""
    shifts = links.centers[disk] - links.places[place]
    tolerance = max(least_gate_px, _VOTE_SHARE * float(np.hypot(*shifts.T).max()))
    common = _most_voted(shifts, place, tolerance)
    residuals = np.hypot(*(shifts - common).T)
    gate = tolerance
    for _ in range(_ROUNDS):
        agreeing = _best_of_each_place(place, residuals) & (residuals <= gate)
        if agreeing.sum() < 3:
            break
        model = _shift_model(links.places[place], shifts, agreeing)
        left = shifts - model
        residuals = np.hypot(*left.T)
        sigma = robust_scale(left[agreeing].ravel())
        gate = float(np.clip(gate_sigmas * sigma, least_gate_px, tolerance))
    return residuals, gate


def _most_voted(shifts: Array, place: NDArray[np.int64], tolerance: float) -> Array:
    """(2,) the shift that the links of most places agree with, each place counted once; of equals the shortest."""
    best, best_votes = shifts[0], (-1, 0.0)
    for shift in shifts:
        agree = np.hypot(*(shifts - shift).T) <= tolerance
        votes = (len(np.unique(place[agree])), -float(np.hypot(*shift)))
        if votes > best_votes:
            best, best_votes = shifts[agree].mean(axis=0), votes
    return np.asarray(best)


def _best_of_each_place(place: NDArray[np.int64], residuals: Array) -> NDArray[np.bool_]:
    """Which links are the shortest of their place."""
    order = np.lexsort((residuals, place))
    first = np.zeros(len(place), bool)
    first[order[np.unique(place[order], return_index=True)[1]]] = True
    return first


def _shift_model(places: Array, shifts: Array, agreeing: NDArray[np.bool_]) -> Array:
    """(n, 2) the shared shift at all places: their median, or an affine function where there are enough."""
    if agreeing.sum() < _AFFINE_FROM:
        return np.broadcast_to(np.median(shifts[agreeing], axis=0), shifts.shape)
    middle, spread = places[agreeing].mean(axis=0), np.maximum(places[agreeing].std(axis=0), 1.0)
    design = np.column_stack([np.ones(len(places)), (places - middle) / spread])
    coefficients = np.linalg.lstsq(design[agreeing], shifts[agreeing], rcond=None)[0]
    return np.asarray(design @ coefficients)
