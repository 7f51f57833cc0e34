"""Write a camera as the text of a camera file that `read_camera` can read."""

import dataclasses
import os
from collections.abc import Callable, Iterable, Mapping

from adjust.functional_model.families import family
from adjust.functional_model.lens import Prior
from adjust.problem.camera import FiducialDistance
from measure.marks import shapes
from pipeline.files.camera_file import NO_MARK, CameraFile, GivenFiducial
from pipeline.files.camera_tables import written_place_text
from pipeline.files.mark_table import LearnedFrom, SavePicture, template_lines
from pipeline.text.wording import numbers, quoted, sigma, sigmas, table_lines


def camera_text(camera: CameraFile, save: SavePicture) -> str:
    """Text of a camera file to be written at camera.path.

    save(name, picture) stores an image beside it and returns its relative path.
    """
    marks = _mark_names(camera.fiducials)
    lines = [f"name = {quoted(camera.name)}"]
    if camera.frame_mm is not None:
        lines.append(f"frame_mm = {numbers(camera.frame_mm)}")
    if camera.number:
        lines.append(f"number = {quoted(camera.number)}")
    if camera.writing:
        lines.append(f"writing = [{', '.join(quoted(written_place_text(place)) for place in camera.writing)}]")
    if camera.principal_distance_mm is not None:
        lines.append(f"principal_distance_mm = {camera.principal_distance_mm!r}")
    if camera.principal_point_mm is not None:
        lines.append(f"principal_point_mm = {numbers(camera.principal_point_mm)}")
    lines += ["", "[sigma]"]
    lines.append(f"principal_distance_mm = {sigma(camera.principal_distance_sigma_mm)}")
    lines.append(f"principal_point_mm = {sigmas(camera.principal_point_sigma_mm)}")
    if camera.calibration is not None:
        lines.append(f"calibration = {quoted(os.path.relpath(camera.calibration.path, camera.path.parent))}")
        lines.append(f"calibration_fiducials = {str(camera.calibration.tells_fiducials).lower()}")
    if camera.source is not None:
        given = {key: value for key, value in dataclasses.asdict(camera.source).items() if value}
        lines += ["", "[source]", *table_lines(given, "source")]
    lines += _distortion_lines(camera)
    for fiducial in camera.fiducials:
        lines += ["", "[[fiducial]]", f"id = {quoted(fiducial.id)}", f"xy_mm = {numbers(fiducial.xy_mm)}"]
        lines.append(f"sigma_mm = {sigmas(fiducial.sigma_mm)}")
        if fiducial.seen_mm is not None:
            lines.append(f"seen_mm = {numbers(fiducial.seen_mm)}")
        if fiducial.mark is not None:
            lines.append(f"mark = {quoted(marks[fiducial.mark])}")
        elif fiducial.passed_over:
            lines.append(f"mark = {quoted(NO_MARK)}")
    lines += fiducial_distance_lines(camera.distances)
    if camera.learned_from is not None:
        lines += _learned_from_lines(camera.learned_from)
    for mark, name in marks.items():
        lines += _mark_lines(mark, name, save)
    return "\n".join(lines) + "\n"


def fiducial_distance_lines(distances: Iterable[FiducialDistance]) -> list[str]:
    """Lines of the tables [[fiducial_distance]]."""
    lines = []
    for one in distances:
        lines += ["", "[[fiducial_distance]]", f"from = {quoted(one.start)}", f"to = {quoted(one.end)}"]
        lines += [f"mm = {one.value_mm!r}", f"sigma_mm = {one.sigma_mm!r}"]
    return lines


def _learned_from_lines(learned: LearnedFrom) -> list[str]:
    lines = ["", "[learned_from]", f"scan = {quoted(learned.scan)}", f"sha256 = {quoted(learned.sha256)}"]
    lines += [f"pose = {quoted(learned.pose)}", f"clicked = {str(learned.clicked).lower()}"]
    return [*lines, f"alike = [{', '.join(quoted(scan) for scan in learned.alike)}]"]


def _mark_names(fiducials: tuple[GivenFiducial, ...]) -> Mapping[shapes.Mark | shapes.LearnedMark, str]:
    """A name for each different mark."""
    marks = dict.fromkeys(fiducial.mark for fiducial in fiducials if fiducial.mark is not None)
    return {mark: f"mark-{number}" for number, mark in enumerate(marks, 1)}


def _distortion_lines(camera: CameraFile) -> list[str]:
    distortion = camera.distortion
    lines = ["", "[distortion]", f"family = {quoted(distortion.family)}"]
    lines.append(f"decentering = {quoted(distortion.decentering)}")
    r0_mm = distortion.r0_mm
    lines.append(f"r0_dm = {r0_mm / 100.0!r}" if distortion.family == "juhl" else f"r0_mm = {r0_mm!r}")
    if family(distortion.family).needs == "half_mm":
        lines.append(f"half_mm = {numbers(distortion.half_mm)}")
    lines += ["[distortion.value]", *_prior_lines(distortion.parameters, lambda prior: repr(prior.value))]
    return [*lines, "[distortion.sigma]", *_prior_lines(distortion.parameters, lambda prior: sigma(prior.sigma))]


def _prior_lines(parameters: Mapping[str, Prior], text: Callable[[Prior], str]) -> list[str]:
    return [f"{name} = {text(prior)}" for name, prior in parameters.items()]


def _mark_lines(mark: shapes.Mark | shapes.LearnedMark, name: str, save: SavePicture) -> list[str]:
    lines = ["", f"[mark.{name}]"]
    if isinstance(mark, shapes.LearnedMark):
        return [*lines, 'kind = "learned"', f"size_mm = {mark.size_mm!r}"]
    if isinstance(mark, shapes.MarkTemplate):
        return [*lines, *template_lines(mark, name, save)]
    if isinstance(mark, shapes.FrameCorner):
        lines += ['kind = "frame-corner"', f"reach_mm = {mark.reach_mm!r}", f"radius_mm = {mark.radius_mm!r}"]
        return [*lines, f"polarity = {quoted(mark.polarity)}"]
    lines += ['kind = "parts"', f"polarity = {quoted(mark.polarity)}"]
    if mark.true_mm is not None:
        lines.append(f"true_mm = [{', '.join(numbers(corner) for corner in mark.true_mm)}]")
    for part in mark.parts:
        lines += [f"[[mark.{name}.part]]", *_part_lines(part)]
    return lines


def _part_lines(part: shapes.Part) -> list[str]:
    if isinstance(part, shapes.Disk):
        return ['shape = "disk"', f"center_mm = {numbers(part.center_mm)}", f"radius_mm = {part.radius_mm!r}"]
    if isinstance(part, shapes.Ring):
        lines = ['shape = "ring"', f"center_mm = {numbers(part.center_mm)}", f"radius_mm = {part.radius_mm!r}"]
        return [*lines, f"line_mm = {part.line_mm!r}"]
    if isinstance(part, shapes.Bar):
        ends = [f"from_mm = {numbers(part.from_mm)}", f"to_mm = {numbers(part.to_mm)}"]
        return ['shape = "bar"', *ends, f"line_mm = {part.line_mm!r}"]
    vertices = ", ".join(numbers(vertex) for vertex in part.vertices_mm)
    return ['shape = "polygon"', f"vertices_mm = [{vertices}]"]
