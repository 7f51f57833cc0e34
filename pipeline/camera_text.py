"""A camera as the text of a camera file: what `read_camera` reads back."""

import math
from collections.abc import Callable, Mapping

from adjust.families import family
from adjust.network import Prior
from measure import shapes
from pipeline.camera_file import NO_MARK, CameraFile, GivenFiducial

SaveChip = Callable[[str, shapes.MarkTemplate], str]


def camera_text(camera: CameraFile, save_chip: SaveChip) -> str:
    """The contents of camera.toml. save_chip(name, template) stores a template's picture and returns its path there."""
    marks = _mark_names(camera.fiducials)
    lines = [f"name = {_quoted(camera.name)}"]
    if camera.frame_mm is not None:
        lines.append(f"frame_mm = {_list(camera.frame_mm)}")
    if camera.data_strip is not None:
        lines.append(f"data_strip = {_quoted(camera.data_strip)}")
    if camera.principal_distance_mm is not None:
        lines.append(f"principal_distance_mm = {camera.principal_distance_mm!r}")
    if camera.principal_point_mm is not None:
        lines.append(f"principal_point_mm = {_list(camera.principal_point_mm)}")
    lines += ["", "[sigma]"]
    lines.append(f"principal_distance_mm = {_sigma(camera.principal_distance_sigma_mm)}")
    lines.append(f"principal_point_mm = {_sigmas(camera.principal_point_sigma_mm)}")
    lines += _distortion_lines(camera)
    for fiducial in camera.fiducials:
        lines += ["", "[[fiducial]]", f"id = {_quoted(fiducial.id)}", f"xy_mm = {_list(fiducial.xy_mm)}"]
        lines.append(f"sigma_mm = {_sigmas(fiducial.sigma_mm)}")
        if fiducial.mark is not None:
            lines.append(f"mark = {_quoted(marks[fiducial.mark])}")
        elif fiducial.passed_over:
            lines.append(f"mark = {_quoted(NO_MARK)}")
    for mark, name in marks.items():
        lines += _mark_lines(mark, name, save_chip)
    return "\n".join(lines) + "\n"


def _mark_names(fiducials: tuple[GivenFiducial, ...]) -> Mapping[shapes.Mark | shapes.LearnedMark, str]:
    """A name for every different mark."""
    marks = dict.fromkeys(fiducial.mark for fiducial in fiducials if fiducial.mark is not None)
    return {mark: f"mark-{number}" for number, mark in enumerate(marks, 1)}


def _distortion_lines(camera: CameraFile) -> list[str]:
    distortion = camera.distortion
    lines = ["", "[distortion]", f"family = {_quoted(distortion.family)}"]
    lines.append(f"decentering = {_quoted(distortion.decentering)}")
    r0_mm = distortion.r0_mm
    lines.append(f"r0_dm = {r0_mm / 100.0!r}" if distortion.family == "juhl" else f"r0_mm = {r0_mm!r}")
    if family(distortion.family).needs == "half_mm":
        lines.append(f"half_mm = {_list(distortion.half_mm)}")
    lines += ["[distortion.value]", *_prior_lines(distortion.parameters, lambda prior: repr(prior.value))]
    return [*lines, "[distortion.sigma]", *_prior_lines(distortion.parameters, lambda prior: _sigma(prior.sigma))]


def _prior_lines(parameters: Mapping[str, Prior], text: Callable[[Prior], str]) -> list[str]:
    return [f"{name} = {text(prior)}" for name, prior in parameters.items()]


def _mark_lines(mark: shapes.Mark | shapes.LearnedMark, name: str, save_chip: SaveChip) -> list[str]:
    lines = ["", f"[mark.{name}]"]
    if isinstance(mark, shapes.LearnedMark):
        return [*lines, 'kind = "learned"', f"size_mm = {mark.size_mm!r}"]
    if isinstance(mark, shapes.MarkTemplate):
        lines += ['kind = "template"', f"image = {_quoted(save_chip(name, mark))}", f"pitch_um = {mark.pitch_um!r}"]
        lines += [f"origin_px = {_list(mark.origin_px)}", f"polarity = {_quoted(mark.polarity)}"]
        return [*lines, f"detail_mm = {mark.detail_mm!r}"]
    if isinstance(mark, shapes.FrameCorner):
        lines += ['kind = "frame-corner"', f"reach_mm = {mark.reach_mm!r}", f"radius_mm = {mark.radius_mm!r}"]
        return [*lines, f"polarity = {_quoted(mark.polarity)}"]
    lines += ['kind = "parts"', f"polarity = {_quoted(mark.polarity)}"]
    for part in mark.parts:
        lines += [f"[[mark.{name}.part]]", *_part_lines(part)]
    return lines


def _part_lines(part: shapes.Part) -> list[str]:
    if isinstance(part, shapes.Disk):
        return ['shape = "disk"', f"center_mm = {_list(part.center_mm)}", f"radius_mm = {part.radius_mm!r}"]
    if isinstance(part, shapes.Ring):
        lines = ['shape = "ring"', f"center_mm = {_list(part.center_mm)}", f"radius_mm = {part.radius_mm!r}"]
        return [*lines, f"line_mm = {part.line_mm!r}"]
    if isinstance(part, shapes.Bar):
        ends = [f"from_mm = {_list(part.from_mm)}", f"to_mm = {_list(part.to_mm)}"]
        return ['shape = "bar"', *ends, f"line_mm = {part.line_mm!r}"]
    vertices = ", ".join(_list(vertex) for vertex in part.vertices_mm)
    return ['shape = "polygon"', f"vertices_mm = [{vertices}]"]


def _quoted(text: str) -> str:
    escaped = text.replace("\\", "\\\\").replace('"', '\\"')
    return f'"{escaped}"'


def _list(values: tuple[float, float]) -> str:
    return f"[{float(values[0])!r}, {float(values[1])!r}]"


def _sigmas(values: tuple[float, float]) -> str:
    return f"[{_sigma(values[0])}, {_sigma(values[1])}]"


def _sigma(value: float) -> str:
    return '"free"' if math.isinf(value) else repr(float(value))
