"""How a mark is matched."""

from dataclasses import dataclass
from math import inf
from typing import Literal, get_args

Freedom = Literal["shift", "similarity", "affine", "ellipse"]
FREEDOMS: tuple[Freedom, ...] = get_args(Freedom)


@dataclass(frozen=True)
class MatchOptions:
    """How a mark is matched.

    freedom: what is estimated beside the shift; "ellipse" is an affinity without rotation, for disks.
    blur_px: standard deviation of the scan's blur; the start of its estimation, if estimate_blur has it estimated.
    blur_sigma: prior standard deviation of the logarithm of the blur, the pixel's share included, as known from the
    other marks.
    linear_sigma: prior standard deviation of rotation (rad) and scale, and strain_sigma of stretch and shear, as known
    from the other marks; the defaults hold only what the picture does not show at all.
    margin_px: how far about the mark grey values are used; in a blurred scan margin_blurs standard deviations of the
    blur, where that is more.
    plain_px: where grey values farther from the mark vary much more than the nearer ones, the match fails.
    damage_rounds: how often damage is sought, cut out and the rest adjusted; 0: it stays in.
    max_shift_px: how far from its start the mark may move.
    tells_sharpening: whether the picture is asked for sharpening even in a scan that is not known to be sharpened.
    Raises ValueError, naming the option, for a value that is none.
    """

    freedom: Freedom = "similarity"
    blur_px: float = 0.8
    blur_sigma: float = inf
    estimate_blur: bool = True
    linear_sigma: float = 0.3
    strain_sigma: float = 0.3
    margin_px: float = 6.0
    margin_blurs: float = 4.0
    plain_px: float = inf
    damage_rounds: int = 3
    max_shift_px: float = 8.0
    tells_sharpening: bool = False

    def __post_init__(self) -> None:
        if self.freedom not in FREEDOMS:
            raise ValueError(f"freedom is {self.freedom!r}; one of {', '.join(FREEDOMS)} is right")
        for name in ("blur_px", "blur_sigma", "linear_sigma", "strain_sigma", "margin_px", "plain_px", "max_shift_px"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} is {getattr(self, name)}; a positive number is right")
        for name in ("margin_blurs", "damage_rounds"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name} is {getattr(self, name)}; 0 or more is right")
