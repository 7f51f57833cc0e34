"""Units of lengths in the image: mm and µm for film, pixels for a digital camera; its interior orientation."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from adjust.functional_model.distortion_models import UM_PER_MM
from pipeline.types import Array

CENTRE = ("fx", "fy", "cx", "cy")


@dataclass(frozen=True)
class ImageUnit:
    """Unit of image coordinates. pixel_um None: mm for coordinates and µm for residuals; otherwise px for both."""

    pixel_um: float | None = None

    @property
    def is_pixel(self) -> bool:
        return self.pixel_um is not None

    @property
    def long_name(self) -> str:
        """Unit of image coordinates and principal distances."""
        return "px" if self.is_pixel else "mm"

    @property
    def short_name(self) -> str:
        """Unit of residuals, distortion and their standard deviations."""
        return "px" if self.is_pixel else "µm"

    @property
    def per_mm(self) -> float:
        """Units of coordinates per mm."""
        return 1.0 if self.pixel_um is None else UM_PER_MM / self.pixel_um

    @property
    def per_um(self) -> float:
        """Units of residuals per µm."""
        return 1.0 if self.pixel_um is None else 1.0 / self.pixel_um

    @property
    def decimals(self) -> int:
        """Decimals of a printed residual."""
        return 3 if self.is_pixel else 1


FILM_UNIT = ImageUnit()


def pixel_intrinsics(mm: Mapping[str, float], pixel_mm: float) -> tuple[dict[str, float], Array]:
    """Convert c, x0', y0' and distortion parameters to fx, fy, cx, cy and distortion; returns derivatives (m, n) too.

    fx = c (1 + b1), fy = c; y0' counts upward, cy downward (`adjust.functional_model.opencv_family`).
    """
    stretch = 1.0 + mm.get("b1", 0.0)
    values = {"fx": mm["c"] * stretch / pixel_mm, "fy": mm["c"] / pixel_mm}
    values |= {"cx": mm["x0"] / pixel_mm, "cy": -mm["y0"] / pixel_mm}
    by = {"fx": {"c": stretch / pixel_mm, "b1": mm["c"] / pixel_mm}, "fy": {"c": 1.0 / pixel_mm}}
    by |= {"cx": {"x0": 1.0 / pixel_mm}, "cy": {"y0": -1.0 / pixel_mm}}
    for name in mm.keys() - {"c", "x0", "y0", "b1"}:
        by[name] = {name: 1.0}
    values |= {name: value for name, value in mm.items() if name not in ("c", "x0", "y0", "b1")}
    return values, np.array([[by[row].get(column, 0.0) for column in mm] for row in values])
