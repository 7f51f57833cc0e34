"""Interior orientation of a digital camera in pixels, in OpenCV's convention."""

from collections.abc import Mapping

import numpy as np

from pipeline.types import Array

CENTRE = ("fx", "fy", "cx", "cy")


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
