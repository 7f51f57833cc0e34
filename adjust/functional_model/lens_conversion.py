"""A lens in the words of another distortion family: the same one where the families mean the same, else the nearest.

Both are given the same rays. The principal distance, the principal point and the other family's parameters are fitted
to where the lens images these, over the frame; the orientations of images stay what they are. Families that mean the
same leave nothing, whatever their formulas, and no list of pairs is needed.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from adjust.errors import AdjustmentError
from adjust.functional_model.distortion import image_equations
from adjust.functional_model.families import family, parameter_names
from adjust.functional_model.lens import Distortion
from adjust.functional_model.projection import camera_from_ray, ideal_from_observed

Array = NDArray[np.float64]

SAME = 1e-9  # of the principal distance: what two descriptions of one lens may differ by, of rounding
_GRID = 25  # points a side of the grid over the frame
_STEPS = 60
_STEP = 1e-13  # of the principal distance, in the image, below which the fit stands still
_INTERIOR = 3
_RELATED = 1e-6  # of what one parameter does, in the image, from which on another follows it


@dataclass(frozen=True)
class ConvertedLens:
    """distortion: the family with its settings; interior (3,): c, x0', y0' in mm; parameters (k,) in its order.

    estimated: those that were fitted, the others are 0. by_source (3 + k, 3 + m): derivatives by what the lens was
    given by. largest_mm, rms_mm: over the frame, what is left between the two, rms a point.
    """

    distortion: Distortion
    interior: Array
    parameters: Array
    estimated: tuple[str, ...]
    by_source: Array
    largest_mm: float
    rms_mm: float

    @property
    def is_same(self) -> bool:
        """Whether both say the same, to rounding."""
        return self.largest_mm <= SAME * float(self.interior[0])

    def covariance(self, of_source: Array) -> Array:
        """(3 + k, 3 + k), from that (3 + m, 3 + m) of what the lens was given by; exact where both say the same."""
        return np.asarray(self.by_source @ of_source @ self.by_source.T)


def convert_lens(
    distortion: Distortion,
    interior: Array,
    parameters: Array,
    into: Distortion,
    corners_mm: Array,
    estimated: Sequence[str] | None = None,
    uncertain: Sequence[str] = (),
    held: Sequence[str] = (),
) -> ConvertedLens:
    """A lens in another family, over the rectangle between two corners (2, 2) in the camera frame.

    interior (3,): c, x0', y0' in mm; parameters (m,) in the order of `families.parameter_names`. into: the family and
    its settings, such as r0, and its parameters where they are not to begin at 0: those that are not estimated stay
    there. estimated: which of its parameters; by default the usual ones, with affinity and shear where they bring
    something, less those that are 0 and stay it whatever those parameters of the lens are that are uncertain. held:
    which of c, x0 and y0 are not estimated. Raises AdjustmentError where the lens has no image there or no fit stands
    still, ValueError for a parameter that there is not.
    """
    lens = _Rays.of(distortion, interior, parameters, corners_mm)
    if estimated is not None:
        return lens.fitted(into, tuple(estimated), held)
    usual, with_affinity = _usual(into.family)
    found = lens.fitted(into, usual)
    if not found.is_same and with_affinity != usual:
        richer = lens.fitted(into, with_affinity)
        found = richer if richer.rms_mm < found.rms_mm / 2.0 else found
    names = parameter_names(distortion.family)
    needed = lens.needed(found, [_INTERIOR + names.index(each) for each in uncertain])
    return found if needed == found.estimated else lens.fitted(into, needed)


def frame_grid_mm(corners_mm: Array) -> Array:
    """Camera points (n, 2) over the rectangle between two opposite corners (2, 2)."""
    along = np.linspace(0.0, 1.0, _GRID)
    fractions = np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2)
    return np.asarray(corners_mm[0] + fractions * (corners_mm[1] - corners_mm[0]))


def _usual(name: str) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The parameters that a family is mostly used with, and with these its affinity and shear."""
    of = family(name)
    usual = tuple(of.ladder[-1].split()) if of.ladder else of.parameters
    affinity = dict(of.groups).get("affinity", ())
    return usual, tuple(each for each in of.parameters if each in usual or each in affinity)


@dataclass(frozen=True)
class _Rays:
    """Rays (n, 2), where the lens images them (n, 2), and the derivatives (n, 2, 3 + m) of that by the lens."""

    rays: Array
    observed_mm: Array
    by_lens: Array
    interior: Array

    @classmethod
    def of(cls, distortion: Distortion, interior: Array, parameters: Array, corners_mm: Array) -> "_Rays":
        grid_mm = frame_grid_mm(corners_mm)
        ideal_mm, found = ideal_from_observed(distortion, interior, parameters, grid_mm)
        if found.sum() < found.size / 4:
            raise AdjustmentError(
                f"the lens that is to be converted ({distortion.family}) makes no image at {int((~found).sum())} of "
                f"{found.size} places of the frame: check its parameters, and the frame's size."
            )
        rays, observed_mm = (ideal_mm[found] - interior[1:]) / interior[0], grid_mm[found]
        at = image_equations(distortion, interior, parameters, observed_mm, rays)
        by_lens = np.concatenate([at.by_interior, at.by_parameters], axis=2)
        return cls(rays, observed_mm, -np.linalg.solve(at.by_xy, by_lens), interior)

    def fitted(self, into: Distortion, estimated: tuple[str, ...], held: Sequence[str] = ()) -> ConvertedLens:
        names = parameter_names(into.family)
        unknown = sorted(set(estimated) - set(names))
        if unknown:
            raise ValueError(
                f"{into.family} has no parameter {', '.join(unknown)}; it has {', '.join(names) or 'none'}"
            )
        interior = [k for k, each in enumerate(("c", "x0", "y0")) if each not in held]
        columns = [*interior, *(_INTERIOR + names.index(each) for each in names if each in estimated)]
        values = np.concatenate([self.interior, into.values])
        for _ in range(_STEPS):
            misfit, design = self._linearised(into, values, columns)
            step = _least_squares(design, misfit.reshape(-1, 1))[:, 0]
            values[columns] -= step
            if not (np.isfinite(values).all() and values[0] > 0.0):
                break
            if np.abs(design * step).max() <= _STEP * values[0]:
                return self._ended(into, values, columns, estimated)
        raise AdjustmentError(
            f"the lens cannot be brought to the family {into.family}: the fit finds no end. Name fewer of its "
            "parameters, or a family of the same kind."
        )

    def _linearised(self, into: Distortion, values: Array, columns: list[int]) -> tuple[Array, Array]:
        """How far (n, 2) the other lens misses the observed places, and the derivatives (2 n, k) of that."""
        at = image_equations(into, values[:_INTERIOR], values[_INTERIOR:], self.observed_mm, self.rays)
        by = np.stack([at.by_quantity(k) for k in columns], axis=2)
        misfit, design = (np.asarray(np.linalg.solve(at.by_xy, each)) for each in (at.value[..., None], by))
        return misfit[..., 0], design.reshape(-1, len(columns))

    def _ended(self, into: Distortion, values: Array, columns: list[int], estimated: tuple[str, ...]) -> ConvertedLens:
        interior, parameters = values[:_INTERIOR].copy(), values[_INTERIOR:].copy()
        imaged_mm, found = camera_from_ray(into, interior, parameters, self.rays)
        left_mm = np.linalg.norm(np.where(found[:, None], imaged_mm - self.observed_mm, np.inf), axis=1)
        _, design = self._linearised(into, values, columns)
        by_source = np.zeros((len(values), self.by_lens.shape[2]))
        by_source[columns] = -_least_squares(design, self.by_lens.reshape(-1, self.by_lens.shape[2]))
        rms_mm = float(np.sqrt((left_mm**2).mean()))
        return ConvertedLens(into, interior, parameters, estimated, by_source, float(left_mm.max()), rms_mm)

    def needed(self, lens: ConvertedLens, uncertain: Sequence[int]) -> tuple[str, ...]:
        """Its parameters without those that do nothing at their values, nor where these columns of the source move."""
        at = image_equations(lens.distortion, lens.interior, lens.parameters, self.observed_mm, self.rays)
        per_unit = np.abs(at.by_parameters).max(axis=(0, 1))
        by_source = np.abs(lens.by_source[_INTERIOR:, uncertain] * per_unit[:, None])
        moved = (by_source > _RELATED * np.abs(self.by_lens[..., uncertain]).max(axis=(0, 1))).any(axis=1)
        does = moved | (per_unit * np.abs(lens.parameters) > SAME * lens.interior[0])
        names = parameter_names(lens.distortion.family)
        return tuple(each for each in lens.estimated if does[names.index(each)])


def _least_squares(design: Array, right: Array) -> Array:
    """(k, j) of columns that are brought to one size; a column that does nothing gets 0."""
    scale = np.linalg.norm(design, axis=0)
    scale[scale == 0.0] = 1.0
    return np.asarray(np.linalg.lstsq(design / scale, right, rcond=1e-14)[0] / scale[:, None])
