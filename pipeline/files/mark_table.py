"""Fiducial marks in a camera file: drawn ones, templates with their pictures, and what is said of learned ones."""

import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

import numpy as np
from numpy.typing import NDArray

from measure.errors import MeasurementError
from measure.geometry import POSES
from measure.marks import shapes
from measure.marks.shapes import MarkTemplate, Point
from pipeline.text.atomic import write_atomically
from pipeline.text.names import image_name
from pipeline.text.tables import Table
from pipeline.text.wording import numbers, quoted

Array = NDArray[np.float64]
Picture = NDArray[np.uint16]
SavePicture = Callable[[str, Picture], str]

_FULL = 65535
KINDS = ("cross", "dot", "ring-cross", "ring-dot", "polygon", "parts", "template", "learned", "frame-corner")


_ANY_CORNER = (-1.0, -1.0)  # which one it is says the fiducial's place


@dataclass(frozen=True)
class Clicks:
    """Where somebody saw the marks in one scan: px by fiducial, column and row.

    sha256: of the scan's file, as it was then, and who saw them; "" where the camera's file says it.
    """

    scan: str
    px: Mapping[str, Point]
    sha256: str = ""
    who: str = ""


@dataclass(frozen=True)
class LearnedFrom:
    """The scan whose pictures the learned marks were first found by, the SHA-256 of its file, the pose in which it
    lies, and whether clicks show that. alike: the scans that lie like it: itself; and all that were there, where the
    marks were found by recurring in one place."""

    scan: str
    sha256: str
    pose: str
    clicked: bool
    alike: tuple[str, ...]


def read_clicks(table: Table, learned: Sequence[str]) -> Clicks:
    """learned: the fiducials to be learned. Raises InputError where some of them are not clicked."""
    scan = image_name(table.text("scan"))
    places = table.table("px")
    px = {id: places.pair(id) for id in learned if id in places}
    places.done()
    table.done()
    missing = [id for id in learned if id not in px]
    if missing or not px:
        raise table.error(
            "px", f"says nothing of {', '.join(missing) or 'any mark'}. Click all learned marks, or none."
        )
    return Clicks(scan, px)


def read_learned_from(table: Table) -> LearnedFrom:
    """As the program wrote it beside the templates."""
    learned = LearnedFrom(
        table.text("scan"),
        table.text("sha256"),
        table.text("pose", choices=POSES),
        table.flag("clicked", False),
        table.texts("alike"),
    )
    table.done()
    return learned


# A mark's template in a camera file, and the pictures beside it: `[mark.NAME]` of kind "template".
#
# What was learned from scans stands in `[mark.NAME.learned]`: a chip that somebody cut out has none of it.


def saved_in(folder: Path, prefix: str = "") -> SavePicture:
    """What stores pictures in a folder, their names beginning with the prefix."""

    def save(name: str, picture: Picture) -> str:
        file = f"{prefix}{name}.tif"
        write_atomically(folder / file, picture_file(picture))
        return file

    return save


def picture_file(picture: Picture) -> bytes:
    """A picture as the TIFF file that `saved_in` stores."""
    import tifffile

    file = io.BytesIO()
    tifffile.imwrite(file, picture, metadata=None, software="reseau")
    return file.getvalue()


def template_lines(template: MarkTemplate, name: str, save: SavePicture) -> list[str]:
    """The table [mark.NAME]. save(name, picture) stores a picture and returns its path there."""
    least, range_dn = float(template.image.min()), float(np.ptp(template.image))
    image = save(name, _picture((template.image - least) / (range_dn or 1.0)))
    lines = ['kind = "template"', f"image = {quoted(image)}", f"pitch_um = {template.pitch_um!r}"]
    lines += [f"origin_px = {numbers(template.origin_px)}", f"polarity = {quoted(template.polarity)}"]
    lines += [f"detail_mm = {template.detail_mm!r}"]
    if template.turn_deg:
        lines.append(f"turn_deg = {template.turn_deg!r}")
    return [*lines, *_learned_lines(template, range_dn, name, save)] if template.learned_mm else lines


def _learned_lines(template: MarkTemplate, range_dn: float, name: str, save: SavePicture) -> list[str]:
    lines = [f"[mark.{name}.learned]", f"size_mm = {template.learned_mm!r}"]
    if template.alike:
        lines.append(f"alike = [{', '.join(map(quoted, template.alike))}]")
    lines += [f"range_dn = {range_dn!r}", f"noise_dn = {template.noise_dn!r}"]
    lines.append(f"slope_noise_dn = {template.slope_noise_dn!r}")
    for key, values in (("steadiness", template.steadiness), ("steady", template.steady)):
        if values is not None:
            lines.append(f"{key} = {quoted(save(f'{name}-{key}', _picture(values)))}")
    shares = [f"{quoted(scan)} = {share!r}" for scan, share in template.shares.items()]
    return [*lines, f"[mark.{name}.learned.shares]", *shares]


def _picture(shares: NDArray[np.float64] | NDArray[np.bool_]) -> Picture:
    """Of values between 0 and 1."""
    return np.asarray(np.rint(np.asarray(shares, float) * _FULL), np.uint16)


def read_template(table: Table) -> MarkTemplate:
    """Raises InputError naming the key that is wrong."""
    image = _image(table, "image")
    if np.ptp(image) == 0.0:
        path = table.path_value("image")
        raise table.error("image", f"{path} shows nothing: all its pixels are alike. Cut out the mark with its ground.")
    template = MarkTemplate(
        image,
        table.number("pitch_um", above=0.0),
        table.pair("origin_px"),
        turn_deg=table.number("turn_deg", 0.0),
        detail_mm=table.number("detail_mm", 0.0, least=0.0),
    )
    return _learned(template, table.table("learned")) if "learned" in table else template


def _learned(template: MarkTemplate, table: Table) -> MarkTemplate:
    """The template with what the scans told of it."""
    shares = table.table("shares")
    steadiness, steady = (_of_pixels(table, key, template.image.shape) for key in ("steadiness", "steady"))
    learned = replace(
        template,
        image=template.image * (table.number("range_dn", above=0.0) / float(np.ptp(template.image))),
        noise_dn=table.number("noise_dn", least=0.0),
        slope_noise_dn=table.number("slope_noise_dn", 0.0, least=0.0),
        shares={scan: shares.number(scan, above=0.0) for scan in shares.names()},
        steadiness=steadiness,
        steady=None if steady is None else steady > 0.5,
        learned_mm=table.number("size_mm", above=0.0),
        alike=table.texts("alike") if "alike" in table else (),
    )
    table.done()
    return learned


def _of_pixels(table: Table, key: str, shape: tuple[int, ...]) -> Array | None:
    """A value between 0 and 1 for every pixel of the template; None where the file has none."""
    if key not in table:
        return None
    values = _image(table, key) / _FULL
    if values.shape != shape:
        raise table.error(key, f"is a picture of {values.shape[::-1]} px, and the template has {shape[::-1]}.")
    return values


def _image(table: Table, key: str) -> Array:
    from measure.scans.opening import open_scan

    try:
        with open_scan(table.path_value(key)) as chip:
            return chip.window(0, 0, chip.width_px, chip.height_px).astype(np.float64)
    except MeasurementError as error:
        raise table.error(key, str(error)) from error


def read_mark(table: Table) -> shapes.Mark | shapes.LearnedMark:
    """One mark. Raises InputError naming the key that is wrong."""
    kind = table.text("kind", choices=KINDS)
    if kind == "learned":
        return shapes.LearnedMark(table.number("size_mm", above=0.0))
    polarity = cast(shapes.Polarity, table.text("polarity", "auto", ("auto", "light", "dark")))
    if kind == "frame-corner":
        reach, radius = table.number("reach_mm", 0.0, least=0.0), table.number("radius_mm", 0.0, least=0.0)
        if radius and reach and radius >= reach:
            raise table.error("radius_mm", f"must be smaller than reach_mm ({reach:g}), not {radius:g}.")
        return shapes.frame_corner(_ANY_CORNER, reach, radius, polarity)
    if kind == "template":
        return replace(read_template(table), polarity=polarity)
    return shapes.MarkShape(_parts(kind, table), polarity, true_mm=_true_mm(table))


def _true_mm(table: Table) -> tuple[shapes.Point, shapes.Point] | None:
    """The rectangle in which the drawing is true; None: everywhere."""
    if "true_mm" not in table:
        return None
    corners = table.pairs("true_mm")
    if len(corners) != 2 or not np.all(np.less(*corners)):
        corner = "[[least x, least y], [greatest x, greatest y]]"
        raise table.error("true_mm", f"must be two corners of the rectangle in which the drawing is true, {corner}.")
    return corners[0], corners[1]


def _parts(kind: str, table: Table) -> tuple[shapes.Part, ...]:
    if kind == "dot":
        return shapes.dot(table.number("radius_mm", above=0.0))
    if kind == "ring-dot":
        return shapes.ring_dot(*_ring_sizes(table), table.number("radius_mm", above=0.0))
    if kind == "polygon":
        return shapes.polygon(_vertices(table))
    if kind == "parts":
        parts = tuple(_part(part) for part in table.tables("part"))
        if not parts:
            raise table.error("part", f"a mark of kind 'parts' needs at least one [[{table.place}.part]].")
        return parts
    arm, line, gap, angle = _cross_sizes(table)
    if kind == "ring-cross":
        return shapes.ring_cross(*_ring_sizes(table), arm, line, gap, angle)
    return shapes.cross(arm, line, gap, angle)


def _cross_sizes(table: Table) -> tuple[float, float, float, float]:
    arm = table.number("arm_mm", above=0.0)
    gap = table.number("gap_mm", 0.0, least=0.0)
    if gap >= arm:
        raise table.error("gap_mm", f"must be smaller than arm_mm ({arm:g}), not {gap:g}: no arm would be left.")
    return arm, table.number("line_mm", above=0.0), gap, table.number("angle_deg", 0.0)


def _ring_sizes(table: Table) -> tuple[float, float]:
    return table.number("ring_mm", above=0.0), table.number("ring_line_mm", above=0.0)


def _vertices(table: Table) -> tuple[shapes.Point, ...]:
    vertices = table.pairs("vertices_mm")
    if len(vertices) < 3:
        raise table.error("vertices_mm", f"a polygon needs at least three vertices, not {len(vertices)}.")
    x, y = np.transpose(vertices)
    if np.isclose(x @ np.roll(y, 1), y @ np.roll(x, 1), rtol=1e-9, atol=0.0):
        raise table.error("vertices_mm", "the polygon encloses no area. Give its corners in the order of its outline.")
    return vertices


def _part(table: Table) -> shapes.Part:
    shape = table.text("shape", choices=("disk", "ring", "bar", "polygon"))
    part: shapes.Part
    if shape == "disk":
        part = shapes.Disk(table.pair("center_mm", (0.0, 0.0)), table.number("radius_mm", above=0.0))
    elif shape == "ring":
        center, radius = table.pair("center_mm", (0.0, 0.0)), table.number("radius_mm", above=0.0)
        part = shapes.Ring(center, radius, table.number("line_mm", above=0.0))
    elif shape == "bar":
        part = shapes.Bar(table.pair("from_mm"), table.pair("to_mm"), table.number("line_mm", above=0.0))
        if part.from_mm == part.to_mm:
            raise table.error("to_mm", "is the same as from_mm: a bar needs two different ends.")
    else:
        part = shapes.Polygon(_vertices(table))
    table.done()
    return part
