"""Pictures of marks are kept when these are measured: a report opens no scan, and shows what the scan shows."""

import os
import shutil
from pathlib import Path

import numpy as np
import pytest
import tifffile
from drawn_project import write_project

from measure.scans.opening import open_scan
from pipeline.archive.measurement import read_fingerprints, read_measurement
from pipeline.archive.results_database import Store
from pipeline.archive.thumbnails import Thumbnails, ThumbnailStore, thumbnails_path
from pipeline.cli import run
from pipeline.results.comparator_file import read_measurement_hash
from pipeline.results.thumbnail import cut


@pytest.fixture(scope="module")
def measured_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = write_project(tmp_path_factory.mktemp("thumbnails"), ["a", "b", "c"]).parent
    assert run(["measure", str(folder / "project.toml")]) == 0
    return folder


@pytest.fixture
def folder(measured_folder: Path, tmp_path: Path) -> Path:
    shutil.copytree(measured_folder, tmp_path / "p")
    return tmp_path / "p"


def keys(folder: Path) -> dict[str, str]:
    digest = read_measurement_hash(folder / "comparator.csv")
    return read_fingerprints(folder / "out" / "measurement.db", digest, ("a", "b", "c", "none"))


def grey(pixels: np.ndarray) -> np.ndarray:
    """On one scale, whichever it had."""
    values = pixels.astype(float).ravel()
    return np.asarray((values - values.mean()) / values.std())


def test_every_mark_has_the_picture_that_its_scan_shows(folder: Path) -> None:
    found = keys(folder)
    assert set(found) == {"a", "b", "c"}
    with ThumbnailStore.open(folder / "out" / "measurement.db") as store:
        for scan in read_measurement(folder / "out" / "measurement.db"):
            with open_scan(scan.scan) as opened:
                for mark in scan.frame.marks:
                    stored, own = store.get(found[scan.frame.image], mark.point, mark.kind), cut(opened, mark)
                    assert stored is not None
                    assert own is not None
                    kept = stored.thumbnail
                    assert (kept.origin_px, kept.step_px, kept.pixels.shape) == (
                        own.origin_px,
                        own.step_px,
                        own.pixels.shape,
                    )
                    assert grey(kept.pixels) @ grey(own.pixels) / own.pixels.size > 0.98


def test_the_whole_scan_is_kept_where_measuring_saw_it(folder: Path) -> None:
    with ThumbnailStore.open(folder / "out" / "measurement.db") as store:
        stored = store.get(keys(folder)["a"])
    assert stored is not None
    assert stored.is_whole
    pixels = tifffile.imread(folder / "a.tif").astype(float)
    step = round(stored.step_px)
    height, width = stored.thumbnail.pixels.shape
    assert abs(width * step - pixels.shape[1]) < 2 * step
    means = pixels[: height * step, : width * step].reshape(height, step, width, step).mean(axis=(1, 3))
    assert grey(means) @ grey(stored.thumbnail.pixels) / means.size > 0.95
    assert len(stored.jpeg) < 100_000


def test_a_report_and_a_frames_page_open_no_scan(folder: Path) -> None:
    for scan in folder.glob("*.tif"):  # the same size and time, and nothing in it
        stat = scan.stat()
        scan.write_bytes(bytes(stat.st_size))
        os.utime(scan, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    project = str(folder / "project.toml")
    assert run(["report", project, "--frames", "a"]) == 0
    assert run(["report", project]) in (0, 1)
    page = (folder / "out" / "frames" / "a.html").read_text(encoding="utf-8")
    assert page.count("data:image/png") == 4
    assert (folder / "out" / "report.html").read_text(encoding="utf-8").count("data:image/png") == 12


def test_without_the_file_pictures_come_from_the_scans_again(folder: Path) -> None:
    (folder / "out" / "thumbnails.db").unlink()
    assert run(["report", str(folder / "project.toml"), "--frames", "a"]) == 0
    assert (folder / "out" / "frames" / "a.html").read_text(encoding="utf-8").count("data:image/png") == 4


def test_a_mark_that_was_measured_elsewhere_since_is_cut_anew(folder: Path) -> None:
    scans, path = read_measurement(folder / "out" / "measurement.db"), folder / "out" / "measurement.db"
    with Thumbnails(scans, None, path, keys(folder)) as kept:
        assert kept.get("a", "1", "fiducial").pixels.dtype == np.uint8  # type: ignore[union-attr]
    for mark in scans[0].frame.marks:
        assert mark.center_px is not None
        np.add(mark.center_px, 60.0, out=mark.center_px)
    with Thumbnails(scans, None, path, keys(folder)) as kept:
        assert kept.get("a", "1", "fiducial").pixels.dtype == np.float32  # type: ignore[union-attr]


def test_pictures_follow_results_that_are_moved_or_merged(folder: Path) -> None:
    project = str(folder / "project.toml")
    run(["measure", project, "--moved", "--workers", "1"])
    before = keys(folder)
    (folder / "a.tif").rename(folder / "aa.tif")
    run(["measure", project, "--moved", "--workers", "1"])
    with Store(folder / "out" / "measurement.db") as store:
        now = set(store.fingerprints()) - set(before.values())
    assert len(now) == 1
    with ThumbnailStore.open(folder / "out" / "measurement.db") as thumbnails:
        assert thumbnails.get(now.pop(), "1", "fiducial") is not None
        assert thumbnails.get(before["a"], "1", "fiducial") is None


@pytest.mark.study
def test_stores_of_shards_bring_their_pictures(measured_folder: Path, tmp_path: Path) -> None:
    parts = tmp_path / "parts"
    shutil.copytree(measured_folder, parts, ignore=lambda *_: ["out", "comparator.csv"])
    project = str(parts / "project.toml")
    for k in (1, 2):
        run(["measure", project, "--shard", f"{k}/5", "--workers", "1"])
    run(["merge", project, *(str(parts / "out" / f"measurement.{k}-of-5.db") for k in (1, 2))])
    assert thumbnails_path(parts / "out" / "measurement.1-of-5.db").exists()
    with ThumbnailStore.open(parts / "out" / "measurement.db") as thumbnails:
        assert all(thumbnails.get(key, "1", "fiducial") for key in keys(parts).values())
    assert len(keys(parts)) == 3


def test_a_file_of_another_kind_in_its_place_is_refused(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copy(folder / "out" / "measurement.db", folder / "out" / "thumbnails.db")
    (folder / "b.tif").unlink()
    assert run(["measure", str(folder / "project.toml"), "--workers", "1"]) == 2
    assert "thumbnails" in capsys.readouterr().err
