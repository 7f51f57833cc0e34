"""Which marks of the study of the search anybody can see, from the pictures' own truth and without `measure`.

python -m benchmarks visible_marks OUT.jsonl [--seed 1]

Every frame of `search.py`'s OUT.jsonl is painted once more without its marks: the difference is what the marks add to
the picture, and what is left is the ground that hides them. A filter matched to a mark's own picture, at its known
place, answers so many standard deviations of what the ground about it answers. A mark is visible where the answer, with
that scatter, is as likely as not to pass what one place in a thousand of the ground alone does: in the millimetres that
a frame laid by hand is off by there are some hundred places for a mark. A table tells what became of frames with fewer
than three visible marks, the first two of which fit a similarity wherever they lie, and of the others.
"""

import argparse
import json
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import stats

from benchmarks.search import OUTCOMES, lines
from benchmarks.search_frames import Case, draw_case

Array = NDArray[np.float64]

CHANCE = 0.001  # of the ground's places that pass for a mark
LIKELY = 0.5  # probability of a mark's passing them from which on it counts as visible
LEAST_VISIBLE = 3  # marks of a frame that can be told from chance
MARK_PX = 36  # half the side of the window that holds a mark and its dots
ABOUT_PX = 100  # about a mark: the ground that may hide it
COARSE_PX = 5.0  # of the blur that is ground, a line and a half: an eye sees a mark against what lies beside its lines
FAINT_DN = 20.0  # a picture that changes by less is no mark


def main() -> None:
    """Tell frame by frame, and sum up."""
    parser = argparse.ArgumentParser()
    parser.add_argument("out", type=Path)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--outcome", choices=OUTCOMES, help="of these frames alone, each told mark by mark")
    given = parser.parse_args()
    done = [line for line in lines(given.out) if given.outcome in (None, line["outcome"])]
    told: dict[bool, list[str]] = {True: [], False: []}
    for line in done:
        chances = visibility(draw_case(given.seed, line["frame"]))
        visible = sum(chance >= LIKELY for chance in chances.values())
        told[visible >= LEAST_VISIBLE].append(line["outcome"])
        if given.outcome:
            print(json.dumps({"frame": line["frame"], "visible": visible, **chances}), flush=True)
    print(f"{'visible marks':24}" + "".join(f"{outcome:>13}" for outcome in OUTCOMES) + f"{'frames':>9}")
    for enough, name in ((True, f"{LEAST_VISIBLE} or more"), (False, "fewer")):
        own = told[enough]
        print(f"{name:24}" + "".join(f"{own.count(outcome):13d}" for outcome in OUTCOMES) + f"{len(own):9d}")


def visibility(case: Case) -> dict[str, float]:
    """For each mark that nothing covers the probability that an ideal filter sees it."""
    ground = case.without_marks()
    shown = case.scan.window(0, 0, case.scan.width_px, case.scan.height_px).astype(float) - ground
    limit = float(stats.norm.isf(CHANCE))
    return {
        id: round(float(stats.norm.cdf(strength(shown, ground, center) - limit)), 4)
        for id, center in case.centers_px.items()
        if id not in case.hidden
    }


def strength(shown: Array, ground: Array, center_px: Array) -> float:
    """The filter's answer to the mark, in standard deviations of its answers to the ground."""
    mark = about(shown, center_px, MARK_PX)
    if np.abs(mark).max() < FAINT_DN:
        return 0.0
    template = mark - cv2.GaussianBlur(mark, (0, 0), COARSE_PX)
    answers = cv2.matchTemplate(
        about(ground, center_px, ABOUT_PX).astype(np.float32), template.astype(np.float32), cv2.TM_CCORR
    )
    # Half of the answers, the frame's edge and writing not among them, tell the scatter of all.
    scatter = float(stats.median_abs_deviation(answers, axis=None, scale="normal"))
    return float(np.sum(template * mark)) / max(scatter, 1e-9)


def about(picture: Array, center_px: Array, reach_px: int) -> Array:
    """The part of the picture about a place, (2 reach + 1, 2 reach + 1); beyond its edge it goes on as there."""
    col, row = np.rint(center_px).astype(int)
    wide = np.pad(picture, reach_px, mode="edge")
    return np.asarray(wide[row : row + 2 * reach_px + 1, col : col + 2 * reach_px + 1])


if __name__ == "__main__":
    main()
