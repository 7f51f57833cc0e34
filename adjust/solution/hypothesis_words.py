"""Words of the hypotheses on errors of a network's model: cause, with figures, and remedy.

Each function takes the adjustment with the added unknowns, their positions, and the rms of the residuals that they
explain (µm).
"""

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from adjust.array_types import Array, Indices
from adjust.functional_model.families import family
from adjust.problem.camera import Camera
from adjust.problem.parameter import shortened
from adjust.quality.cofactor import free_cofactor
from adjust.quality.run import UM_PER_MM, Run
from adjust.solution.displaced_points import PointGroup
from adjust.solution.image_groups import ImageGroups

CLEAR = 3.0  # standard deviations above which one of two changes of a board is told
NAMED = 5  # images named in a message, and points with their errors
MOST_NAMED = 10  # points named in a message
ALIKE = 7.0  # difference of chi-square plus twice the unknowns below which two readings are not distinguished


def free_terms(camera: Camera) -> set[str]:
    return {name for name, prior in camera.distortion.parameters.items() if prior.sigma > 0.0}


def own_terms(camera: Camera, group: str) -> tuple[str, ...]:
    """Terms of a group in the camera's own family."""
    return tuple(dict(family(camera.distortion.family).groups).get(group, ()))


def lens_words(camera: Camera, group: str, what: str, run: Run, added: Indices, rms_um: float) -> tuple[str, str]:
    cause = f"The lens model of camera {camera.name} is too simple: the residuals have {what}, {rms_um:.2g} µm rms"
    if camera.distortion.family == "none":
        names = "k1 and k2" if group == "radial" else "p1 and p2"
        return cause, f'Give the camera a [distortion] of the family "brown", say, with {names} free.'
    denominator = family(camera.distortion.family).alike_at_zero  # asked for by nobody at first
    known = {*denominator, *free_terms(camera)}
    if fixed := [name for name in own_terms(camera, group) if name not in known]:
        return cause, f'Free {", ".join(fixed)} under [distortion.sigma] of the camera ("free").'
    return cause, "Choose a distortion family with more terms, legendre(5) say; `reseau adjust --choose` compares some."


def pixel_words(camera: str, per_mm: float, run: Run, added: Indices, _: float) -> tuple[str, str]:
    """Describe non-square pixels; per_mm: change of the aspect ratio per mm of the added unknown."""
    value, covariance = _estimate(run, added)
    ratio = 1.0 - per_mm * float(value[0])
    cause = (
        f"The pixels of camera {camera} are not square: their width is {ratio:.6f} ± "
        f"{per_mm * float(np.sqrt(covariance[0, 0])):.6f} times their height (b1 = {1.0 - ratio:+.2g})"
    )
    return cause, (
        f"Give pitch_um as [x, y] with x / y = {ratio:.6f}, or free the affinity b1 of the distortion (families brown, "
        "opencv)."
    )


def bow_words(camera: str, run: Run, added: Indices, _: float) -> tuple[str, str]:
    value, covariance = _estimate(run, added)
    x_um, y_um = UM_PER_MM * value
    sigma_um = UM_PER_MM * np.sqrt(np.diag(covariance))
    return (
        f"The pictures of camera {camera} are bowed: half the frame off the middle, columns lie {x_um:+.3g} ± "
        f"{sigma_um[0]:.1g} µm aside and rows {y_um:+.3g} ± {sigma_um[1]:.1g} µm",
        "Look for a rolling shutter, stabilisation or a scanner's lens. A distortion family with such terms takes it "
        "up, legendre(3) say.",
    )


def shear_words(camera: str, per_mm: float, run: Run, added: Indices, _: float) -> tuple[str, str]:
    value, covariance = _estimate(run, added)
    return (
        f"The axes of the pictures of camera {camera} are not perpendicular: b2 = {per_mm * float(value[0]):+.2g} ± "
        f"{per_mm * float(np.sqrt(covariance[0, 0])):.1g}",
        "Free the shear b2 of the distortion (families brown, opencv), or scan them once more: sensors have none.",
    )


def bend_words(run: Run, added: Indices, _: float) -> tuple[str, str]:
    value, covariance = _estimate(run, added)
    sigma = np.sqrt(np.diag(covariance))
    cause = (
        f"The board of the given points is not flat: its middle stands {value[0]:.3g} ± {sigma[0]:.1g} off along its "
        f"first axis and {value[1]:.3g} ± {sigma[1]:.1g} along its second (points' unit; ± for independent errors, "
        "on real boards up to 5 times as much)"
    )
    return (
        cause,
        'Put it on a flat plate, or let its bend be adjusted: board_bend = "free" under [object] in project.toml.',
    )


def strain_words(count: int, run: Run, added: Indices, _: float) -> tuple[str, str]:
    """Describe stretches and shears of a flat board (count 2) or of an object in space (3)."""
    value, covariance = _estimate(run, added)
    names = ("X", "Y", "Z") if count > 2 else ("its first axis", "its second")
    middle = int(np.argsort([*value[: count - 1], 0.0])[(count - 1) // 2 if count > 2 else 1])
    # Stretches relative to the axis in the middle.
    by_value = np.vstack([np.eye(len(value))[: count - 1], np.zeros(len(value))])
    by_value -= by_value[middle]
    rows = [
        (row, 100.0, f"% {{}} along {names[i]} than along {names[middle]}")
        for i, row in enumerate(by_value)
        if i != middle
    ]
    rows += [
        (row, 1000.0, f"mrad off in the angle of {names[i]} and {names[j]}")
        for row, (i, j) in zip(np.eye(len(value))[count - 1 :], combinations(range(count), 2), strict=True)
    ]
    changes = [(float(row @ value), float(np.sqrt(row @ covariance @ row)), unit, what) for row, unit, what in rows]
    significant = [each for each in changes if abs(each[0]) > CLEAR * each[1]] or changes
    found = " and ".join(
        f"{abs(unit * v):.3g} ± {unit * s:.1g} {what.format('longer' if v > 0.0 else 'shorter')}"
        for v, s, unit, what in significant
    )
    what = "board" if count == 2 else "object"
    return (
        f"The {what} of the given points has another shape than given: it is {found}",
        f"Measure the {what} and give the coordinates that it has: printers stretch paper in one direction.",
    )


def twist_words(run: Run, added: Indices, _: float) -> tuple[str, str]:
    value, covariance = _estimate(run, added)
    return (
        f"The board of the given points is twisted: two opposite corners stand {abs(value[0]):.3g} ± "
        f"{np.sqrt(covariance[0, 0]):.1g} above its plane, the others as much below it (points' unit; ± for "
        "independent errors, on real boards up to 5 times as much)",
        "Put it on a flat plate.",
    )


def disk_words(run: Run, added: Indices, _: float) -> tuple[str, str]:
    value, covariance = _estimate(run, added)
    given = run.problem.network.disk_radius
    square, sigma = (given or 0.0) ** 2 + float(value[0]), float(np.sqrt(covariance[0, 0]))
    diameter = 2.0 * np.sqrt(max(square, 0.0))
    found = f"{diameter:.3g} ± {2.0 * sigma / max(diameter, np.sqrt(sigma)):.1g} (points' unit)"
    if given is None:
        return (
            f"The points are centres of dots, whose perspective is not corrected: their diameter is found as {found}",
            'Give their diameter_mm under [targets], kind = "disk".',
        )
    return (
        f"The disks do not have the diameter of {2.0 * given:.4g} that is given, or the points another spacing: by the "
        f"coordinates it is found as {found}",
        "Measure a disk, and from one to the next; correct diameter_mm or the coordinates and their unit.",
    )


def point_words(names: Sequence[str], run: Run, added: Indices, _: float) -> tuple[str, str]:
    value, covariance = _estimate(run, added)
    offs = (run.problem.unknowns.given[added] - value).reshape(-1, 3)
    sigmas = np.sqrt(np.diag(covariance)).reshape(-1, 3)
    by = [_shift_words(off, sigma) for off, sigma in zip(offs, sigmas, strict=True)]
    if len(names) == 1:
        return (
            f"Point {names[0]} is not where it is given: its coordinates are off, {by[0]} (points' unit)",
            "Correct the coordinates of this point, or its number among the marks.",
        )
    worst = np.argsort(-np.linalg.norm(offs, axis=1), kind="stable")[:NAMED]
    told = "; ".join(f"{names[k]}: {by[k]}" for k in worst)
    return (
        f"{len(names)} points are not where they are given: {shortened(names, MOST_NAMED)}; the coordinates of the "
        f"worst are off, {told} (points' unit)",
        "Correct the coordinates of these points, or their numbers among the marks.",
    )


def moved_words(group: PointGroup, run: Run, added: Indices, _: float) -> tuple[str, str]:
    value, covariance = _estimate(run, added)
    return (
        f"The points {shortened(group.names, MOST_NAMED)} ({group.words}) are not where they are given: all their "
        f"coordinates are off, {_shift_words(-value, np.sqrt(np.diag(covariance)))} (points' unit)",
        "Correct the coordinates of these points, or their numbers among the marks.",
    )


def _shift_words(off: Array, sigma: Array) -> str:
    digits = [max(0, -int(np.floor(np.log10(max(s, 1e-12))))) for s in sigma]
    return ", ".join(f"{axis} by {d:+.{n}f} ± {s:.1g}" for axis, d, s, n in zip("XYZ", off, sigma, digits, strict=True))


def drift_words(camera: str, by: str, run: Run, added: Indices, _: float) -> tuple[str, str]:
    value, covariance = _estimate(run, added)
    change, sigma = float(value[0]), float(np.sqrt(covariance[0, 0]))
    along = "from the first image to the last" if by == "order" else "from the farthest image to the nearest"
    return (
        f"The principal distance of camera {camera} changes {along}, by {change:+.3g} ± {sigma:.1g} mm: the focus "
        "drifts",
        "Fix focus and zoom, switch autofocus and stabilisation off, and take the pictures again.",
    )


def interior_words(camera: str, run: Run, added: Indices, _: float) -> tuple[str, str]:
    value, covariance = _estimate(run, added)
    names, given = [run.problem.unknowns.parameters[i].quantity for i in added], run.problem.unknowns.given[added]
    found = ", ".join(
        f"{name} = {v:.5g} ± {s:.1g} in place of {g:.5g} mm"
        for name, v, s, g in zip(names, value, np.sqrt(np.diag(covariance)), given, strict=True)
    )
    return (
        f"The interior orientation given for camera {camera} as exact is not that of the images: {found}",
        "Correct it, or give its standard deviations.",
    )


def group_words(camera: str, groups: ImageGroups, run: Run, added: Indices, _: float) -> tuple[str, str]:
    """Describe two groups of images by the simplest differences of interior orientation that fit."""
    values, covariance = _estimate(run, np.concatenate([added, run.problem.unknowns.camera[camera][:3]]))
    base, difference = values[3:], values[:3] - values[3:]
    by_both = np.hstack([np.eye(3), -np.eye(3)])
    spread = by_both @ covariance @ by_both.T
    who = f"the images {shortened(groups.images, NAMED)} ({len(groups.images)} of {groups.count}) of camera {camera}"
    sigma = np.sqrt(np.diag(spread))
    scale = 1.0 + float(difference @ base) / float(base @ base)
    readings = (
        (
            np.eye(3)[:, :1],
            f"{who} have another principal distance than the others, by {difference[0]:+.4g} ± {sigma[0]:.1g} mm "
            "(zoom or focus changed)",
        ),
        (
            np.eye(3)[:, 1:],
            f"{who} have another principal point than the others, by ({difference[1]:+.4g}, {difference[2]:+.4g}) ± "
            f"({sigma[1]:.1g}, {sigma[2]:.1g}) mm: images of different sizes in one camera (cropped), or turned or "
            "mirrored pictures",
        ),
        (
            base[:, None] / np.linalg.norm(base),
            f"{who} are {scale:.5g} times as large as the others: images of different sizes in one camera (scaled)",
        ),
        (
            np.eye(3),
            f"{who} have another interior orientation than the others: c is {1.0 + difference[0] / base[0]:.4g} times "
            f"as long, the principal point ({difference[1]:+.4g}, {difference[2]:+.4g}) mm off (another camera, or "
            "pictures cropped and enlarged)",
        ),
    )
    costs = [_misfit(difference, spread, along) + 2.0 * along.shape[1] for along, _cause in readings]
    fitting = [each for each, cost in zip(readings, costs, strict=True) if cost < min(costs) + ALIKE]
    special = [cause for along, cause in fitting if along.shape[1] < len(base)]
    causes = "; or ".join(special or [cause for _, cause in fitting])
    return (
        f"{causes[0].upper()}{causes[1:]}",
        "Give these images a camera of their own (column camera of images.csv), or a folder and project of their own.",
    )


def _misfit(difference: Array, covariance: Array, along: Array) -> float:
    """Chi-square of a difference (3,) constrained to given directions."""
    weight = np.linalg.pinv(covariance, hermitian=True)
    normal = along.T @ weight @ along
    rest = difference - along @ np.linalg.pinv(normal, hermitian=True) @ (along.T @ weight @ difference)
    return float(rest @ weight @ rest)


def _estimate(run: Run, positions: Indices) -> tuple[Array, Array]:
    """Values (k,) of unknowns and their covariance matrix (k, k)."""
    # Scaled by the variance factor of the extended model where that exceeds 1: what it leaves unexplained is noise to
    # its unknowns.
    cofactor = free_cofactor(run.numbering, run.end.state, run.factor)
    vpv, redundancy = run.group_sums(run.weighting.used)
    variance = max(vpv / redundancy, 1.0) if redundancy >= 1.0 else 1.0
    return run.end.state.values[positions], variance * cofactor.part(positions)
