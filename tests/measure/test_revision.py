"""Who changes what measuring gives raises `MEASURE_REVISION`: else results that were kept would be taken for new ones.

Afterwards `python tests/measure/test_revision.py` writes the table anew, revision.json.
"""

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from drawn import NUMBERED, draw, ellipse, frame_picture, lay_out, make_scan, measure_grey, pixel_from_camera
from scipy.ndimage import gaussian_filter

from measure import FiducialOptions, TargetPrediction, measure_disks
from measure.boards.measure import measure_board
from measure.boards.specs import ChessboardSpec
from measure.marks.shapes import MarkShape, polygon, turned_part
from measure.results import MEASURE_REVISION, MarkMeasurement

TABLE = Path(__file__).with_name("revision.json")
PLACE_PX, SIGMA = 1e-4, 0.01  # which processors may make of rounding; SIGMA is a share
WEDGE = polygon([(0.0, 0.0), (0.9, -0.5), (0.9, 0.5)])
WEDGES = lay_out([MarkShape((turned_part(WEDGE[0], turn),)) for turn in (135.0, 45.0, -45.0, -135.0)])

Row = tuple[str, tuple[float, ...]]  # status; column, row and their standard deviations


def results() -> dict[str, Row]:
    """What measuring gives of a few small pictures, by their kind and the mark."""
    turned, wedges = frame_picture(NUMBERED, pixel_from_camera("90m")), frame_picture(WEDGES, pixel_from_camera("0"))
    frames = {
        "ring-crosses in a pose that is not known": measure_grey(turned, NUMBERED),
        "wedges in coarse steps": measure_grey(np.rint(wedges / 800) * 800, WEDGES, FiducialOptions("0")),
    }
    marks = {f"{kind}: {mark.point}": mark for kind, frame in frames.items() for mark in frame.marks}
    poses = {f"{kind}: pose {frame.pose.name}": ("", ()) for kind, frame in frames.items() if frame.pose}
    marks |= {f"chessboard: {mark.point}": mark for mark in chessboard()}
    marks |= {f"disks: {mark.point}": mark for mark in disks()}
    return {**poses, **{name: _row(mark) for name, mark in marks.items()}}


def chessboard() -> tuple[MarkMeasurement, ...]:
    squares = np.kron(np.indices((4, 5)).sum(axis=0) % 2, np.ones((24, 24)))
    sharp = np.pad(squares, 24, constant_values=1.0)
    grey = gaussian_filter(sharp, 1.0) * 40000.0 + 5000.0 + np.random.default_rng(3).normal(0.0, 300.0, sharp.shape)
    return measure_board(make_scan(grey), ChessboardSpec(4, 3, 10.0)).marks


def disks() -> tuple[MarkMeasurement, ...]:
    """Five of them, predicted a little off."""
    rng = np.random.default_rng(4)
    grey, predictions = 12000.0 + rng.normal(0.0, 400.0, (120, 300)), []
    for number in range(5):
        place, shape = np.array([40.3 + 52 * number, 60.7]), np.diag([6.0, 5.0])
        col0, row0 = np.round(place).astype(int) - 16
        grey[row0 : row0 + 33, col0 : col0 + 33] += 20000 * draw(ellipse(place - (col0, row0), shape), 33, 33, 0.9)
        predictions.append(TargetPrediction(str(number), place + np.array([3.0, -2.0]), shape, 12.0))
    return measure_disks(make_scan(grey), predictions)


def _row(mark: MarkMeasurement) -> Row:
    numbers = [] if mark.center_px is None else mark.center_px.round(5).tolist()
    if mark.covariance_px2 is not None:
        numbers += np.sqrt(np.diag(mark.covariance_px2)).round(6).tolist()
    return str(mark.status), tuple(numbers)


def differing(before: Mapping[str, Row], now: Mapping[str, Row]) -> list[str]:
    """The marks of which something else is measured than before."""
    return sorted(name for name in before.keys() | now.keys() if not _alike(before.get(name), now.get(name)))


def _alike(before: Row | None, now: Row | None) -> bool:
    if before is None or now is None or before[0] != now[0] or len(before[1]) != len(now[1]):
        return False
    numbers, others = np.array(before[1]), np.array(now[1])
    is_near = bool((np.abs(numbers[:2] - others[:2]) <= PLACE_PX).all())
    return is_near and np.allclose(numbers[2:], others[2:], rtol=SIGMA, atol=2e-6)


def test_what_measuring_gives_is_that_of_its_revision() -> None:
    table = json.loads(TABLE.read_text(encoding="utf-8"))
    changed = differing(table["results"], results())
    then = "and run python tests/measure/test_revision.py"
    result = f"{len(changed)} marks, such as {', '.join(changed[:3])}, are measured otherwise"
    assert not changed or table["revision"] != MEASURE_REVISION, f"raise MEASURE_REVISION, {then}: {result}"
    assert table["revision"] == MEASURE_REVISION, f"MEASURE_REVISION was raised: {then}"


def test_another_place_or_status_or_sigma_is_noticed() -> None:
    status, numbers = "measured", (10.0, 20.0, 0.01, 0.02)
    before: dict[str, Row] = {"1": (status, numbers), "pose 0": ("", ())}
    assert not differing(before, {**before, "1": (status, (10.00005, *numbers[1:]))})
    others: list[Row] = [
        (status, (10.0002, *numbers[1:])),
        ("weak", numbers),
        (status, (*numbers[:3], 0.0203)),
        (status, numbers[:2]),
    ]
    for other in others:
        assert differing(before, {**before, "1": other}) == ["1"]
    assert differing(before, {"1": before["1"], "pose 90": ("", ())}) == ["pose 0", "pose 90"]


if __name__ == "__main__":
    written = {"revision": MEASURE_REVISION, "results": results()}
    TABLE.write_text(json.dumps(written, indent=0, ensure_ascii=False) + "\n", encoding="utf-8")
