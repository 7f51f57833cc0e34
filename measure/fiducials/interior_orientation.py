"""The frame through its marks: by weighted least squares a similarity, with the affinity that film and scanner have."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from measure.fiducials.options import AFFINITY_SIGMA
from measure.flags import TRUE_MARK_AN_OUTLIER

Array = NDArray[np.float64]

_MANY = 8  # marks whose scatter says more than the gate
_LINEAR = [0, 1, 4, 5]  # of the unknowns: all but the shift
_LEAST_GATE = 0.1  # of the gate: film bends marks so far off, however well most agree


def interleaved(*columns: tuple[Array, Array]) -> Array:
    """(2n, k) of k columns, each of them (n,) in x and (n,) in y."""
    return np.stack([np.stack(each, axis=1).ravel() for each in columns], axis=1)


def film_terms(model: str, places: Array) -> Array:
    """(2n, k) what a film model adds to an affine transformation at places (n, 2), to first order.

    model: projective, bilinear, conformal(n) or polynomial(n); any other adds nothing.
    """
    x, y = places.T
    none = np.zeros_like(x)
    name, _, order = model.rstrip(")").partition("(")
    powers = range(2, int(order) + 1) if order.isdigit() else range(0)
    if name == "projective":
        return interleaved((x**2, x * y), (x * y, y**2))
    if name == "bilinear":
        return interleaved((x * y, none), (none, x * y))
    if name == "conformal" and powers:
        z = [(x + 1j * y) ** power for power in powers]
        return interleaved(*[(each.real, each.imag) for each in z], *[(-each.imag, each.real) for each in z])
    if name == "polynomial" and powers:
        terms = [x ** (degree - q) * y**q for degree in powers for q in range(degree + 1)]
        return interleaved(*[(each, none) for each in terms], *[(none, each) for each in terms])
    return np.zeros((2 * len(places), 0))


@dataclass(frozen=True, eq=False)
class FrameFit:
    """up_from_camera: (2, 3), camera mm to the scan's mm (right, up). residuals_mm: (n, 2) measured less predicted.

    chi_square holds the affinity's two pseudo-observations too; redundancy counts them: 2 n - 4. linear_sigma: standard
    deviation of rotation (rad), scale, stretch and shear, the root of their mean variance.
    """

    up_from_camera: Array
    residuals_mm: Array
    chi_square: float
    redundancy: int
    linear_sigma: float


def fit_frame(camera_mm: Array, up_mm: Array, sigma_mm: Array, turn: Array) -> FrameFit:
    """Fit the frame to n >= 2 marks at camera_mm (n, 2) seen at up_mm (n, 2), with standard deviations sigma_mm (n,).

    turn: the pose's (2, 2), so that the similarity is a small one on top of it. Raises ValueError for fewer than two
    marks: they determine nothing.
    """
    if len(camera_mm) < 2:
        raise ValueError(f"{len(camera_mm)} marks do not determine a frame; two or more do")
    x, y = (camera_mm @ turn.T).T
    one, none = np.ones_like(x), np.zeros_like(x)
    rows = np.concatenate([np.stack([x, -y, one, none, x, y], axis=1), np.stack([y, x, none, one, -y, x], axis=1)])
    values, weight = up_mm.T.ravel(), np.tile(1 / sigma_mm, 2)
    prior = np.zeros((2, 6))
    prior[0, 4] = prior[1, 5] = 1 / AFFINITY_SIGMA
    design = np.concatenate([rows * weight[:, None], prior])
    right = np.concatenate([values * weight, np.zeros(2)])
    size = np.linalg.norm(design, axis=0)
    inverse = np.linalg.pinv(design / size) / size[:, None]
    solution = inverse @ right
    a, b, shift_x, shift_y, stretch, shear = solution
    linear = np.array([[a + stretch, -b + shear], [b + shear, a - stretch]]) @ turn
    residuals = (values - rows @ solution).reshape(2, -1).T
    chi_square = float(np.sum((design @ solution - right) ** 2))
    up_from_camera = np.column_stack([linear, [shift_x, shift_y]])
    linear_sigma = float(np.sqrt(np.sum(inverse[_LINEAR] ** 2, axis=1).mean()) / np.hypot(a, b))
    return FrameFit(up_from_camera, residuals, chi_square, 2 * len(camera_mm) - 4, linear_sigma)


def outliers(camera_mm: Array, up_mm: Array, sigma_mm: Array, turn: Array, gate_mm: float) -> NDArray[np.bool_]:
    """(n,) which marks do not belong: one by one, the mark that disagrees most with the others is taken out, until
    none is off by more than the gate or by what the others' own scatter allows, or only three are left."""
    out = np.zeros(len(camera_mm), dtype=bool)
    while (~out).sum() > 3:
        kept = np.flatnonzero(~out)
        size = np.hypot(*fit_frame(camera_mm[kept], up_mm[kept], sigma_mm[kept], turn).residuals_mm.T)
        rest = [np.delete(kept, index) for index in range(len(kept))]
        fits = [fit_frame(camera_mm[others], up_mm[others], sigma_mm[others], turn) for others in rest]
        if len(kept) >= _MANY:
            predicted = np.array(
                [fit.up_from_camera @ (*camera_mm[index], 1.0) for fit, index in zip(fits, kept, strict=True)]
            )
            off = np.hypot(*(up_mm[kept] - predicted).T)
            chance = np.array([_chance(*pair) for pair in zip(size * off, fits, strict=True)])
            outlying = (size > _LEAST_GATE * gate_mm) & (chance < TRUE_MARK_AN_OUTLIER / len(kept)) | (size > gate_mm)
            worst = int(np.where(outlying, chance, 2.0).argmin())
        else:
            outlying = size > gate_mm
            worst = int(np.argmin([fit.chi_square for fit in fits]))
        if not outlying.any():
            break
        out[kept[worst]] = True
    return out


def _chance(product_mm2: float, others: FrameFit) -> float:
    """The probability of a misfit: of the residual times the distance from where the others alone put the mark, over
    the others' variance, which is the square of the residual studentised without it, on two degrees of freedom.

    The variance is from the median, which other outliers do not widen: half of Rayleigh's squares are below 2 ln 2.
    """
    free = others.redundancy
    squares = np.sum(others.residuals_mm**2, axis=1)
    variance = float(np.median(squares)) / (2 * np.log(2)) * 2 * len(squares) / free
    return float((1 + product_mm2 / max(free * variance, 1e-12)) ** (-free / 2))
