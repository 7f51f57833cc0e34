"""Crossings under a lens with coma: one definition of their place for all pictures of a camera.

Coma blurs edges to one side, the more so the farther from the axis, and a crossing has then no one place: matched under
a symmetric blur it lies elsewhere than where its gradients' lines meet (`junction`), by tenths of a pixel.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from measure.covariance import Covariance
from measure.results import MarkMeasurement

Array = NDArray[np.float64]

_NEIGHBOURS = 4  # crossings: the next ones along the rows and columns
_FEWEST_CROSSINGS = 30  # with fewer nobody can tell coma from noise


def one_definition(pictures: Sequence[Sequence[MarkMeasurement]]) -> tuple[tuple[MarkMeasurement, ...], ...]:
    """The marks of a camera's pictures as they are, or all its crossings at their junctions where the lens has coma.

    Where a symmetric blur describes the edges, match and junction differ by noise alone, of which the match has less.
    Coma moves them apart alike in neighbouring crossings, so that the mean product of neighbours' differences is its
    share of their mean square. Beyond one half it is larger than what the junction's noise adds; then the junctions are
    taken, which `cv2.cornerSubPix` and most published calibrations measure too. Their error is made by the lens and not
    by noise: all have the standard deviation of a place known to within the rms distance of match and junction, over
    the root of three (JCGM 100:2008, Guide to the expression of uncertainty in measurement, 4.3.7).
    """
    apart, alike = [], []
    for marks in pictures:
        crossings = [mark for mark in marks if _has_junction(mark)]
        if len(crossings) > _NEIGHBOURS:
            centers = np.array([mark.center_px for mark in crossings])
            differences = np.array([_junction(mark) for mark in crossings]) - centers
            near = np.asarray(KDTree(centers).query(centers, _NEIGHBOURS + 1)[1])[:, 1:]
            apart.append(differences)
            alike.append((differences[:, None, :] * differences[near]).mean(axis=1))
    if sum(map(len, apart)) < _FEWEST_CROSSINGS:
        return tuple(tuple(marks) for marks in pictures)
    variance = float((np.concatenate(apart) ** 2).mean())
    if float(np.concatenate(alike).mean()) <= variance / 2:
        return tuple(tuple(marks) for marks in pictures)
    return tuple(tuple(_at_junction(mark, variance / 3) for mark in marks) for marks in pictures)


def _has_junction(mark: MarkMeasurement) -> bool:
    return mark.status.is_observation and "junction_col_px" in mark.quality


def _junction(mark: MarkMeasurement) -> Array:
    return np.array([mark.quality["junction_col_px"], mark.quality["junction_row_px"]])


def _at_junction(mark: MarkMeasurement, variance_px2: float) -> MarkMeasurement:
    if not _has_junction(mark):
        return mark
    return replace(mark, center_px=_junction(mark), covariance=Covariance.of_noise(variance_px2 * np.eye(2)))
