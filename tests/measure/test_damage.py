"""Marks in damaged files, and what residuals show of dust and scratches."""

import multiprocessing
import resource
import time
from functools import cache
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
import tifffile
from damaged_files import DAMAGES, measure_file, outcome, stored
from numpy.typing import NDArray

from measure import FrameMeasurement, MeasurementError, Status, open_scan
from measure.fiducials.measurement import report_damage
from measure.noise.robust_estimation import damage

CASES = 20  # of each damage in each kind of file, in the study
LONGEST_S = 20.0  # of the processor
WAITED_S = 300.0  # until a case is a hang: the machine may have other work
MOST_BYTES = 1 << 30


def damaged(name: str, kind: str, case: int) -> bytes:
    """The file damaged; the case decides where, the same in every run."""
    rng = np.random.default_rng([case, list(stored()).index(name), list(DAMAGES).index(kind)])
    data = bytearray(stored()[name])
    DAMAGES[kind](data, rng)
    return bytes(data)


def test_every_damage_is_reported_or_leaves_each_pixel_at_its_place(tmp_path: Path) -> None:
    """A checksum tells all; else a changed byte may leave another grey value where nobody can know it. A picture that
    is not where it was differs nearly everywhere, but for a changed brightness of what follows in a JPEG stream."""
    path = tmp_path / "s"
    for name, whole in stored().items():
        path.write_bytes(whole)
        with open_scan(path) as scan:
            right = scan.samples(0, 0, scan.width_px, scan.height_px).astype(float)
        for kind in DAMAGES:
            for case in range(2):
                path.write_bytes(damaged(name, kind, case))
                found = known_samples(path)
                if found is None or found[0].shape != right.shape:
                    continue
                off = np.abs(detail(found[0]) - detail(right))[found[1]].ravel()
                moved = (off > 20 * right.max() / 255).mean() if off.size else 0.0
                assert moved <= (0.0 if name in ("tiff deflate", "png") else 0.05), (name, kind, case)


def known_samples(path: Path) -> tuple[NDArray[np.float64], NDArray[np.bool_]] | None:
    """Of a scan, and which of its pixels are known; None where it is refused."""
    try:
        with open_scan(path) as scan:
            place = 0, 0, scan.width_px, scan.height_px
            return scan.samples(*place).astype(float), scan.inside(*place)
    except MeasurementError:
        return None


def detail(samples: NDArray[np.float64]) -> NDArray[np.float64]:
    """Steps from pixel to pixel: a changed brightness of all leaves them as they are."""
    return np.asarray(np.diff(samples, axis=1, append=samples[:, -1:]))


@pytest.mark.parametrize("kind", ["jpeg", "jpeg progressive"])
def test_thirty_bytes_lost_from_a_jpeg_stream(tmp_path: Path, kind: str) -> None:
    data = stored()[kind]
    (tmp_path / "s.jpg").write_bytes(data[: len(data) // 2] + data[len(data) // 2 + 30 :])
    with open_scan(tmp_path / "s.jpg") as scan:
        frame = report_damage(scan, measure_file(tmp_path / "s.jpg"))
    assert {mark.status for mark in frame.marks} == {Status.ABSENT}
    assert all("none of it can be trusted" in mark.reason for mark in frame.marks)
    assert "file is damaged" in frame.problems[0]


@pytest.mark.parametrize("kept", [0.3, 0.97])
def test_a_jpeg_cut_short_with_its_end_marker_kept(tmp_path: Path, kept: float) -> None:
    data = stored()["jpeg"]
    (tmp_path / "s.jpg").write_bytes(data[: int(kept * len(data))] + data[-2:])
    with open_scan(tmp_path / "s.jpg") as scan:
        assert "ends before the picture does" in scan.damage


def test_a_mark_in_a_damaged_tile_is_absent_and_the_others_are_measured(tmp_path: Path) -> None:
    data = bytearray(stored()["tiff jpeg tiles"])
    with tifffile.TiffFile(BytesIO(data)) as file:
        offset, count = file.pages.first.dataoffsets[0], file.pages.first.databytecounts[0]
    data[offset + count // 2 : offset + count - 2] = bytes(count - 2 - count // 2)
    (tmp_path / "s.tif").write_bytes(bytes(data))
    frame = measure_file(tmp_path / "s.tif")
    result = {mark.point: mark.status for mark in frame.marks}
    assert result == {"1": "measured", "2": "measured", "3": "absent", "4": "measured"}
    assert "file is damaged at its place: tile 0" in frame.marks[2].reason


@pytest.mark.study
def test_damaged_files_by_the_thousand(tmp_path: Path) -> None:
    """In a process that has so much memory and no more; one that hangs or dies ends the test."""
    cases = [(name, kind, case) for name in stored() for kind in DAMAGES for case in range(CASES)]
    assert len(cases) >= 2000
    with multiprocessing.get_context("spawn").Pool(1, limit_memory) as worker:
        found = {each: worker.apply_async(damaged_outcome, (tmp_path, *each)).get(WAITED_S) for each in cases}
    assert not {each: result for each, result in found.items() if result not in ("message", "right")}


def limit_memory() -> None:
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    most = pages * resource.getpagesize() + MOST_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (most, most))


@cache
def measured_whole(folder: Path, name: str) -> FrameMeasurement:
    (folder / "whole").write_bytes(stored()[name])
    return measure_file(folder / "whole")


def damaged_outcome(folder: Path, name: str, kind: str, case: int) -> str:
    (folder / "damaged").write_bytes(damaged(name, kind, case))
    right, start = measured_whole(folder, name), time.process_time()
    found = outcome(folder / "damaged", right)
    return found if time.process_time() - start < LONGEST_S else "hang"


def test_where_compression_is_lossy_a_thin_tail_is_none_of_the_speck_and_its_neighbours_are() -> None:
    residuals = 0.5 * np.random.default_rng(2).standard_normal((41, 41))
    residuals[18:23, 18:23] += 60
    residuals[20, 23:35] += 6
    area = np.ones_like(residuals, dtype=bool)
    cut, cut_lossy = damage(residuals, area, 6.0, 0.4), damage(residuals, area, 6.0, 0.4, is_lossy=True)
    assert cut[20, 23:34].all()
    assert not cut_lossy[20, 28:].any()
    assert cut_lossy[18:23, 16:25].all()
    assert cut_lossy[:, :24].sum() > cut[:, :24].sum()
