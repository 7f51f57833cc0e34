"""The pixel pitch that a file's resolution tags give, where it can be believed."""

from dataclasses import dataclass

_COARSEST_UM = 250.0  # about 100 dpi; 72 and 96 dpi are what programs write that know nothing
_FINEST_UM = 1.0

_METRE_UM = {"inch": 25400.0, "centimetre": 10000.0, "millimetre": 1000.0, "micrometre": 1.0, "metre": 1e6}
TIFF_UNIT = {2: "inch", 3: "centimetre", 4: "millimetre", 5: "micrometre"}  # 4 and 5 are no standard, but are written
JFIF_UNIT = {1: "inch", 2: "centimetre"}
PNG_UNIT = {1: "metre"}


@dataclass(frozen=True)
class Pitch:
    """um: (x, y) in µm, None where the file gives none that can be believed; note: why none, empty otherwise."""

    um: tuple[float, float] | None
    note: str = ""


NO_TAGS = Pitch(None, "the file has no resolution tags")


def pitch_from_density(x: float, y: float, unit: str | None) -> Pitch:
    """The pitch of a file with x, y pixels per unit (`inch`, ..., None: the file names no unit)."""
    if unit is None:
        return Pitch(None, "the file's resolution tags have no unit")
    if not (x > 0.0 and y > 0.0):
        return Pitch(None, f"the file's resolution tags say {x:g} x {y:g} pixels per {unit}")
    um = (_METRE_UM[unit] / x, _METRE_UM[unit] / y)
    if max(um) > _COARSEST_UM:
        dpi = 25400.0 / max(um)
        return Pitch(
            None, f"the file's resolution tags say {dpi:.0f} dpi, which is a program's default and no scanner's"
        )
    if min(um) < _FINEST_UM:
        return Pitch(None, f"the file's resolution tags say {min(um):g} µm a pixel, finer than any scanner")
    return Pitch(um)
