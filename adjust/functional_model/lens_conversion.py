"""A lens in the words of another distortion family: the same one where the families mean the same, else the nearest.

Both are given the same rays. The principal distance, the principal point and the other family's parameters are fitted
to where the lens images these, over the frame; the orientations of images stay what they are. Families that mean the
same leave nothing, whatever their formulas, and no list of pairs is needed.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from adjust.array_types import Array
from adjust.errors import AdjustmentError
from adjust.functional_model.families import family, parameter_names
from adjust.functional_model.lens import INTERIOR_NAMES, Distortion, Lens

SAME = 1e-9  # of the principal distance: what two descriptions of one lens may differ by, of rounding
_GRID = 25  # points a side of the grid over the frame
_STEPS = 60
_STEP = 1e-13  # of the principal distance, in the image, below which the fit stands still
_RELATED = 1e-6  # of what one parameter does, in the image, from which on another follows it


@dataclass(frozen=True)
class ConvertedLens:
    """lens: in the other family, its covariance propagated from that of the source, exact where both say the same.

    estimated: the parameters that were fitted, the others are 0. by_source (3 + k, 3 + m): derivatives of the lens's
    values by those of the source. largest_mm, rms_mm: over the frame, what is left between the two, rms a point.
    """

    lens: Lens
    estimated: tuple[str, ...]
    by_source: Array
    largest_mm: float
    rms_mm: float

    @property
    def is_same(self) -> bool:
        """Whether both say the same, to rounding."""
        return self.largest_mm <= SAME * float(self.lens.interior[0])


def convert_lens(
    source: Lens,
    into: Distortion,
    corners_mm: Array,
    estimated: Sequence[str] | None = None,
    uncertain: Sequence[str] = (),
    held: Sequence[str] = (),
) -> ConvertedLens:
    """A lens in another family, over a rectangle of the camera frame.

    Parameters
    ----------
    source : Lens
        The lens that is converted.
    into : Distortion
        The other family and its settings, such as r0, and its parameters where they are not to begin at 0: those that
        are not estimated stay there.
    corners_mm : Array (2, 2)
        Two opposite corners of the rectangle.
    estimated : sequence of str, optional
        Which of the family's parameters; by default the usual ones, with affinity and shear where they bring something,
        less those that are 0 and stay it whatever the uncertain parameters of the source are.
    uncertain : sequence of str
        Parameters of the source that have a standard deviation.
    held : sequence of str
        Which of c, x0 and y0 are not estimated.

    Raises
    ------
    AdjustmentError
        Where the lens has no image there or no fit stands still.
    ValueError
        For a parameter that there is not.
    """
    rays = _Rays.from_lens(source, corners_mm)
    if estimated is not None:
        return rays.fit(into, tuple(estimated), held)
    usual, with_affinity = _usual(into.family)
    found = rays.fit(into, usual)
    if not found.is_same and with_affinity != usual:
        richer = rays.fit(into, with_affinity)
        found = richer if richer.rms_mm < found.rms_mm / 2.0 else found
    needed = rays.needed(found, [source.quantities.index(each) for each in uncertain])
    return found if needed == found.estimated else rays.fit(into, needed)


def frame_grid_mm(corners_mm: Array) -> Array:
    """Camera points (n, 2) over the rectangle between two opposite corners (2, 2)."""
    along = np.linspace(0.0, 1.0, _GRID)
    fractions = np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2)
    return np.asarray(corners_mm[0] + fractions * (corners_mm[1] - corners_mm[0]))


def _usual(name: str) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The parameters that a family is mostly used with, and with these its affinity and shear."""
    own_family = family(name)
    usual = tuple(own_family.ladder[-1].split()) if own_family.ladder else own_family.parameters
    affinity = dict(own_family.groups).get("affinity", ())
    return usual, tuple(each for each in own_family.parameters if each in usual or each in affinity)


@dataclass(frozen=True)
class _Rays:
    """Rays (n, 2), where the source images them (n, 2), and the derivatives (n, 2, 3 + m) of that by the source."""

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
        by_lens = np.concatenate([at.interior_jacobian, at.parameter_jacobian], axis=2)
        return cls(source, rays[found], grid_mm[found], -np.linalg.solve(at.xy_jacobian, by_lens))

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
                return self._ended(lens.replaced_values(values), columns, estimated)
        raise AdjustmentError(
            f"the lens cannot be brought to the family {into.family}: the fit finds no end. Name fewer of its "
            "parameters, or a family of the same kind."
        )

    def _linearised(self, lens: Lens, columns: list[int]) -> tuple[Array, Array]:
        """How far (n, 2) the other lens misses the observed places, and the derivatives (2 n, k) of that."""
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
        """Its parameters without those that do nothing at their values, nor where these columns of the source move."""
        lens = found.lens
        at = lens.equations(self.observed_mm, self.rays)
        per_unit = np.abs(at.parameter_jacobian).max(axis=(0, 1))
        by_source = np.abs(found.by_source[len(INTERIOR_NAMES) :, uncertain] * per_unit[:, None])
        moved = (by_source > _RELATED * np.abs(self.by_lens[..., uncertain]).max(axis=(0, 1))).any(axis=1)
        does = moved | (per_unit * np.abs(lens.parameters) > SAME * lens.interior[0])
        names = parameter_names(lens.distortion.family)
        return tuple(each for each in found.estimated if does[names.index(each)])


def _least_squares(design: Array, right: Array) -> Array:
    """(k, j) of columns that are brought to one size; a column that does nothing gets 0."""
    scale = np.linalg.norm(design, axis=0)
    scale[scale == 0.0] = 1.0
    return np.asarray(np.linalg.lstsq(design / scale, right, rcond=1e-14)[0] / scale[:, None])
