"""Convert a lens to another distortion family: exactly where the families are equivalent, else by least squares.

Both lenses get the same rays. Principal distance, principal point and the parameters of the target family are fitted to
the image points of the source lens over the frame; exterior orientations do not change. Equivalent families leave no
residuals, whatever their formulas, so that no list of equivalent pairs is needed.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from adjust.array_types import Array
from adjust.errors import AdjustmentError
from adjust.functional_model.families import family, parameter_names
from adjust.functional_model.lens import INTERIOR_NAMES, Distortion, Lens

SAME = 1e-9  # fraction of the principal distance: largest rounding difference of two equivalent descriptions
_GRID = 25  # points per side of the grid over the frame
_STEPS = 60
_STEP = 1e-13  # fraction of the principal distance: what has less effect in the image, a step or a value, is rounding
_RELATED = 1e-6  # fraction of a source parameter's effect in the image: a parameter that changes by more depends on it


@dataclass(frozen=True)
class ConvertedLens:
    """Result of a conversion."""

    lens: Lens  # lens in the target family, its covariance propagated from the source; exact for equivalent families
    estimated: tuple[str, ...]  # names of the fitted parameters
    by_source: Array  # (3 + k, 3 + m) derivatives of the lens's values with respect to those of the source
    # largest_mm, rms_mm: largest and rms residual of a point over the frame
    largest_mm: float
    rms_mm: float

    @property
    def is_same(self) -> bool:
        """Whether both lenses agree to rounding."""
        return self.largest_mm <= SAME * float(self.lens.interior[0])


def convert_lens(
    source: Lens,
    into: Distortion,
    corners_mm: Array,
    estimated: Sequence[str] | None = None,
    uncertain: Sequence[str] = (),
    held: Sequence[str] = (),
) -> ConvertedLens:
    """Convert a lens to another family over a rectangle of the camera frame.

    Parameters
    ----------
    source : lens to convert.
    into : target family and its settings, such as r0, and initial values of parameters that do not start at 0.
        Parameters that are not estimated keep these values.
    corners_mm : (2, 2) two opposite corners of the rectangle.
    estimated : optional; parameters of the target family to fit. Default: the usual ones, with affinity and shear where
        these at least halve the rms, without those that stay 0 whatever the uncertain parameters of the source are.
    uncertain : quantities of the source that have a standard deviation.
    held : which of c, x0 and y0 are not estimated.

    Raises
    ------
    AdjustmentError
        If the source has no rays in most of the frame, or the fit does not converge.
    ValueError
        For an unknown parameter.
    """
    rays = _Rays.from_lens(source, corners_mm)
    if estimated is not None:
        return rays.fit(into, tuple(estimated), held)
    target = family(into.family)
    usual = tuple(target.ladder[-1].split()) if target.ladder else target.parameters
    affinity = dict(target.groups).get("affinity", ())
    with_affinity = tuple(each for each in target.parameters if each in usual or each in affinity)
    found = rays.fit(into, usual)
    if not found.is_same and with_affinity != usual:
        richer = rays.fit(into, with_affinity)
        found = richer if richer.rms_mm < found.rms_mm / 2.0 else found
    needed = rays.needed(found, [source.quantities.index(each) for each in uncertain])
    return found if needed == found.estimated else rays.fit(into, needed)


def frame_grid_mm(corners_mm: Array) -> Array:
    """Grid of camera points (n, 2) over the rectangle between two opposite corners (2, 2), mm."""
    along = np.linspace(0.0, 1.0, _GRID)
    fractions = np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2)
    return np.asarray(corners_mm[0] + fractions * (corners_mm[1] - corners_mm[0]))


@dataclass(frozen=True)
class _Rays:
    """Rays (n, 2), their image points (n, 2) in the source, and the derivatives (n, 2, 3 + m) of these."""

    source: Lens
    rays: Array
    observed_mm: Array
    by_lens: Array

    @classmethod
    def from_lens(cls, source: Lens, corners_mm: Array) -> "_Rays":
        grid_mm = frame_grid_mm(corners_mm)
        rays, found = source.ray_from_observed(grid_mm)
        if found.sum() < found.size / 4:
            raise AdjustmentError(
                f"the lens that is to be converted ({source.distortion.family}) makes no image at "
                f"{int((~found).sum())} of {found.size} places of the frame: check its parameters, and the frame's "
                "size."
            )
        at = source.equations(grid_mm[found], rays[found])
        by_lens = np.asarray(-np.linalg.solve(at.xy_jacobian, at.quantity_jacobian), dtype=np.float64)
        return cls(source, rays[found], grid_mm[found], by_lens)

    def fit(self, into: Distortion, estimated: tuple[str, ...], held: Sequence[str] = ()) -> ConvertedLens:
        names = parameter_names(into.family)
        unknown = sorted(set(estimated) - set(names))
        if unknown:
            raise ValueError(
                f"{into.family} has no parameter {', '.join(unknown)}; it has {', '.join(names) or 'none'}"
            )
        lens = Lens(into, self.source.interior, into.values)
        sought = {*INTERIOR_NAMES} - {*held} | {*estimated}
        columns = [k for k, each in enumerate(lens.quantities) if each in sought]
        values = lens.values
        for _ in range(_STEPS):
            misfit, design = self._linearised(lens.replaced_values(values), columns)
            step = _least_squares(design, misfit.reshape(-1, 1))[:, 0]
            values[columns] -= step
            if not (np.isfinite(values).all() and values[0] > 0.0):
                break
            if np.abs(design * step).max() <= _STEP * values[0]:
                effect_mm = np.abs(design * values[columns]).max(axis=0)
                values[columns] = np.where(effect_mm > _STEP * values[0], values[columns], 0.0)
                return self._ended(lens.replaced_values(values), columns, estimated)
        raise AdjustmentError(
            f"the lens cannot be brought to the family {into.family}: the fit does not converge. Name fewer of its "
            "parameters, or a family of the same kind."
        )

    def _linearised(self, lens: Lens, columns: list[int]) -> tuple[Array, Array]:
        """Misfit (n, 2) of the target lens at the observed places, and its derivatives (2 n, k)."""
        at = lens.equations(self.observed_mm, self.rays)
        by = np.stack([at.quantity_derivative(k) for k in columns], axis=2)
        misfit, design = (np.asarray(np.linalg.solve(at.xy_jacobian, each)) for each in (at.value[..., None], by))
        return misfit[..., 0], design.reshape(-1, len(columns))

    def _ended(self, lens: Lens, columns: list[int], estimated: tuple[str, ...]) -> ConvertedLens:
        imaged_mm, found = lens.camera_from_ray(self.rays)
        left_mm = np.linalg.norm(np.where(found[:, None], imaged_mm - self.observed_mm, np.inf), axis=1)
        _, design = self._linearised(lens, columns)
        by_source = np.zeros((len(lens.quantities), self.by_lens.shape[2]))
        by_source[columns] = -_least_squares(design, self.by_lens.reshape(-1, self.by_lens.shape[2]))
        rms_mm = float(np.sqrt((left_mm**2).mean()))
        if len(self.source.covariance):
            lens = replace(lens, covariance=by_source @ self.source.covariance @ by_source.T)
        return ConvertedLens(lens, estimated, by_source, float(left_mm.max()), rms_mm)

    def needed(self, found: ConvertedLens, uncertain: Sequence[int]) -> tuple[str, ...]:
        """Names of the parameters that have an effect at their values or depend on uncertain columns of the source."""
        lens = found.lens
        at = lens.equations(self.observed_mm, self.rays)
        per_unit = np.abs(at.quantity_jacobian[..., len(INTERIOR_NAMES) :]).max(axis=(0, 1))
        by_source = np.abs(found.by_source[len(INTERIOR_NAMES) :, uncertain] * per_unit[:, None])
        moved = (by_source > _RELATED * np.abs(self.by_lens[..., uncertain]).max(axis=(0, 1))).any(axis=1)
        does = moved | (per_unit * np.abs(lens.parameters) > SAME * lens.interior[0])
        names = parameter_names(lens.distortion.family)
        return tuple(each for each in found.estimated if does[names.index(each)])


def _least_squares(design: Array, right: Array) -> Array:
    """Least-squares solution (k, j) with scaled columns; a zero column gets 0."""
    scale = np.linalg.norm(design, axis=0)
    scale[scale == 0.0] = 1.0
    return np.asarray(np.linalg.lstsq(design / scale, right, rcond=1e-14)[0] / scale[:, None])
