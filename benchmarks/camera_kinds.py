"""Types of cameras of the library, and drawings of their marks in the form of camera files.

x' to the right, y' up, mm from the mark's point. Solid marks are drawn as on the frame's right side, x outwards, and
rotated with their place; if the mark of one side is the mirror image of another, each has its own drawing.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Kind:
    """Type of camera: its models in the reports, and data that the reports lack.

    A type may stand for some cameras of a model only, those with such marks.

    Attributes
    ----------
    cones_mm : nominal focal lengths.
    gate_mm : larger deviations from the median mean another type of mark or a typing error.
    sigma_mm : of coordinates with too few reports for a spread.
    shape : source of the drawings, in words.
    separated : whether the places of the marks are computed from their separations.
    drawn : by place, which of the drawings `marks` its mark has.
    writing : line on the places where the camera writes, if known.
    """

    file: str
    title: str
    models: tuple[str, ...]
    cones_mm: tuple[int, ...]
    frame_mm: float
    places: tuple[str, ...]
    gate_mm: float
    sigma_mm: float
    shape: str
    separated: bool = False
    drawn: Mapping[str, str] = field(default_factory=dict)
    marks: Mapping[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = field(default=())
    writing: str = ""


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
WILD_ALL_RINGED = {"corner": WILD_RING["drawn"], "side": ring_cross(0.80, 0.17, 1.50, 0.10, 0.25, 0)}
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
T11_NOTCH = {**_pair("notch", "dark", _FAIRCHILD_NOTCH), "left": solid("dark", _T11_LEFT, mirrored=True)}
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
CURVED_FLAT = _pair(
    "wing",
    "dark",
    [
        (0.0, 0.0), (0.0, -2.5), (0.7, -2.9), (1.35, -3.4), (2.15, -4.1), (2.8, -4.95), (3.15, -5.6), (3.15, 5.6),
        (2.8, 4.85), (1.75, 3.75), (0.9, 3.1), (-0.4, 2.45), (-1.85, 2.0), (-1.95, 1.8), (-1.95, 0.0),
    ],
)  # fmt: skip
WINGS = _sides("wing-mirrored", "wing", "wing", "wing-mirrored")
OTHER_WINGS = _sides("wing-mirrored", "wing", "wing-mirrored", "wing")

T5 = {
    "left": solid("light", [(0.0, 0.0), (4.3, 0.0), (0.0, 4.35)]),
    "right": solid("light", [(0.0, 0.0), (2.6, 0.0), (0.0, -2.5)]),
    "top": solid("light", [(0.0, 0.0), (2.2, 0.0), (0.0, -2.3)]),
    "bottom": solid("light", [(0.0, 0.0), (2.9, 0.0), (0.0, 2.9)]),
}
EACH_SIDE = _sides("left", "right", "top", "bottom")

BY_FORM = 'writing = ["left"]                       # as the form of the reports has it (OSL/1785)'
OF_WILD = (
    'writing = ["left: reads upward", "right: plate reads downward"]   '
    "# side: the reports' form (OSL/1785); direction: frames of 1968 to 1997"
)
OF_ZEISS = 'writing = ["left: reads upward"]         # side: the reports\' form (OSL/1785); direction: a frame of 1979'
OLD_WILD = "the corners: from two Wild frames of 1968 and 1972 that do not name their model"
NEW_WILD = "the corners: from three Wild frames of 1985 to 1997 that do not name their model"
UNKNOWN = "not known"
NO_PICTURE = "not known, for sPyMicMac's gallery of fiducial patterns has no picture of such marks"
T11_OR_T12 = (
    "T-11 and T-12 have the same notches on three sides. The left one, larger in the picture of a T-11, does not tell",
    "the two apart: a T-12 of 1968 has the T-11's. Where the left mark is not found, try the other file.",
)
K17 = ("K-17", "K-17 (modified)", "K-17B", "K-17B (modified)", "K-17C (modified)")
KINDS = (
    Kind("wild-rc5", "Wild RC5", ("RC5", "RC5A", "RC5/8"), (153,), 228.0, CORNERS, 0.3, 0.01, OLD_WILD, False,
         ALIKE_CORNERS, WILD_PLAIN, writing=OF_WILD),
    Kind("wild-rc8", "Wild RC8", ("RC8",), (153,), 228.0, CORNERS + SIDES, 0.3, 0.01, OLD_WILD, False,
         ALIKE_CORNERS, WILD_PLAIN, writing=OF_WILD),
    Kind("wild-rc9", "Wild RC9", ("RC9",), (88,), 228.0, CORNERS, 0.3, 0.01, OLD_WILD, False, ALIKE_CORNERS, WILD_PLAIN,
         writing=BY_FORM),
    Kind("wild-rc10", "Wild RC10", ("RC10", "RC10A", "RC10A*"), (88, 153, 214, 305), 228.0, CORNERS + SIDES, 0.3,
         0.01, NEW_WILD, False, ALIKE_CORNERS, WILD_RING,
         ("Eleven reports, rejected here, have the side marks at 112.5 mm.",), writing=OF_WILD),
    Kind("wild-rc30", "Wild RC30", ("RC30",), (153,), 228.0, CORNERS + SIDES, 0.3, 0.01, NEW_WILD, False,
         ALIKE_CORNERS, WILD_RING),
    Kind("zeiss-rmk-a", "Zeiss RMK A",
         ("RMK A 8.5/23", "RMK A 15/23", "RMK 15/23", "RMK AR 15/23", "RMK A 21/23", "RMK A 30/23", "RMK 30/23",
          "RMK AR 30/23"), (86, 153, 209, 305), 234.0, CORNERS + SIDES, 0.5, 0.02,
         "the sides: from a frame of 1978 with four notches 226 mm apart", False, ALIKE_SIDES, RMK,
         ("Many cameras have no corner marks; seven reports, rejected here, have them at 105.0 mm.",
          "The frame of 1978 ends 117 mm from the middle, 4 mm beyond its notches."), writing=OF_ZEISS),
    Kind("zeiss-rmk-top", "Zeiss RMK TOP", ("RMK TOP",), (153, 305), 230.0, CORNERS + SIDES, 0.3, 0.02, NO_PICTURE),
    Kind("jena-lmk", "Jena LMK", ("LMK",), (153,), 228.0, CORNERS + SIDES, 0.3, 0.01, NO_PICTURE, writing=BY_FORM),
    Kind("fairchild-k17", "Fairchild K-17", K17, (153, 210, 305), 228.6, SIDES, 2.0, 0.2, UNKNOWN, True),
    Kind("fairchild-t11", "Fairchild T-11", ("T-11",), (153,), 228.6, SIDES, 2.0, 0.1, UNKNOWN),
    Kind("fairchild-t12", "Fairchild T-12", ("T-12", "T-12A"), (152,), 228.6, SIDES, 1.5, 0.1, UNKNOWN, notes=(
        "Corner marks, where there are any, lie anywhere from 105.6 to 116.3 mm: none are given.",
        "Seven reports, rejected here, have the side marks at 110 mm.")),
    Kind("fairchild-kc1", "Fairchild KC-1", ("KC-1", "KC-1A", "KC-1B"), (153,), 228.6, SIDES, 1.0, 0.1, NO_PICTURE),
    Kind("fairchild-kc6a", "Fairchild KC-6A", ("KC-6A",), (152,), 228.6, SIDES, 1.0, 0.1, GALLERY, False, KC6A_SIDES,
         KC6A),
    Kind("wild-rc8-eight", "Wild RC8 with plain side crosses", ("RC8",), (153,), 228.0, CORNERS + SIDES, 0.3, 0.01,
         f"{OLD_WILD}; the sides: {GALLERY}", False, EIGHT, WILD_ALL_PLAIN, writing=OF_WILD),
    Kind("wild-rc10-eight", "Wild RC10 with plain corners and ringed sides", ("RC10", "RC10A", "RC10A*"),
         (88, 153, 214, 305), 228.0, CORNERS + SIDES, 0.3, 0.01, f"{OLD_WILD}; the sides: {GALLERY}", False, EIGHT,
         WILD_RING_SIDES, writing=OF_WILD),
    Kind("wild-rc10-ringed", "Wild RC10 with ringed corners and sides", ("RC10", "RC10A", "RC10A*"), (153,), 228.0,
         CORNERS + SIDES, 0.3, 0.01, f"{NEW_WILD}; the sides: from a scan of a Wild 15/4 UAGA-F", False, EIGHT,
         WILD_ALL_RINGED, writing=OF_WILD),
    Kind("zeiss-rmk-a-eight", "Zeiss RMK A with corner crosses", ("RMK A 15/23", "RMK 15/23", "RMK AR 15/23"), (153,),
         234.0, CORNERS + SIDES, 0.5, 0.02, f"the sides: from a frame of 1978; the corners: {GALLERY}", False, EIGHT,
         RMK_EIGHT, writing=OF_ZEISS),
    Kind("park", "Park with ringed crosses", ("Park",), (153,), 228.6, CORNERS + SIDES, 0.5, 0.03, GALLERY, False,
         EIGHT, PARK),
    Kind("fairchild-t5", "Fairchild T-5", ("T-5",), (153,), 229.8, SIDES, 2.0, 0.2, GALLERY, True, EACH_SIDE, T5),
    Kind("fairchild-t11-notch", "Fairchild T-11 with notches", ("T-11",), (153,), 228.6, SIDES, 2.0, 0.1, GALLERY,
         False, NOTCHES, T11_NOTCH, T11_OR_T12),
    Kind("fairchild-t11-check", "Fairchild T-11 with checked squares", ("T-11",), (153,), 228.6, SIDES, 2.0, 0.1,
         GALLERY, False, ALIKE_SIDES, CHECK),
    Kind("fairchild-t12-notch", "Fairchild T-12 with notches", ("T-12", "T-12A"), (152,), 228.6, SIDES, 1.5, 0.1,
         GALLERY, False, NOTCHES, T12_NOTCH, T11_OR_T12),
    Kind("fairchild-t12-cross", "Fairchild T-12 with crosses", ("T-12", "T-12A"), (152,), 228.6, SIDES, 1.5, 0.1,
         GALLERY, False, ALIKE_SIDES, T12_CROSS),
    *(Kind(f"fairchild-k17-{name}", f"Fairchild K-17, {words} wings", K17, (153, 210, 305), 228.6, SIDES, 2.0, 0.2,
           GALLERY, True, sides, marks)
      for name, words, sides, marks in (("small-flat", "small flat", OTHER_WINGS, SMALL_FLAT),
                                        ("tall-flat", "tall flat", WINGS, TALL_FLAT),
                                        ("curved-flat", "curved and flat", WINGS, CURVED_FLAT))),
)  # fmt: skip
