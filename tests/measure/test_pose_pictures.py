"""What tells a mark's direction where its chip holds the landscape of other scans."""

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from measure.fiducials.orientation_pictures import Drawings, MarkSite, PosedMark
from measure.marks.shapes import MarkTemplate
from measure.matching.match import MatchOptions, match
from measure.matching.window import ScanWindow
from measure.scans.cache import WholePicture
from measure.scans.metadata import NO_TAGS
from measure.scans.scan import Scan

SIDE = 61
FLIP = np.diag([1.0, -1.0])
BLOCK = np.zeros((SIDE, SIDE), np.uint8)
BLOCK[:, :24], BLOCK[18:43, :36], BLOCK[28:40, :45] = 1, 1, 1  # of the border, reaching into the frame, lopsided


def test_a_block_among_landscape_shows_which_way_it_is_turned() -> None:
    """A block steady in its chip, in landscapes as rough as it is deep, in each of its four directions; also where the
    place is another mark's, which slid along an edge that both have."""
    template = MarkTemplate(
        np.where(BLOCK > 0, 20.0, 150.0),
        1000.0,
        (30, 30),
        polarity="light",
        steady=cv2.dilate(BLOCK, np.ones((5, 5))) > 0,
    )
    turned = [np.diag([x, y]).astype(float) for x in (1, -1) for y in (-1, 1)]
    for seed in range(1):
        for index, linear in enumerate(turned):
            for shift_px in (0.0, 4.0):
                site = among_landscape(template, linear, seed, shift_px)
                result = site.likelihoods([PosedMark(template, FLIP @ each) for each in turned])
                assert result.argmax() == index
                assert np.sort(result)[-2] < -4.0


def among_landscape(template: MarkTemplate, linear: NDArray[np.float64], seed: int, slid_px: float) -> MarkSite:
    rng = np.random.default_rng(seed)
    landscape = cv2.GaussianBlur(rng.normal(0.0, 1.0, (3 * SIDE, 3 * SIDE)), (0, 0), 4.0)
    grey = 150.0 + 45.0 * landscape / landscape.std()
    shown = BLOCK[:: int(-linear[1, 1]), :: int(linear[0, 0])] > 0
    grey[SIDE : 2 * SIDE, SIDE : 2 * SIDE][shown] = 20.0
    grey = np.clip(np.rint(grey + rng.normal(0.0, 1.5, grey.shape)), 0, 255)
    scan = Scan(Path("scan"), WholePicture(grey.astype(np.uint8)[..., None]), NO_TAGS)
    place = np.column_stack([linear, [SIDE + 30.0, SIDE + 30.0]])
    fit = match(ScanWindow(grey), template, place, MatchOptions(freedom="shift", estimate_blur=False))
    return MarkSite(scan, fit, fit.center_px + slid_px, None, Drawings([template], FLIP, 0.0), 5.0)
