"""What the tips of folders say of the tone curve where they are matched by the true one, against what they claim.

    python -m benchmarks tone_said [--folders 45] [--scans 3] [--seed 7] [--stored JPEG]

Folders as `tone_curves --scans 8` has them, some scans of each. At the true curve marks should want no other: told is
how far the curve that they do want moves the tips along their axes, over its standard deviation, rms and mean, for
scans alone and for folders, by way to store, kind and curve. Scans of a folder whose errors are independent of one
another make the two rms alike.

Then, of lone scans whose tips are known to 0.2 px: by how much what is believed beforehand moves them in the mean,
outwards, px, by kind and curve, and the share of scans that these are.
"""

import argparse
from collections import defaultdict
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from benchmarks.tone_frames import PITCH_UM, STORED, TIPS, Case, draw_case
from measure.fiducials.constellation import Placement
from measure.fiducials.frame import Frame
from measure.fiducials.mark_fit import detect_mark
from measure.fiducials.options import FiducialOptions
from measure.fiducials.refit import edge_tone_information
from measure.marks.frame_border import limit_to_frame
from measure.tone.curve import Tone, ToneInformation
from synthetic_images.tone_curve import coded

Array = NDArray[np.float64]
Said = tuple[
    list[ToneInformation], Array, Array
]  # marks and edges; (k,) px outwards for each departure of 1; of the truth

_SEARCH_PX, _FRAME_SIGMA, _SURE_PX = 1.5, 1e-4, 0.2


def said_by_scan(case: Case) -> Said | None:
    """None where no mark says anything."""
    light = np.linspace(0.0, 1.0, 200001)
    codes = np.linspace(0.0, 1.0, len(Tone().base))
    curve = np.interp(codes, coded(light.astype(np.float32), case.curve), light)
    layout = limit_to_frame(case.layout)
    scan = case.scan.replace_tone(Tone(curve, covariance=1e-12 * np.eye(5)))
    places = np.array([case.centers_px[mark.id] for mark in layout.marks])
    design = np.array([[*mark.xy_mm, 1.0] for mark in layout.marks])
    matrix = np.linalg.lstsq(design, places, rcond=None)[0].T
    placement = Placement(case.pose, matrix, 1.0, len(places), 1, 1, (PITCH_UM / 1000,) * 2)
    frame = Frame.from_placement(scan, layout, placement, FiducialOptions(pose=case.pose))
    said, outwards, codes_seen = [], [], []
    for index, mark in enumerate(layout.marks):
        fit = detect_mark(scan, frame.prediction(index, _SEARCH_PX), frame.options.match, _FRAME_SIGMA).fit
        if fit is not None and fit.tone is not None and fit.tone.information.count:
            said.append(fit.tone.information)
            outwards.append(-case.inward[mark.id] @ fit.tone.on_place)
            codes_seen += [fit.tone.least, fit.tone.greatest]
    if not said:
        return None
    edges = [] if scan.is_lossy else edge_tone_information(scan, layout, matrix, None)
    seen = (codes > max(min(codes_seen), 0.005)) & (codes < max(codes_seen))
    return [*said, *edges], np.mean(outwards, axis=0), departures(codes[seen], curve[seen])


def departures(codes: Array, light: Array) -> Array:
    """(k,) of a curve, the least ones, from that of which nothing is said, by the logarithms of both slopes."""
    unknown = Tone.unknown()
    slope = [np.log(np.gradient(unknown.replace_departures(mean).light(codes, 1.0).astype(float), codes))
             for mean in (np.zeros(5), *np.eye(5))]  # fmt: skip
    design = np.column_stack([*(one - slope[0] for one in slope[1:]), np.ones(len(codes))])
    wanted = np.log(np.maximum(np.gradient(light, codes), 1e-9)) - slope[0]
    normal = design.T @ design / 0.1**2 + np.diag([1.0] * 5 + [0.0])
    return np.asarray(np.linalg.solve(normal, design.T @ wanted / 0.1**2)[:5])


def pull(each: Sequence[ToneInformation], outwards: Array, truth: Array) -> float | None:
    """How far what is believed beforehand moves the tips of a scan, px outwards; None where they are not known well."""
    said, prior = ToneInformation.pooled(each).scanner_information, np.linalg.inv(Tone.unknown().covariance)
    covariance = np.linalg.inv(prior + said.matrix)
    if outwards @ covariance @ outwards > _SURE_PX**2:
        return None
    return -float(outwards @ covariance @ prior @ truth)


def over_claim(each: Sequence[ToneInformation], outwards: Array) -> float:
    """How far the curve that they want moves the tips, over its standard deviation by what is wrong with what they
    say: that of their prior has no part in it."""
    said = ToneInformation.pooled(each).scanner_information
    estimate = outwards @ np.linalg.inv(np.eye(len(outwards)) + said.matrix)
    return float(estimate @ said.right_side / np.sqrt(estimate @ said.matrix @ estimate))


def print_table(scans: Mapping[str, list[float]], folders: Mapping[str, list[float]]) -> None:
    print(f"\n{'':16} {'scans':>6} {'rms':>6} {'mean':>6} {'folders':>8} {'rms':>6} {'mean':>6}")
    for name, alone in scans.items():
        told = (f"{len(each):8} {np.sqrt(np.mean(np.square(each))):6.2f} {np.mean(each):+6.2f}"
                for each in (alone, folders[name]))  # fmt: skip
        print(f"{name:14}", *told, flush=True)


def print_pulls(pulls: Mapping[str, list[float | None]]) -> None:
    for name, each in sorted(pulls.items()):
        sure = [one for one in each if one is not None]
        mean = f"{np.mean(sure):+.3f}" if sure else "-"
        print(f"{name:16} {mean:>7} {len(sure) / len(each):6.0%}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folders", type=int, default=45)
    parser.add_argument("--scans", type=int, default=3)
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--stored", choices=STORED)
    options = parser.parse_args()
    scans, folders = defaultdict[str, list[float]](list), defaultdict[str, list[float]](list)
    pulls = defaultdict[str, list[float | None]](list)
    for folder in range(options.folders):
        stored = str(np.random.default_rng([options.seed, 8, folder]).choice(STORED))  # as draw_case draws it first
        if options.stored not in (None, stored):
            continue
        cases = [draw_case(options.seed, 8 * folder + index, 8, TIPS) for index in range(options.scans)]
        said = [one for one in map(said_by_scan, cases) if one is not None]
        if not said:
            continue
        outwards = np.mean([way for _, way, _ in said], axis=0)
        together = over_claim([one for each, _, _ in said for one in each], outwards)
        pulls[f"{cases[0].kind} {cases[0].curve}"] += [pull(*one) for one in said]
        for name in ("all", cases[0].stored, cases[0].kind, f"curve {cases[0].curve}"):
            scans[name] += [over_claim(each, way) for each, way, _ in said]
            folders[name].append(together)
    print_table(scans, folders)
    print_pulls(pulls)


if __name__ == "__main__":
    main()
