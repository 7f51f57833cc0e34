"""Drawings of the marks of the camera library, in the form of camera files: x' right, y' up, mm from the mark's point.

Solid marks are drawn as on the frame's right side, x outwards, and rotated with their place; if the mark of one side is
the mirror image of another, each has its own drawing.
"""

from collections.abc import Mapping, Sequence

CORNERS, SIDES = ("ll", "ur", "ul", "lr"), ("ml", "mr", "mt", "mb")
ALIKE_CORNERS = dict.fromkeys(CORNERS, "drawn")
ALIKE_SIDES = dict.fromkeys(SIDES, "drawn")

LEARNED = """kind = "learned"
size_mm = 5.0
"""

_AS_DRAWN = " " * 24 + "# as on the right side, x outwards"

GALLERY = (
    "from a picture of such marks (sPyMicMac's gallery of fiducial patterns), which has no scale: to 4 %, by the "
    "frame's edge with K-17 marks, RMK A notches and Wild crosses in other such pictures"
)


def cross(arm_mm: float, line_mm: float, gap_mm: float, angle_deg: int) -> str:
    sizes = f"arm_mm = {arm_mm}\nline_mm = {line_mm}\ngap_mm = {gap_mm}\nangle_deg = {angle_deg}"
    return f'kind = "cross"\n{sizes}\npolarity = "light"\n'


def ring_cross(
    ring_mm: float, ring_line_mm: float, arm_mm: float, line_mm: float, gap_mm: float, angle_deg: int
) -> str:
    own = cross(arm_mm, line_mm, gap_mm, angle_deg).removeprefix('kind = "cross"\n')
    return f'kind = "ring-cross"\nring_mm = {ring_mm}\nring_line_mm = {ring_line_mm}\n{own}'


def solid(polarity: str, *polygons: Sequence[tuple[float, float]], mirrored: bool = False) -> str:
    """Polygon, or several as parts, as on the right side; mirrored: y with opposite sign."""
    sign = -1.0 if mirrored else 1.0
    shapes = [_listed([(x, sign * y + 0.0) for x, y in polygon]) for polygon in polygons]
    end = f'polarity = "{polarity}"\nrotate = "radial"\n'
    if len(shapes) == 1:
        return f'kind = "polygon"{_AS_DRAWN}\nvertices_mm = {shapes[0]}\n{end}'
    parts = ", ".join(f'{{ shape = "polygon", vertices_mm = {shape} }}' for shape in shapes)
    return f'kind = "parts"  {_AS_DRAWN}\npart = [{parts}]\n{end}'


def _listed(polygon: Sequence[tuple[float, float]]) -> str:
    """Vertices as text, six per line."""
    corners = [f"[{x}, {y}]" for x, y in polygon]
    lines = [", ".join(corners[first : first + 6]) for first in range(0, len(corners), 6)]
    return "[" + ",\n               ".join(lines) + "]"


def _pair(name: str, polarity: str, polygon: Sequence[tuple[float, float]]) -> Mapping[str, str]:
    """Solid mark and its mirror image."""
    return {name: solid(polarity, polygon), f"{name}-mirrored": solid(polarity, polygon, mirrored=True)}


def _sides(left: str, right: str, top: str, bottom: str) -> Mapping[str, str]:
    return dict(zip(SIDES, (left, right, top, bottom), strict=True))


WILD_RING = {"drawn": ring_cross(0.80, 0.17, 1.75, 0.10, 0.08, 45)}
WILD_PLAIN = {"drawn": cross(1.75, 0.12, 0.25, 45)}
WILD_ALL_PLAIN = {"corner": cross(1.75, 0.12, 0.25, 45), "side": cross(1.75, 0.10, 0.27, 0)}
WILD_RING_SIDES = {"corner": cross(1.75, 0.12, 0.25, 45), "side": ring_cross(0.85, 0.17, 1.72, 0.09, 0.27, 0)}
PARK = {"corner": ring_cross(0.82, 0.13, 1.42, 0.10, 0.40, 45), "side": ring_cross(0.82, 0.13, 1.38, 0.09, 0.34, 0)}
EIGHT = dict.fromkeys(CORNERS, "corner") | dict.fromkeys(SIDES, "side")

_RMK_BLOCK = [
    (0.0, 0.0), (1.2, 1.8), (-0.2, 3.4), (-0.2, 5.0), (4.0, 5.0), (4.0, -5.0), (-0.2, -5.0), (-0.2, -3.4), (1.2, -1.8),
]  # fmt: skip
_RMK_TRUE = (
    "true_mm = [[-1.2, -1.7], [1.4, 1.7]]    # about the point: the shoulders are rounded, and not alike in all\n"
)
RMK = {"drawn": solid("dark", _RMK_BLOCK).replace("polarity", f"{_RMK_TRUE}polarity")}
RMK_EIGHT = {"corner": cross(2.0, 0.06, 0.0, 0), "side": RMK["drawn"]}

# The pinhole to which the reports refer is rarely visible: the notch next to it is drawn, relative to the pinhole.
_FAIRCHILD_NOTCH = [
    (0.0, 2.6), (-2.98, 2.6), (-2.98, 2.1), (-4.45, 0.5), (-4.45, 0.0), (-1.5, 0.0), (-2.98, -1.75), (-2.98, -2.6),
    (0.0, -2.6),
]  # fmt: skip
_T11_LEFT = [
    (-3.3, 2.6), (-6.1, 2.6), (-6.1, 2.0), (-7.7, 0.3), (-7.7, 0.0), (-3.2, 0.0), (-6.1, -2.9), (-6.1, -4.2),
    (-3.3, -4.2),
]  # fmt: skip
_T12_LEFT = [
    (0.3, 2.6), (-2.75, 2.6), (-2.75, 1.95), (-3.95, 0.5), (-3.95, 0.0), (-0.95, 0.0), (-0.95, -1.2), (-2.75, -3.2),
    (-2.75, -4.2), (0.3, -4.2),
]  # fmt: skip
T11_NOTCH = {
    **_pair("notch", "dark", _FAIRCHILD_NOTCH),
    "left": solid("dark", _T11_LEFT, mirrored=True),
}
T12_NOTCH = {**_pair("notch", "dark", _FAIRCHILD_NOTCH), "left": solid("dark", _T12_LEFT, mirrored=True)}
NOTCHES = _sides("left", "notch", "notch-mirrored", "notch")
CHECK = {
    "drawn": solid(
        "light",
        [(0.09, 0.09), (2.27, 0.09), (2.27, 2.27), (0.09, 2.27)],
        [(-0.09, -0.09), (-2.27, -0.09), (-2.27, -2.27), (-0.09, -2.27)],
    )
}
T12_CROSS = {"drawn": cross(1.12, 0.10, 0.2, 0)}


def _kc6a(apex_mm: float) -> list[tuple[float, float]]:
    """Dark block in a pocket of the frame. apex_mm: of its light tooth, outwards from the reported point."""
    block = [
        (3.5, 3.2), (-1.5, 3.2), (-1.65, 2.7), (-1.65, 1.75), (0.0, 0.05), (-2.9, 0.0), (-3.0, -0.6), (-1.65, -2.0),
        (-1.65, -3.0), (-1.4, -3.35), (3.5, -3.35),
    ]  # fmt: skip
    return [(x + apex_mm, y) for x, y in block]


KC6A = {
    "left": solid("dark", _kc6a(0.0), mirrored=True),
    "right": solid("dark", _kc6a(0.0)),
    "top": solid("dark", _kc6a(-1.34), mirrored=True),
    "bottom": solid("dark", _kc6a(-1.92)),
}
KC6A_SIDES = _sides("left", "right", "top", "bottom")

# Wings connected to the frame's border; the point is the intersection of the axis with the shallower half.
SMALL_FLAT = _pair(
    "wing", "dark", [(0.0, 0.0), (0.0, 2.95), (3.15, 5.4), (3.15, -5.13), (-1.55, -1.85), (-1.6, -1.6), (-1.6, 0.0)]
)
TALL_FLAT = _pair(
    "wing", "dark", [(0.0, 0.0), (0.0, 4.1), (3.15, 6.4), (3.15, -6.4), (-3.1, -2.0), (-3.15, -1.8), (-3.15, 0.0)]
)
LARGE_FLAT = _pair(
    "wing", "dark", [(0.0, 0.0), (0.0, 4.8), (5.3, 8.3), (5.3, -7.9), (-2.8, -3.0), (-2.95, -2.7), (-2.95, 0.0)]
)
CURVED_FLAT = _pair(
    "wing",
    "dark",
    [
        (0.0, 0.0), (0.0, -2.5), (0.7, -2.9), (1.35, -3.4), (2.15, -4.1), (2.8, -4.95), (3.15, -5.6), (3.15, 5.6),
        (2.8, 4.85), (1.75, 3.75), (0.9, 3.1), (-0.4, 2.45), (-1.85, 2.0), (-1.95, 1.8), (-1.95, 0.0),
    ],
)  # fmt: skip
# The curved wings at left and right are less deep than those at top and bottom.
CURVED = {
    **_pair(
        "side",
        "dark",
        [
            (0.0, 0.0), (0.05, 2.95), (1.05, 3.05), (1.05, -4.7), (0.9, -3.6), (0.6, -2.5), (0.2, -1.55), (-0.3, -0.75),
            (-0.8, 0.0),
        ],
    ),
    **_pair(
        "end",
        "dark",
        [
            (0.0, 0.0), (0.0, 3.97), (1.5, 4.0), (1.5, -5.1), (1.1, -4.5), (0.7, -3.8), (0.15, -2.65), (-0.45, -1.75),
            (-1.4, -0.75), (-2.3, 0.0),
        ],
    ),
}  # fmt: skip
# Dark band that outlines a wing, light inside; a fine line along the axis.
_HOLLOW = [(0.0, 0.0), (0.0, -4.6), (1.5, -6.0), (1.5, 0.15), (-1.45, 0.15), (-1.45, 1.6), (1.5, 4.6), (1.5, 6.5),
           (-2.95, 1.8), (-2.95, 0.0)]  # fmt: skip
HOLLOW = _pair("wing", "dark", _HOLLOW)
WINGS = _sides("wing-mirrored", "wing", "wing", "wing-mirrored")
OTHER_WINGS = _sides("wing-mirrored", "wing", "wing-mirrored", "wing")
CURVED_WINGS = _sides("side-mirrored", "side", "end", "end-mirrored")

T5 = {
    "left": solid("light", [(0.0, 0.0), (4.3, 0.0), (0.0, 4.35)]),
    "right": solid("light", [(0.0, 0.0), (2.6, 0.0), (0.0, -2.5)]),
    "top": solid("light", [(0.0, 0.0), (2.2, 0.0), (0.0, -2.3)]),
    "bottom": solid("light", [(0.0, 0.0), (2.9, 0.0), (0.0, 2.9)]),
}
ARROWS = {
    "left": solid("light", [(0.0, 0.0), (2.25, 2.45), (0.0, 2.6)], [(0.0, 0.0), (2.25, -2.45), (0.0, -2.6)]),
    "right": solid("light", [(0.0, 0.0), (-2.06, 2.15), (-2.06, -2.15)]),
    "top": solid("light", [(0.0, 0.0), (1.85, 0.0), (0.0, -2.1)]),
    "bottom": solid("light", [(0.0, 0.0), (2.35, 0.0), (0.0, 2.65)]),
}
EACH_SIDE = _sides("left", "right", "top", "bottom")
