"""How a mark is matched."""

from dataclasses import dataclass
from typing import Literal, get_args

Freedom = Literal["shift", "similarity", "affine", "ellipse"]
FREEDOMS: tuple[Freedom, ...] = get_args(Freedom)


@dataclass(frozen=True)
class MatchOptions:
    """How a mark is matched.

    freedom: what is estimated beside the shift; "ellipse" is an affinity without rotation, for disks.
    blur_px: standard deviation of the scan's blur; the start of its estimation, if it is estimated.
    linear_sigma: prior standard deviation of rotation (rad), scale and shear, as known from the other marks; the
    default holds only what the picture does not show at all.
    margin_px: how far about the mark grey values are used.
    """

    freedom: Freedom = "similarity"
    blur_px: float = 0.8
    estimate_blur: bool = True
    linear_sigma: float = 0.3
    margin_px: float = 6.0
    damage_sigmas: float = 3.2
    damage_rounds: int = 3
    max_iterations: int = 15
    max_shift_px: float = 8.0
    max_distortion: float = 0.3

    def __post_init__(self) -> None:
        if self.freedom not in FREEDOMS:
            raise ValueError(f"freedom is {self.freedom!r}; one of {', '.join(FREEDOMS)} is right")
        for name in (
            "blur_px",
            "linear_sigma",
            "margin_px",
            "damage_sigmas",
            "max_iterations",
            "max_shift_px",
            "max_distortion",
        ):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} is {getattr(self, name)}; a positive number is right")
        if self.damage_rounds < 0:
            raise ValueError(f"damage_rounds is {self.damage_rounds}; 0 or more is right")
