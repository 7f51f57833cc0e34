"""Verdict on a calibration, and the problems that need a look."""

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.special import chdtri, ndtri

from adjust.problem.parameter import Parameter, description, parameter_from_text
from measure.flags import Status
from pipeline.report.data import ReportData, ReportedFrame, ReportedProblem, ReportSection, frames
from pipeline.report.frame_problems import frame_problems, pixel_locking, places_px
from pipeline.report.numbers import fixed, value_and_sigma
from pipeline.report.parameters import camera_values, spoken_name
from pipeline.results import assessment_record
from pipeline.results.adjustment_record import AdjustmentRecord, CameraRecord
from pipeline.results.stage_files import Check
from pipeline.text.wording import counted, listed

Observed = (
    assessment_record.DistanceRecord | assessment_record.FiducialDistanceRecord | assessment_record.ObservedQuantity
)
Level = Literal["good", "look", "failed"]

A_PRIORI = (
    "Standard deviations are a priori ones, as the given sigmas make them: the observations have no redundancy of "
    "their own that would tell σ₀. Given coordinates with a large sigma place the datum and check nothing."
)
CONTRADICTED = 0.01  # significance level of the test against an earlier calibration
ON_FRAMES = ("target", "fiducial", "tie")  # groups of marks
GIVEN = ("datum", "interior")  # groups of values that the camera's file gives
LEAST_ALIKE, NEARLY_ALL = 6, 0.8  # number and share of suspects in one image from which its numbers may be wrong
MOST_QUANTITIES = 3  # largest number of contradicted quantities named
LEAST_SHARE = 0.5  # fraction of the corner radius up to which a lens must be observed
LOOSE = 0.01  # fraction of c, standard deviation above which images do not separate it from their distances
LARGER = 1.5  # ratio of standard deviations that a dozen images rarely exceed by chance
CONFIDENCE = 0.99  # of the global test, and family-wise confidence of the tests of residuals

_CONTRADICTED_BY = "contradicted by the images (p < 0.01"
_BOTH_NAMED = "two distances that contradict each other are both named."
CALIBRATION = (
    "The images contradict the earlier calibration",
    "The camera has changed since, or the earlier adjustment lacked something; calibrate without it and compare.",
)
# Observations other than marks: attribute of the adjustment, their name in singular and plural, heading of their list,
# remedy, and section of the report.
FURTHER: tuple[tuple[str, str, str, str, str, ReportSection | None], ...] = (
    (
        "distances", "distance", "distances", f"{_CONTRADICTED_BY})",
        f"Look for a wrong point or unit in the file of distances; {_BOTH_NAMED}", "reliability",
    ),
    (
        "fiducial_distances", "distance between fiducials", "distances between fiducials",
        f"{_CONTRADICTED_BY}; v in µm)", f"Compare the camera file with the certificate; {_BOTH_NAMED}", "fiducials",
    ),
)  # fmt: skip


@dataclass(frozen=True)
class ReportVerdict:
    """Verdict in one sentence, with its problems. Level good: exit code 0; look: 1; failed: 1, no usable result."""

    level: Level
    sentence: str
    problems: tuple[ReportedProblem, ...]
    notes: tuple[str, ...]

    @property
    def exit_code(self) -> int:
        return 0 if self.level == "good" else 1


def judge(data: ReportData) -> ReportVerdict:
    """Judge the available results: measurement, adjustment and check against OpenCV."""
    shots = frames(data)
    problems = tuple(problem for found in problems_by_test(data, shots).values() for problem in found)
    is_fatal = data.adjustment is not None and any(_no_solution(data.adjustment))
    level: Level = "failed" if is_fatal or not _observed_counts(data, shots) else "look" if problems else "good"
    return ReportVerdict(level, _sentence(data, shots, level, len(problems)), problems, tuple(_notes(data, shots)))


def problems_by_test(data: ReportData, shots: list[ReportedFrame]) -> dict[str, Iterable[ReportedProblem]]:
    """What leads to exit code 1, by the names of the tests in docs/reference/results.md."""
    stored, check, totals, solved = data.adjustment, data.check, data.totals, _solution(data)
    unchecked = ReportedProblem(
        "Nothing checks the result: there are as many unknowns as observations.",
        "Add points or frames; until then no standard deviation here has been confirmed by the data.",
    )
    differs = ReportedProblem(
        f"OpenCV's calibration of the same observations differs. {check.reason if check else ''}",
        "See the table of the check: a parameter that differs by many standard deviations points to the cause.",
        section="check",
    )
    return {
        "solution": _no_solution(stored) if stored else (),
        "made from": data.problems,
        "frames": totals.problems if totals else frame_problems(shots),
        "pixel locking": pixel_locking(totals.places_px if totals else places_px(shots)),
        "warnings": map(ReportedProblem, stored.warnings if stored else ()),
        "σ₀": _too_large(solved) if solved and solved.has_sigma0 else (),
        "redundancy": [unchecked] if solved and solved.redundancy <= 0 else (),
        "reach of the lens": _lens_problems(data, solved) if solved else (),
        "distances, calibrations": _further_problems(solved) if solved else (),
        "gross errors": _suspects(solved) if solved else (),
        "OpenCV": [differs] if check and check.verdict == "differs" else (),
    }


def sigma0_bounds(redundancy: float) -> tuple[float, float]:
    """99 % interval of sigma0 if the a-priori standard deviations are right (chi-square)."""
    low, high = (chdtri(redundancy, 0.5 * above) for above in (1.0 + CONFIDENCE, 1.0 - CONFIDENCE))
    return float(np.sqrt(low / redundancy)), float(np.sqrt(high / redundancy))


def critical_w(tests: int) -> float:
    """Critical standardised residual for a family-wise level of 1 % over all tests (Bonferroni)."""
    return -float(ndtri(0.5 * (1.0 - CONFIDENCE) / max(tests, 1)))


def suspect_rows(adjustment: AdjustmentRecord) -> frozenset[assessment_record.ResidualRecord]:
    """Residuals of image points suspected of gross errors."""
    names = {(row.group, row.owner, row.point) for row in adjustment.suspects}
    return frozenset(row for row in adjustment.residuals if (row.kind, row.image, row.point) in names)


def _no_solution(adjustment: AdjustmentRecord) -> Iterator[ReportedProblem]:
    for null in adjustment.singular:
        together = description(parameter_from_text(each.text, adjustment.cameras) for each in null.parameters)
        yield ReportedProblem(f"{null.cause} The observations do not see it (together move {together}).", null.remedy)
    if not adjustment.converged and not adjustment.singular:
        is_practically = any(warning.startswith("Practically singular") for warning in adjustment.warnings)
        yield ReportedProblem(
            f"The iteration did not converge ({adjustment.termination}, {adjustment.iterations} iterations).",
            "The images hardly determine what is named below as practically singular: add what is advised there, or "
            "fix it."
            if is_practically
            else "Check point numbers of the largest residuals, approximate orientations, and units ([object] unit; mm "
            "in the camera file).",
            section="frames",
        )


def _suspects(adjustment: AdjustmentRecord) -> Iterator[ReportedProblem]:
    kept = [row for row in adjustment.suspects if not row.removed]
    given, marks = ([row for row in kept if (row.group in GIVEN) is is_given] for is_given in (True, False))
    remedy = (
        "Look at the picture: reject a disturbed mark, or correct its number or coordinates. snooping = true under "
        "[adjust] leaves all out."
    )
    owners = Counter(row.owner for row in marks if row.group in ON_FRAMES).most_common(1)
    if owners and owners[0][1] >= max(LEAST_ALIKE, NEARLY_ALL * len(kept)):
        remedy = (
            f"Nearly all are marks of {owners[0][0]}: look for wrong point numbers of the whole image, or exclude it."
        )
    groups = (
        (marks, f"{counted(len(marks), 'gross error')} suspected", remedy),
        (
            given,
            f"{counted(len(given), 'gross error')} suspected",
            "Correct the given value in the camera's file, or give it the standard deviation that it has.",
        ),
        (
            [row for row in adjustment.suspects if row.removed],
            "Left out as gross errors",
            "Look at the picture or the records, and reject or correct them there.",
        ),
    )
    for rows, heading, what_to_do in groups:
        if rows:
            of_frames = tuple((row.owner, row.group, row.point) for row in rows if row.group in ON_FRAMES)
            what = f"{heading}: {listed(list(map(_suspect, rows)))}."
            yield ReportedProblem(what, what_to_do, marks=of_frames, section="reliability")


def _suspect(row: assessment_record.SuspectRecord) -> str:
    alike = f"; not distinguishable from {', '.join(row.alike)}" if row.alike else ""
    return f"{row.name} (w = {fixed(row.w, 1)}{alike})"


def _further_problems(adjustment: AdjustmentRecord) -> Iterator[ReportedProblem]:
    """Yield problems of earlier calibrations and distances that the images contradict."""
    heading, remedy = CALIBRATION
    tests = [test for test in adjustment.calibration_tests if test.p < CONTRADICTED]
    yield from (ReportedProblem(f"{heading}: {contradiction(test, adjustment.cameras)}.", remedy) for test in tests)
    if not tests and (bad := _outlying(adjustment, adjustment.calibrations)):
        names = [spoken_name(row.name, adjustment.cameras) for row in bad]
        yield ReportedProblem(f"{heading}: {_name_list(bad, names)}.", remedy)
    for group, one, many, heading, remedy, section in FURTHER:
        if bad := _outlying(adjustment, getattr(adjustment, group)):
            what = f"{counted(len(bad), one, many)} {heading}: {_name_list(bad, [row.name for row in bad])}."
            yield ReportedProblem(what, remedy, section=section)


def _name_list(rows: Sequence[Observed], names: Sequence[str]) -> str:
    return listed([f"{n} (v = {row.v:.4g}, w = {fixed(row.w, 1)})" for n, row in zip(names, rows, strict=True)])


def contradiction(test: assessment_record.ContradictionRecord, cameras: Mapping[str, CameraRecord]) -> str:
    """State the compatibility test of the images with an earlier calibration, and the quantities in contradiction."""
    known = [row for row in test.direction if math.isfinite(row.difference) and row.sigma > 0.0][:MOST_QUANTITIES]
    by = ", ".join(f"{spoken_name(r.name, cameras)} {r.difference:+.3g} (its sigma {r.sigma:.2g})" for r in known)
    return (
        f"p = {test.p:.2g} (F = {fixed(test.F, 1)}, {test.freedom} degrees of freedom). They differ from it most in "
        f"{by}, in mm and powers of it"
    )


def _outlying(adjustment: AdjustmentRecord, rows: Sequence[Observed]) -> list[Observed]:
    limit = critical_w(len(rows)) * (adjustment.sigma0 if adjustment.sigma0 > 1.0 else 1.0)
    return [row for row in rows if abs(row.w) > limit]


def _too_large(adjustment: AdjustmentRecord) -> Iterator[ReportedProblem]:
    """Yield the problem of a significantly large sigma0, with explanations if there are any."""
    _, high = sigma0_bounds(adjustment.variance_factor.redundancy)
    explained = [ReportedProblem(each.cause, each.remedy) for each in adjustment.explanations]
    if adjustment.sigma0 <= high:
        yield from explained
        return
    size = (
        f"{_sigma0_and('above', high, adjustment.sigma0)}: the residuals are larger than the standard deviations given"
    )
    is_calibrated = any(camera.is_calibrated for camera in adjustment.cameras.values())
    noise = "film_sigma_um" if "fiducial" in adjustment.groups else 'unmodelled = "estimate"'
    if explained:
        yield replace(explained[0], what=f"{size}. {explained[0].what}")
        yield from explained[1:]
        left = min(each.sigma0[1] for each in adjustment.explanations)
        if left > high:
            yield ReportedProblem(
                f"σ₀ = {left:.3g} remains with that in the model.",
                f"Mend that first; if σ₀ stays large, state {noise} under [adjust] for what the model lacks.",
                section="reliability",
            )
        return
    model = "add distortion parameters" if is_calibrated else "choose a richer film transformation"
    further = f"{model}, or state {noise} under [adjust]"
    remedy = f"Reject gross errors first; then {further}. All σ are multiplied by σ₀."
    if adjustment.warnings:
        remedy = f"Mend what is named above first; if σ₀ stays large, {further}."
    yield ReportedProblem(f"{size} ({_group_sigmas(adjustment)}).", remedy, section="reliability")


def _group_sigmas(adjustment: AdjustmentRecord) -> str:
    groups = {name: group for name, group in adjustment.groups.items() if group.redundancy >= 1.0}
    return ", ".join(f"{name} {fixed(group.sigma0)}" for name, group in groups.items())


def _sigma0_and(side: str, bound: float, sigma0: float) -> str:
    """State sigma0 and its bound with enough digits to distinguish them."""
    digits = next((count for count in (2, 3, 4) if f"{sigma0:.{count}f}" != f"{bound:.{count}f}"), 5)
    return f"σ₀ = {sigma0:.{digits}f} is {side} {bound:.{digits}f}"


def _lens_problems(data: ReportData, solved: AdjustmentRecord) -> Iterator[ReportedProblem]:
    """Yield problems of lenses observed out to less than half the corner radius, and of principal distances that the
    images alone have to determine and hardly do."""
    for name, camera in solved.cameras.items():
        c = camera.principal_distance_mm
        sigma = max(c.sigma, c.sigma_clusters or 0.0)
        if not (c.given and math.isfinite(c.given.sigma)) and sigma > LOOSE * c.value and not camera.is_loose:
            yield ReportedProblem(
                f"The principal distance of {name} is known to {100.0 * sigma / c.value:.0f} % only: the images "
                "hardly separate it from how far away they were taken.",
                "Tilt the board, or the camera, by 20 to 45 degrees in different directions.",
                section="camera",
            )
    # From there to the corner the term of k3 grows by 2^7 = 128: a hundredth of a pixel becomes more than a pixel.
    remedy = "Observe targets out to the corners of the picture, or use the lens within that radius only."
    for _, sentence, share in lens_sentences(data):
        if share < LEAST_SHARE:
            yield ReportedProblem(sentence, remedy, section="coverage")


def lens_sentences(data: ReportData) -> Iterator[tuple[str, str, float]]:
    """Yield camera, extent of its lens in words, and the extent as a fraction of the corner radius."""
    if solved := _solution(data):
        for name, known in solved.estimated_lenses():
            yield name, known.sentence(name, data.unit_of_camera(name)), known.share


def _corners_notes(check: Check) -> Iterator[str]:
    """Yield notes comparing OpenCV's calibrations from its own board corners and from those measured here."""
    for name, camera in check.cameras.items():
        if corners := camera.corners_px:
            here, own = (
                f"fx {px.fx:.2f}, fy {px.fy:.2f}, cx {px.cx:.2f}, cy {px.cy:.2f} px, rms {px.rms:.3f} px a point"
                for px in (corners.reseau, corners.opencv)
            )
            lost = f" OpenCV found no board in {listed(corners.not_found)}." if corners.not_found else ""
            yield (
                f"OpenCV's calibration of {name} from {corners.points} points of {corners.images} pictures: with the "
                f"points measured here {here}; with OpenCV's own ({corners.detector}) {own}.{lost}"
            )


def _solution(data: ReportData) -> AdjustmentRecord | None:
    """The adjustment, if it has a solution."""
    return data.adjustment if data.adjustment and not any(_no_solution(data.adjustment)) else None


def _notes(data: ReportData, shots: list[ReportedFrame]) -> Iterator[str]:
    """Yield remarks that need no action."""
    yield from data.notes
    yield from _stage_notes(data, shots)
    if data.check:
        yield from _corners_notes(data.check)
    if data.adjustment:
        yield from data.adjustment.notes
        yield from _weight_notes(data.adjustment)
    if solved := _solution(data):
        yield from _unmodelled_notes(data, solved)
        yield from _sigma0_notes(solved)
    if data.is_film_alone:
        yield (
            "Fiducial marks are the same in every frame: if two scans bear each other's names, nothing here shows it."
        )
    yield from _mark_notes(data, shots)


def _stage_notes(data: ReportData, shots: list[ReportedFrame]) -> Iterator[str]:
    """Yield notes on stages without a result."""
    if not data.comparator and not data.measurement and not data.totals:
        yield "No measurement was handed to this report."
    if not data.adjustment:
        if data.stored_adjustment == "none" and _observed_counts(data, shots):
            yield "These marks are not adjusted yet: run `reseau run`."
    elif not data.adjustment.converged:
        yield "There is no solution: all values and residuals of this report are those of the last iteration."
    elif not data.check and not data.is_film_alone:
        yield "There is no check against OpenCV yet: run `reseau check`."
    elif data.check and data.check.verdict == "not possible" and not data.is_film_alone:
        yield f"OpenCV cannot check this calibration. {data.check.reason}"


def _sigma0_notes(solved: AdjustmentRecord) -> Iterator[str]:
    """Yield the note on a sigma0 that is not estimated, or significantly small."""
    if not solved.has_sigma0:
        yield A_PRIORI
    elif solved.sigma0 < (low := sigma0_bounds(solved.variance_factor.redundancy)[0]):
        yield (
            f"{_sigma0_and('below', low, solved.sigma0)}: the marks fit better than the standard deviations given "
            f"({_group_sigmas(solved)}), which may be lowered."
        )


def _mark_notes(data: ReportData, shots: list[ReportedFrame]) -> Iterator[str]:
    """Yield the notes on scans, and numbers of targets and tie points that were not plainly measured."""
    images_by_note: dict[str, list[str]] = {}
    for frame in shots:
        for note in frame.scan.notes if frame.scan else ():
            images_by_note.setdefault(note, []).append(frame.image)
    yield from (f"{listed(images)}: {note}" for note, images in images_by_note.items())
    for status in (Status.WEAK, Status.PREDICTED, Status.REJECTED):
        for kind, *words in (("target", "target"), ("tie", "tie-point observation")):
            number = (
                data.totals.of_targets.get((kind, status), 0)
                if data.totals
                else sum(mark.status is status and mark.kind == kind for frame in shots for mark in frame.marks)
            )
            if number:
                yield f"{counted(number, *words)} {status}: the report has the reasons."


def _unmodelled_notes(data: ReportData, adjustment: AdjustmentRecord) -> Iterator[str]:
    """Yield notes on sigmas added for unmodelled errors, and on correlated errors within images."""
    clusters = data.covariance.clusters if data.covariance else None
    for name, sigma_mm in adjustment.unmodelled_mm.items():
        unit, ratio = data.unit_of_camera(name), 0.0
        interior = adjustment.cameras[name].interior
        sigmas = {Parameter.interior(name, key): each.sigma for key, each in interior.items() if each.sigma > 0.0}
        if clusters is not None and sigmas:
            ratio = float((np.sqrt(np.diagonal(clusters.select(sigmas))) / list(sigmas.values())).max())
        if sigma_mm > 0.0:
            yield (
                f"{name}: {1e3 * sigma_mm * unit.per_um:.3g} {unit.short_name} are added to the standard deviations of "
                "all targets, for what lens model, object and the picture's processing leave."
            )
        if ratio > LARGER:
            yield (
                f"{name}: errors within a picture are correlated. Standard deviations by leaving out one picture at a "
                f"time are up to {ratio:.1f} times those of independent errors: the table of the camera has the larger."
            )


def _weight_notes(adjustment: AdjustmentRecord) -> Iterator[str]:
    """Yield notes on weights changed by robust estimation and variance components."""
    if lowered := [row for row in adjustment.residuals if row.weight < 1.0]:
        least = min(lowered, key=lambda row: row.weight)
        yield (
            f"Robust estimation lowered the weight of {counted(len(lowered), 'observation')}, most that of "
            f"{least.image}/{least.point}, to {least.weight:.2f} of what was given."
        )
    for group, factor in adjustment.variance_factors.items():
        sigma = adjustment.variance_sigmas.get(group, 0.0) / (2.0 * factor**0.5)
        yield (
            f"Variance components: the sigmas of the group {group} were multiplied by {factor**0.5:.2f} ± {sigma:.2f}."
            if sigma > 0.0
            else f"Variance components: the group {group} has too little redundancy and kept its sigmas."
        )


def _sentence(data: ReportData, shots: list[ReportedFrame], level: Level, problems: int) -> str:
    observed = _observed_counts(data, shots)
    marks = sum(observed.values())
    found = f"{counted(marks, 'mark')} in {counted(data.frame_count(observed), 'frame')}"
    ending = f", but {counted(problems, 'thing needs', 'things need')} a look." if level == "look" else "."
    if not marks:
        return "No mark was measured."
    if not data.adjustment:
        return f"Measured: {found}{ending}"
    if level == "failed":
        why = "the network is singular" if data.adjustment.singular else "the iteration did not converge"
        return f"There is no calibration: {why}."
    constants = []
    for name, camera in data.adjustment.cameras.items():
        if camera.is_calibrated:
            focal = [each for each in camera_values(data, name) if each.is_focal]
            pairs = [" ± ".join(value_and_sigma(each.value, each.sigma)) for each in focal]
            lengths = [f"{each.symbol} = {pair} {each.unit}" for each, pair in zip(focal, pairs, strict=True)]
            constants.append(f"{name} has {', '.join(lengths).replace('± fixed', '(fixed)')}")
    if not constants:
        return f"Film transformations from {found}; no frame is oriented, and no camera calibrated{ending}"
    if not data.totals:
        used = data.frame_count(row.image for row in data.adjustment.residuals)
        found = f"{counted(len(data.adjustment.residuals), 'mark')} in {counted(used, 'frame')}"
    return f"Calibrated from {found}: {'; '.join(constants)}{ending}"


def _observed_counts(data: ReportData, shots: list[ReportedFrame]) -> Mapping[str, int]:
    """Numbers of observed marks by image, of images with any; from the adjustment if there is no comparator file."""
    if data.totals:
        counts = {image: count[Status.MEASURED] + count[Status.WEAK] for image, count in data.totals.marks.items()}
    else:
        counts = {shot.image: sum(mark.status.is_observation for mark in shot.marks) for shot in shots}
    if not any(counts.values()) and data.adjustment:
        counts = Counter(row.image for row in data.adjustment.residuals)
    return {image: count for image, count in counts.items() if count}
