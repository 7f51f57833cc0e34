"""Templates of marks for the search in a reduced scan, rendered in each scan orientation."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from measure.array_types import Array
from measure.geometry import linear_scale, turn_by_quarters
from measure.marks.rendering import extent_px, known_picture
from measure.marks.shapes import Bar, Mark, MarkShape, MarkTemplate, thinnest_mm
from measure.scans.scan import Scan

_EXTENT_PX = 14.0  # px, smallest extent of the reduced mark
_THINNEST_PX = 1.2  # px, smallest width of its thinnest line, which would otherwise vanish
_BLUR_PX = 0.6  # px, blur of the reduced mark: 0.3 from averaging, and the rest from the scan
_RIM_PX = 2  # px of the reduced scan around the drawing, reach of the blur
_LARGEST_PX = 3000  # px, larger side of the reduced scan; a larger one costs seconds
_ALIKE = 0.8  # NCC above which two templates share one response
_LEARNED = 2.0  # in widths of the finest detail: wide notches and blocks would dominate the median of the background


@dataclass(frozen=True, eq=False)
class MarkView:
    """A mark in one scan orientation. linear: (2, 2) part of pixel_from_mark in the scan."""

    mark: Mark
    linear: Array


def detail_px(mark: Mark, linear: Array) -> float:
    """Width of the mark's finest detail in px, at least 1."""
    return max(linear_scale(linear) * thinnest_mm(mark), 1.0)


def ground_detail_px(view: MarkView, reduction: int) -> float:
    """Width of the structure that is not background, px of the reduced scan: the finest detail, more for a template."""
    wide = _LEARNED if isinstance(view.mark, MarkTemplate) else 1.0
    return max(wide * detail_px(view.mark, view.linear) / reduction, 1.0)


def search_reduction(scan: Scan, views: Sequence[MarkView]) -> int:
    """Reduction factor of the search: as large as needed, limited so that marks and lines remain visible."""
    limits = []
    for view in views:
        least, greatest = extent_px(view.mark, np.column_stack([view.linear, np.zeros(2)]))
        thinnest_px = linear_scale(view.linear) * thinnest_mm(view.mark)
        limits.append(min((greatest - least).max() / _EXTENT_PX, thinnest_px / _THINNEST_PX))
    needed = max(scan.width_px, scan.height_px) / _LARGEST_PX
    return min(max(1, int(min(limits)), int(np.ceil(needed))), scan.width_px, scan.height_px)


def distinct_templates(views: Sequence[MarkView], reduction: int, half_px: int) -> tuple[list[Array], tuple[int, ...]]:
    """Render the distinct templates of mark views.

    Parameters
    ----------
    half_px : largest half size of the template of a cross, px of the reduced scan.

    Returns
    -------
    The templates, and for each view the index of its template.
    """
    templates = _templates(views, reduction, half_px)
    own = list({id(template): template for template in templates}.values())
    correlations = _correlations(own)
    kinds: list[int] = []
    kind_by_id: dict[int, int] = {}
    for number, template in enumerate(own):
        if not (correlations[number, kinds] > _ALIKE).any():
            kinds.append(number)
        kind_by_id[id(template)] = int(correlations[number, kinds].argmax())
    return [own[number] for number in kinds], tuple(kind_by_id[id(template)] for template in templates)


def _templates(views: Sequence[MarkView], reduction: int, half_px: int) -> list[Array]:
    """Templates of views. Equal marks in the same direction share one; quarter turns and mirroring reuse it turned."""
    first: dict[Mark, tuple[Array, Array]] = {}
    drawn: dict[tuple[Mark, bytes], Array] = {}
    for view in views:
        key = view.mark, view.linear.tobytes()
        if key in drawn:
            continue
        if view.mark not in first:
            first[view.mark] = view.linear, _template(view, reduction, half_px)
        linear, template = first[view.mark]
        turn = view.linear @ np.linalg.inv(linear)
        drawn[key] = turn_by_quarters(template, turn) if _is_quarter(turn) else _template(view, reduction, half_px)
    return [drawn[view.mark, view.linear.tobytes()] for view in views]


def _is_quarter(turn: Array) -> bool:
    whole = np.rint(turn)
    return bool(np.allclose(turn, whole, atol=1e-9) and np.array_equal(np.abs(whole).sum(axis=0), [1, 1]))


def _template(view: MarkView, reduction: int, half_px: int) -> Array:
    place = np.column_stack([view.linear, np.zeros(2)]) / reduction
    half = int(np.ceil(np.abs(np.concatenate(extent_px(view.mark, place))).max())) + _RIM_PX
    if isinstance(view.mark, MarkShape) and any(isinstance(part, Bar) for part in view.mark.parts):
        half = min(half, half_px)
    place[:, 2] = half
    return known_picture(view.mark, place, 2 * half + 1, 2 * half + 1, _BLUR_PX)


def _correlations(templates: Sequence[Array]) -> Array:
    """(n, n) correlations of concentric templates; the smaller one of two is padded with zeros."""
    sizes = np.array([template.shape[0] for template in templates])
    flat = np.stack([np.pad(np.nan_to_num(each), (sizes.max() - len(each)) // 2).ravel() for each in templates])
    sums, count = flat.sum(axis=1), np.maximum(sizes[:, None], sizes) ** 2
    squares = (flat**2).sum(axis=1)
    spread = squares[:, None] - sums[:, None] ** 2 / count
    return np.asarray((flat @ flat.T - np.outer(sums, sums) / count) / np.sqrt(spread * spread.T))
