"""Marks measured through unknown tone curves, against their truth.

    python -m benchmarks tone_curves [--frames 60] [--first 0] [--seed 1] [--keep FILE] [--every 50] [--scans 1]

Frames as `tone_frames` draws them: seven kinds of marks; gamma 1, 1.8, 2.2, sRGB and an S-curve; 16 and 8 bit and JPEG
of quality 60 to 95; signal-to-noise 8 to 100; turned by up to 3 degrees; uneven focus, vignetting, a stamp over a mark,
a mark missing, a neighbouring frame. Nothing is said of the curve, and each frame is alone. --keep holds a line a
frame, so that a run can be stopped and go on, or be printed again; the table so far comes after --every frames.

Told are, for each kind, curve, way to store, difficulty and noise: marks that can be seen, of these the per cent found
and the per cent `measured`; of the marks `measured` the rms error, the rms of error over claim, the largest one, and
how many are off by more than 5 standard deviations. Of tips: the mean error along their axes, outwards.

--scans 8: eight frames in a row, of tips alone, are scans of one camera by one scanner, as in a folder. What eight of
them say of the curve is believed of the others, as `reseau measure` does; --frames counts scans.
"""

import argparse
import json
import time
from collections.abc import Iterable, Sequence
from functools import cache
from itertools import chain, pairwise
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.tone_frames import KINDS, PITCH_UM, TIPS, Case, draw_case
from measure.fiducials.measurement import measure_fiducials
from measure.fiducials.options import FiducialOptions
from measure.flags import Cause, Status
from measure.results import FrameMeasurement
from measure.tone.curve import Tone, ToneInformation

Row = dict[str, Any]

_GROSS, _SAMPLES = 5.0, 8
_NOISES = (8.0, 15.0, 30.0, 60.0, 101.0)


def rows_of(case: Case, index: int, said: Sequence[ToneInformation] = ()) -> list[Row]:
    """One for each mark of a frame; said: by other scans of its scanner."""
    start = time.process_time()
    frame = measured(case, Tone.unknown().include_information(said))
    seconds = time.process_time() - start
    rows = []
    for mark in frame.marks:
        row: Row = {
            "frame": index,
            "kind": case.kind,
            "curve": str(case.curve),
            "stored": case.stored,
            "difficulty": case.difficulty,
            "snr": case.snr,
            "point": mark.point,
            "seconds": seconds,
            "visible": mark.point not in case.hidden,
            "status": str(mark.status),
        }
        if mark.status.is_observation and mark.center_px is not None and mark.covariance is not None:
            error = mark.center_px - case.centers_px[mark.point]
            row["px"] = float(np.hypot(*error))
            row["outwards_px"] = -float(error @ case.inward[mark.point])
            row["square"] = float(error @ np.linalg.solve(mark.covariance.px2, error))
            row["tone_px"] = mark.covariance.sigmas_px.get(Cause.TONE, 0.0)
        rows.append(row)
    return rows


def measured(case: Case, tone: Tone) -> FrameMeasurement:
    scan = case.scan.replace_tone(tone)
    return measure_fiducials(scan, case.layout, (PITCH_UM, PITCH_UM), FiducialOptions(pose=case.pose))


@cache
def said_in_folder(seed: int, folder: int, scans: int) -> dict[int, ToneInformation]:
    """By frame, what some of a folder's scans say of its curve."""
    some = range(folder * scans, folder * scans + min(scans, _SAMPLES))
    tones = {index: measured(draw_case(seed, index, scans, TIPS), Tone.unknown()).tone for index in some}
    return {
        index: tone.information for index, tone in tones.items() if tone is not None and tone.information is not None
    }


def told(name: str, rows: Iterable[Row]) -> str:
    rows = list(rows)
    visible = [row for row in rows if row["visible"]]
    found = [row for row in visible if "px" in row]
    good = [row for row in rows if row["status"] == Status.MEASURED]
    if not visible or not good:
        return f"{name:24} {len(visible):6} {'none measured':>12}"
    squares = np.array([row["square"] for row in good])
    measured = sum(row["status"] == Status.MEASURED for row in visible) / len(visible)
    rms_px = np.sqrt(np.mean([row["px"] ** 2 for row in good]) / 2)
    return (
        f"{name:24} {len(visible):6} {100 * len(found) / len(visible):6.1f} {100 * measured:6.1f} {rms_px:7.3f} "
        f"{np.sqrt(squares.mean() / 2):6.2f} {np.sqrt(squares.max()):6.1f} {int((squares > _GROSS**2).sum()):4}"
    )


def print_table(rows: list[Row]) -> None:
    print(f"{'':24} {'marks':>6} {'found':>6} {'meas.':>6} {'rms px':>7} {'/claim':>6} {'worst':>6} {'>5':>4}")
    print(told("all", rows))
    for key in ("kind", "curve", "stored", "difficulty"):
        for value in sorted({row[key] for row in rows}):
            print(told(f"{key} {value}", (row for row in rows if row[key] == value)))
    for low, high in pairwise(_NOISES):
        print(told(f"snr {low:.0f} to {high:.0f}", (row for row in rows if low <= row["snr"] < high)))
    print("\nmean error along the axes of tips, outwards, px (of frames' means: its standard deviation)")
    curves = sorted({row["curve"] for row in rows})
    print(f"{'':10}" + "".join(f"{curve:>18}" for curve in curves))
    for kind in TIPS:
        cells = [_bias([row for row in rows if row["kind"] == kind and row["curve"] == curve]) for curve in curves]
        print(f"{kind:10}" + "".join(f"{cell:>18}" for cell in cells))
    frames = {row["frame"]: row["seconds"] for row in rows}
    print(f"\n{len(frames)} frames, {np.mean(list(frames.values())):.2f} s of processor time each")


def _bias(rows: list[Row]) -> str:
    """Over frames, for the tips of one are off together."""
    good = [row for row in rows if row["status"] == Status.MEASURED]
    frames = {row["frame"] for row in good}
    if not frames:
        return "-"
    means = [float(np.mean([row["outwards_px"] for row in good if row["frame"] == frame])) for frame in frames]
    return f"{np.mean(means):+.3f} ({np.std(means) / np.sqrt(len(means)):.3f})"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--keep", type=Path)
    parser.add_argument("--every", type=int, default=50)
    parser.add_argument("--scans", type=int, default=1)
    options = parser.parse_args()
    kept = kept_frames(options.keep) if options.keep else {}
    wanted = range(options.first, options.first + options.frames)
    for done, index in enumerate((index for index in wanted if index not in kept), 1):
        scans = options.scans
        said = {} if scans == 1 else said_in_folder(options.seed, index // scans, scans)
        case = draw_case(options.seed, index, scans, KINDS if scans == 1 else TIPS)
        kept[index] = rows_of(case, index, [each for other, each in said.items() if other != index])
        if options.keep:
            with options.keep.open("a", encoding="utf-8") as file:
                file.write(json.dumps(kept[index]) + "\n")
        if not done % options.every:
            print(f"\nafter {len(kept)} frames", flush=True)
            print_table(list(chain(*kept.values())))
    print(f"\nall {len(kept)} frames")
    print_table(list(chain(*kept.values())))


def kept_frames(path: Path) -> dict[int, list[Row]]:
    """The rows of each frame that stands in a file whole: the line of one that a run was cut off in does not."""
    lines = path.read_text(encoding="utf-8").splitlines(keepends=True) if path.exists() else []
    frames = [json.loads(line) for line in lines if line.endswith("\n")]
    if len(frames) < len(lines):
        path.write_text("".join(lines[:-1]), encoding="utf-8")
    return {rows[0]["frame"]: rows for rows in frames}


if __name__ == "__main__":
    main()
