"""A mark's template in a camera file, and the pictures beside it: `[mark.NAME]` of kind "template".

What was learned from scans stands in `[mark.NAME.learned]`: a chip that somebody cut out has none of it.
"""

import io
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from measure.errors import MeasurementError
from measure.marks.shapes import MarkTemplate
from pipeline.text.atomic import write_atomically
from pipeline.text.tables import Table
from pipeline.text.toml_text import numbers, quoted

Array = NDArray[np.float64]
Picture = NDArray[np.uint16]
SavePicture = Callable[[str, Picture], str]

_FULL = 65535


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
        path = table.path_of("image")
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
        with open_scan(table.path_of(key)) as chip:
            return chip.window(0, 0, chip.width_px, chip.height_px).astype(np.float64)
    except MeasurementError as error:
        raise table.error(key, str(error)) from error
