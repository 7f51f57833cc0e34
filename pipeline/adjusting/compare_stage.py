"""`reseau compare`: compare calibrations of a camera from several adjustment.json, as a field of differences over the
frame."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from itertools import count
from pathlib import Path

import numpy as np
from markupsafe import Markup
from rich.console import Console
from rich.text import Text

from adjust.functional_model.families import family as family_of
from adjust.functional_model.lens import Lens
from adjust.problem.parameter import Parameter
from adjust.quality.lens_comparison import CameraCalibration, Comparison, Use, compare, sigmas
from pipeline.drawing import svg
from pipeline.errors import InputError
from pipeline.report.numbers import fixed, typed, value_and_sigma
from pipeline.results.adjustment_file import observed_mm, read_adjustment, read_own_covariance
from pipeline.results.adjustment_record import AdjustmentRecord
from pipeline.results.record_json import write_record
from pipeline.results.stage_files import DRIFT, ComparisonRecord, ParameterDifference, comparison_record
from pipeline.terminal import uncut_table
from pipeline.text.files import FORMS, check_replaceable, check_writable
from pipeline.text.wording import did_you_mean, listed
from pipeline.types import Array

_LONGEST = 0.11  # length of the longest arrow or semi-axis, fraction of the frame's width
_PANEL_PX = 520.0
_MARGIN_PX = 74.0
_TOO_ALIKE = 0.999  # p-value above which calibrations are not independent


def run_compare(
    paths: Sequence[Path], camera: str | None, times: Sequence[float] | None, use: Use, level: float, out: Path | None
) -> tuple[Comparison, ComparisonRecord]:
    """Compare the calibrations of a camera; write compare.json and compare.svg to `out` if it is given.

    Parameters
    ----------
    paths : files adjustment.json.
    camera : its name; None if each file has only one.
    times : of the calibrations, for a linear trend.
    use : "space" or "flat": whether the differences are adjusted for the attitude, or for attitude and station over
        flat ground.
    level : significance level of the verdict.

    Raises
    ------
    InputError, AdjustmentError
        A file has no calibration of the camera, or the calibrations are not comparable.
    """
    files = {} if out is None else {each: out / f"compare{each}" for each in (".json", ".svg")}
    for ending, path in files.items():
        check_replaceable(path, FORMS[ending], "name another --out")
    labels = _labels(paths)
    contents = {path: read_adjustment(path) for path in paths}
    lenses = {path: calibrated_lens(path, content, camera) for path, content in contents.items()}
    calibrations = [_calibration(path, contents[path], *lenses[path], label) for path, label in labels.items()]
    observed = [observed_mm(path, contents[path], name) for path, (name, _) in lenses.items()]
    corners_mm = np.array(  # of the area that all have observed
        [
            np.max([each.min(axis=0) for each in observed], axis=0),
            np.min([each.max(axis=0) for each in observed], axis=0),
        ]
    )
    if not (corners_mm[0] < corners_mm[1]).all():
        raise InputError(
            f"{listed([str(path) for path in paths])}: no part of the image was observed in all of them, so that there "
            "is nothing to compare. Are they of one camera?"
        )
    comparison = compare(calibrations, corners_mm, times, use)
    remarks = _remarks(contents, [name for name, _ in lenses.values()])
    if comparison.same.probability > _TOO_ALIKE:
        remarks += ("they agree better than independent calibrations can: were the same photographs adjusted?",)
    record = comparison_record(comparison, remarks, level)
    if out is not None:
        check_writable(out)
        write_record(record, files[".json"])
        draw_comparison(comparison, files[".svg"])
    return comparison, record


def _labels(paths: Sequence[Path]) -> dict[Path, str]:
    """Shortest distinct names of the files: the last parts of their paths, after removal of a common ending."""
    parts = [path.resolve().with_suffix("").parts for path in paths]
    twice = next((path for k, path in enumerate(paths) if parts[k] in parts[:k]), None)
    if twice is not None:
        raise InputError(f"{twice}: is named twice; a calibration is compared with others, not with itself.")
    while len(parts) > 1 and len({each[-1] for each in parts}) == 1:
        parts = [each[:-1] for each in parts]
    enough = next(n for n in count(1) if len({each[-n:] for each in parts}) == len(parts))
    return {path: "/".join(each[-enough:]) for path, each in zip(paths, parts, strict=True)}


def calibrated_lens(path: Path, content: AdjustmentRecord, name: str | None) -> tuple[str, Lens]:
    """Name and lens of a camera of an adjustment.json. name: None for its only camera.

    Raises InputError where there is no such camera, or it is not calibrated.
    """
    if not content.converged:
        raise InputError(f"{path}: holds no calibration: its adjustment did not converge.")
    cameras = list(content.cameras)
    if name is None and len(cameras) > 1:
        raise InputError(f"{path}: holds the cameras {listed(cameras)}. Say which one: --camera NAME.")
    chosen = cameras[0] if name is None else name
    if chosen not in cameras:
        hint = did_you_mean(chosen, cameras)
        raise InputError(f"{path}: holds no camera {chosen!r}{hint}; it has {listed(cameras)}.")
    lens = content.cameras[chosen].lens()
    if not np.isfinite(lens.values).all():
        raise InputError(f"{path}: holds no interior orientation of {chosen!r}: no image shows object points.")
    return chosen, lens


def _calibration(path: Path, content: AdjustmentRecord, name: str, lens: Lens, label: str) -> CameraCalibration:
    marks = {id: np.array(mark.xy_mm) for id, mark in content.cameras[name].fiducials.items()}
    unknowns = [Parameter.interior(name, each) for each in lens.quantities]
    unknowns += [Parameter.fiducial(name, id, axis) for id in marks for axis in "xy"]
    stored, redundancy = read_own_covariance(path), content.variance_factor.redundancy
    if stored.clusters is not None:  # a jackknife has as many degrees of freedom as images less one
        redundancy = min(redundancy, len(content.camera_images(name)) - 1.0)
    return CameraCalibration(label, lens, marks, stored.select_larger(unknowns), redundancy)


def _remarks(contents: Mapping[Path, AdjustmentRecord], names: Sequence[str]) -> tuple[str, ...]:
    remarks = [
        f"{path}: was adjusted with an earlier calibration as an observation. If that one is among those compared, "
        "they are not independent, and the test is milder than it says."
        for path, content in contents.items()
        if content.calibrations
    ]
    alike = defaultdict(list)
    for path, content in contents.items():
        alike[content.made_from.get("marks")].append(str(path))
    remarks += [
        f"{listed(same)} were adjusted from the same measured marks: they are not independent, and that they agree "
        "says nothing of the camera."
        for marks, same in alike.items()
        if marks and len(same) > 1
    ]
    if len(set(names)) > 1:
        remarks.append(f"the cameras have different names: {listed(names)}. Are they the same one?")
    return tuple(remarks)


def print_comparison(comparison: Comparison, record: ComparisonRecord, console: Console) -> None:
    """Print the verdict, a table for each calibration after the first, and remarks."""
    console.print(Text(record.verdict, style="bold red" if record.verdict == DRIFT else "bold green"))
    console.print(Text(_why(comparison, record.level)))
    for k, rows in enumerate(record.differences):
        _print_difference(comparison, k, rows.parameters, console)
    for remark in record.remarks:
        console.print(Text(f"Note: {remark}"))


def _why(comparison: Comparison, level: float) -> str:
    of_marks = ", and a similarity of the fiducial marks" if any(c.fiducials for c in comparison.calibrations) else ""
    orientation = {"space": "the camera's attitude", "flat": "the camera's attitude and station over flat ground"}
    taken = f"{orientation[comparison.use]}{of_marks}"
    same, trend = comparison.same, comparison.trend
    counted = f"chi-square {same.chi_square:.1f}, {same.freedom} degrees of freedom"
    of_what = counted if trend is None else "twice the smaller one of two tests"
    sentence = (
        f"p = {comparison.probability:.2g} for an unchanged camera "
        f"({of_what}; drift: p < {level:g}), after adjustment of {taken}."
    )
    if trend is None:
        return sentence
    first, last = comparison.calibrations[0].name, comparison.calibrations[-1].name
    return (
        f"{sentence} All equal: p = {same.probability:.2g} ({counted}). No linear change with time: "
        f"p = {trend.probability:.2g} (chi-square {trend.chi_square:.1f}, {trend.freedom} degrees of freedom); from "
        f"{first} to {last} it is {_rms(comparison.trend_um):.2f} µm rms over the frame, "
        f"{_largest(comparison.trend_um, comparison.trend_covariance_um2)}."
    )


def _print_difference(
    comparison: Comparison, k: int, parameters: Sequence[ParameterDifference], console: Console
) -> None:
    first, *others = (each.name for each in comparison.calibrations)
    columns = ("parameter", first, others[k], "difference", "sigma", "in sigmas", "unit")
    family = family_of(comparison.calibrations[0].lens.distortion.family)
    table = uncut_table(columns, f"{others[k]} less {first}")
    for row in parameters:
        if np.isnan(row.sigmas) and row.difference == 0.0:
            continue
        size = "both fixed" if np.isnan(row.sigmas) else fixed(row.sigmas, 1, sign=True)
        values = [value_and_sigma(each, row.sigma, abs(row.first))[0] for each in (row.first, row.other)]
        unit = "mm" if row.name in ("c", "x0", "y0") else family.unit(row.name)
        change = value_and_sigma(row.difference, row.sigma, abs(row.first))
        table.add_row(row.name, *map(typed, (*values, *change, size)), unit)
    console.print(table)
    field = comparison.field_um[k]
    x, y = comparison.places_mm[np.hypot(*field.T).argmax()]
    largest = _largest(field, comparison.field_covariance_um2[k])
    console.print(Text(f"Over the frame {_rms(field):.2f} µm rms, {largest} at ({x:.0f}, {y:.0f}) mm."))
    if comparison.fiducials:
        marks = comparison.fiducials_um[k]
        which = comparison.fiducials[np.hypot(*marks.T).argmax()]
        largest = _largest(marks, comparison.fiducials_covariance_um2[k])
        console.print(Text(f"Fiducial marks after a similarity: {largest} at fiducial {which}."))


def _rms(differences_um: Array) -> float:
    return float(np.sqrt((differences_um**2).sum(axis=1).mean()))


def _largest(differences_um: Array, covariance_um2: Array) -> str:
    size = np.hypot(*differences_um.T)
    sx, sy = sigmas(covariance_um2[size.argmax()])
    return f"at most {size.max():.2f} µm (sigmas {sx:.2f} and {sy:.2f} µm)"


def draw_comparison(comparison: Comparison, path: Path) -> None:
    """Write an SVG with one panel per calibration, and one for the linear trend of a series.

    An arrow shows the difference from the first calibration at a place of the frame, the ellipse at its tip the 95 %
    confidence region. Raises InputError where the file cannot be written.
    """
    width_mm, height_mm = np.ptp(comparison.places_mm, axis=0)
    px_per_mm = (_PANEL_PX - 2.0 * _MARGIN_PX) / float(width_mm)
    height = float(height_mm) * px_per_mm + 2.0 * _MARGIN_PX + 24.0
    low_mm = comparison.places_mm.min(axis=0)
    starts = (comparison.places_mm - low_mm) * px_per_mm * (1.0, -1.0) + (_MARGIN_PX, height - _MARGIN_PX)
    first, *others = (each.name for each in comparison.calibrations)
    titles = [f"{other} less {first}" for other in others]
    fields = list(zip(comparison.field_um, comparison.field_covariance_um2, strict=True))
    if comparison.trend is not None:
        titles.append(f"steady change from {first} to {others[-1]}")
        fields.append((comparison.trend_um, comparison.trend_covariance_um2))
    longest_um = max(1e-6, *(max(_longest(um), float(svg.ellipse_axes(each)[0].max())) for um, each in fields))
    px_per_um = _LONGEST * float(width_mm) * px_per_mm / longest_um
    panels = [_panel(title, *field, starts, px_per_um) for title, field in zip(titles, fields, strict=True)]
    placed = [svg.tag("g", *each, transform=f"translate({k * _PANEL_PX:.0f} 0)") for k, each in enumerate(panels)]
    title = "Calibrations compared: how far apart they see a place of the frame, with ellipses of 95 %"
    svg.write_picture(path, _PANEL_PX * len(panels), height, title, *placed)


def _panel(title: str, field_um: Array, covariance_um2: Array, starts: Array, px_per_um: float) -> tuple[Markup, ...]:
    """Field of differences as arrows with error ellipses. starts: (m, 2), px of the panel."""
    ends = starts + px_per_um * field_um * (1.0, -1.0)
    radii_um, angles = svg.ellipse_axes(covariance_um2)
    (left, top), (right, bottom) = starts.min(axis=0) - 24.0, starts.max(axis=0) + 24.0
    um = svg.round_step(_LONGEST * (right - left) / px_per_um)
    is_within = (np.hypot(*field_um.T) < radii_um.min(axis=1)).all()
    remark = "; no arrow is longer than its ellipse" if is_within else ""
    return (
        svg.words(left, 24.0, title, "label"),
        svg.words(left, 42.0, f"longest arrow {_longest(field_um):.2f} µm{remark}", "tick"),
        svg.tag("rect", x=left, y=top, width=right - left, height=bottom - top, class_="frame"),
        *svg.ellipses(ends, px_per_um * radii_um, angles),
        svg.strokes(starts, ends, "vector target"),
        svg.strokes(starts, starts, "dot target"),
        svg.scale_bar(left, bottom + 16.0, um * px_per_um, f"{um:g} µm, ellipses of 95 %"),
    )


def _longest(field_um: Array) -> float:
    return float(np.hypot(*field_um.T).max())
