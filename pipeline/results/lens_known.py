"""How far out an estimated lens is known, in the words of report, terminal and exports."""

from collections.abc import Iterator
from typing import Any

Json = dict[str, Any]


def estimated_lenses(adjustment: Json) -> Iterator[tuple[str, Json]]:
    """Cameras with a distortion parameter that was estimated, whose frame's size is known, with their `lens_known`."""
    for name, camera in adjustment["cameras"].items():
        parameters = (each for each in camera["distortion"].values() if isinstance(each, dict))
        known = camera.get("lens_known")
        if known and known["corner_mm"] is not None and any(each["sigma"] for each in parameters):
            yield name, known


def reach_sentence(name: str, known: Json) -> str:
    """How far out, and how well there and beyond."""
    corner = known["corner_sigma_um"]
    beyond = "the lens shows nothing there" if corner is None else f"there its standard deviation is {corner:.2g} µm"
    inside = "" if known["sigma_um"] is None else f", with a standard deviation of up to {known['sigma_um']:.2g} µm"
    return (
        f"The distortion of {name} is known up to {known['radius_mm']:.3g} mm from the principal point{inside}, "
        f"{100.0 * known['share']:.0f} % of the way to the corner of the picture; beyond it is extrapolated, {beyond}."
    )
