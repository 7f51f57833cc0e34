"""Where a calibration board lies in a scan, to a pixel: OpenCV's detectors on a reduced picture."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from measure.codes_and_boards.board_specs import ArucoSpec, CharucoSpec, ChessboardSpec, SquareGridSpec
from measure.codes_and_boards.chessboard_finding import find_chessboard
from measure.codes_and_boards.found_board import FoundBoard, FoundCorner, corners_of_square
from measure.codes_and_boards.marker_boards import find_aruco, find_charuco
from measure.codes_and_boards.square_grids import NoSquareGridError, find_squares
from measure.reason import NO_REASON, Code, Reason
from measure.scans.scan import Scan

Array = NDArray[np.float64]
Bytes = NDArray[np.uint8]

_FIRST_SIZE_PX, _LAST_SIZE_PX = 1500, 4000  # the longer side of the pictures that are searched
_LEAST_CONTRAST = 0.01  # of the full scale; below it there is nothing to be seen, and searching takes long


def find_board(scan: Scan, spec: ChessboardSpec | ArucoSpec | CharucoSpec | SquareGridSpec) -> FoundBoard:
    """Search a board at a size that shows it whole, then finer: small boards in large scans need it."""
    for factor in _search_factors(scan):
        picture, reason = _searchable(scan, factor)
        if reason:
            return FoundBoard({}, reason)
        if isinstance(spec, ChessboardSpec):
            found = find_chessboard(picture, spec)
        elif isinstance(spec, CharucoSpec):
            found = find_charuco(picture, spec)
        elif isinstance(spec, SquareGridSpec):
            found = _find_squares(picture, spec)
        else:
            found = find_aruco(picture, spec)
        if found.corners:
            corners = {name: _in_scan(corner, factor) for name, corner in found.corners.items()}
            return replace(found, corners=corners, others_px=tuple(_scan_px(one, factor) for one in found.others_px))
    return found


def _search_factors(scan: Scan) -> list[int]:
    """Reductions of the scan to search, the coarsest first."""
    longest = max(scan.width_px, scan.height_px)
    coarse, fine = (max(round(longest / size), 1) for size in (_FIRST_SIZE_PX, _LAST_SIZE_PX))
    return [coarse] if coarse == fine else [coarse, fine]


def _searchable(scan: Scan, factor: int) -> tuple[Bytes, Reason]:
    """The reduced scan stretched to 8 bits, and why there is nothing to search in it, if so."""
    grey = scan.reduced(factor)
    low, high = np.percentile(grey, (1, 99))
    if high - low < _LEAST_CONTRAST * scan.full_scale_dn:
        share = 100 * (high - low) / scan.full_scale_dn
        told = f"the scan has no contrast: its grey values span {share:.1f} % of the scale"
        return np.zeros((1, 1), np.uint8), Reason(told, Code.CONTRAST)
    return np.clip((grey - low) * (255 / (high - low)), 0, 255).astype(np.uint8), NO_REASON


def _in_scan(corner: FoundCorner, factor: int) -> FoundCorner:
    return FoundCorner(_scan_px(corner.center_px, factor), corner.steps_px * factor)


def _scan_px(place_px: Array, factor: int) -> Array:
    """Pixel (i, j) of a reduced picture has its centre at factor j + (factor - 1) / 2."""
    return place_px * factor + (factor - 1) / 2


def _find_squares(picture: Bytes, spec: SquareGridSpec) -> FoundBoard:
    """The corners of separate squares; steps are the square's sides that leave the corner."""
    try:
        squares, notes, others = find_squares(picture, spec)
    except NoSquareGridError as error:
        return FoundBoard({}, Reason(str(error), Code.NO_BOARD))
    corners = {id: corner for name, four in squares.items() for id, corner in corners_of_square(name, four).items()}
    return FoundBoard(corners, others_px=others, notes=notes)
