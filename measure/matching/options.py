"""Options of least-squares matching."""

from dataclasses import dataclass
from math import inf
from typing import Literal, get_args

Freedom = Literal["shift", "similarity", "affine", "ellipse"]
FREEDOMS: tuple[Freedom, ...] = get_args(Freedom)


@dataclass(frozen=True)
class MatchOptions:
    """Options of least-squares matching.

    Attributes
    ----------
    freedom : parameters estimated in addition to the shift; "ellipse" is an affinity without rotation, for disks.
    blur_px : standard deviation of the scan's blur; its initial value if estimate_blur is set.
    blur_sigma : prior standard deviation of the logarithm of the blur, pixel included, as known from other marks.
    estimate_blur : whether the blur is an unknown.
    linear_sigma : prior standard deviation of rotation (rad) and scale, as known from other marks. The default only
        regularises what the image does not determine.
    strain_sigma : prior standard deviation of stretch and shear, likewise.
    margin_px : grey values are used up to this distance around the mark.
    margin_blurs : the margin in standard deviations of the blur, used where it is larger.
    plain_px : distance beyond which grey values must not vary much more than the nearer ones, else the match fails.
    damage_rounds : rounds of detecting and masking damage and readjusting; 0: damage stays in.
    max_shift_px : largest distance from the initial place.
    tells_sharpening : estimate sharpening even if the scan is not known to be sharpened.

    Raises
    ------
    ValueError
        Names the option whose value is invalid.
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
