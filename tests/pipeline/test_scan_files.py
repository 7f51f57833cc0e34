"""Scans by patterns, as pages and windows of a file, in object stores and on servers."""

import glob
import os
import sqlite3
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from drawn import pixel_from_camera
from moto.server import ThreadedMotoServer
from projects import PLACES, PROJECT, Capture, Refusal, command, write_project
from range_server import range_server

from measure import Status
from measure.scans import remote
from pipeline import InputError, read_comparator, read_project
from pipeline.archive.scan_groups import Catalogue, catalogue
from pipeline.cli import LOOK
from pipeline.files.scan_files import find_scans, found_names
from pipeline.measuring.scan_measurement import measured_scan
from pipeline.measuring.scan_task import scan_tasks
from pipeline.provenance import file_state, parts_hash
from pipeline.text.tables import Table

FILES = ("1.tif", "a/2.tif", "a/b/3.tif", ".hidden/4.tif", ".5.tif")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in FILES:
        path = tmp_path / "scans" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    return tmp_path


def find_scans_case(folder: Path, *patterns: str, exclude: tuple[str, ...] = ()) -> list[str]:
    files = find_scans(Table({}, folder / "project.toml", ""), patterns, exclude).files.values()
    return sorted(os.path.relpath(file, folder) for file in files)


@pytest.mark.parametrize(
    "pattern",
    ["scans/**", "scans/**/*.tif", "**/*.tif", "**/a/**/*.tif", "scans/**/b/*", "scans/**/", "./scans/**/3.tif"],
)
def test_any_number_of_folders_is_as_in_glob(folder: Path, pattern: str) -> None:
    def files(names: set[str]) -> set[str]:
        return {os.path.normpath(name) for name in names if (folder / name).is_file()}

    assert files(found_names(pattern, folder)) == files(set(glob.glob(pattern, root_dir=folder, recursive=True)))


def test_links_to_parents_bring_nothing_twice(folder: Path) -> None:
    """Two links up make glob follow 2^40 paths; here the folder beside the scans is not theirs either."""
    (folder / "others").mkdir()
    (folder / "others" / "6.tif").touch()
    for name, target in {"up": "..", "a/again": "../a", "a/b/top": str(folder / "scans")}.items():
        (folder / "scans" / name).symlink_to(target)
    assert find_scans_case(folder, "scans/**/*.tif") == ["scans/1.tif", "scans/a/2.tif", "scans/a/b/3.tif"]
    files = catalogue([folder / "scans"], lambda *_: None).unread
    assert len(files) == 3  # empty files, which no scan is


def test_a_file_is_one_scan_however_many_links_lead_to_it(folder: Path) -> None:
    (folder / "others").mkdir()
    (folder / "others" / "6.tif").touch()
    scans = folder / "scans"
    (scans / "elsewhere").symlink_to(folder / "others")
    (scans / "0.tif").symlink_to("1.tif")
    (scans / "twin").symlink_to("a")
    there = ["scans/1.tif", "scans/a/2.tif", "scans/a/b/3.tif", "scans/elsewhere/6.tif"]
    assert find_scans_case(folder, "scans/**/*.tif", "scans/twin/*.tif", "scans/*.tif") == there
    assert find_scans_case(folder, "scans/**/*.tif", exclude=("scans/twin/2.tif",)) == [there[0], *there[2:]]
    assert find_scans_case(folder, "scans/0.tif") == ["scans/0.tif"]  # named as it is
    (folder / "scans" / "7.tif").symlink_to("nowhere.tif")
    assert "scans/7.tif" in find_scans_case(folder, "scans/**/*.tif")


@pytest.fixture(scope="module")
def roll(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A project of one TIFF: its first page shows frames a and b side by side, its second one b alone."""
    folder = tmp_path_factory.mktemp("roll")
    write_project(folder, ["a", "b"], f'{PROJECT}writing = "none"\n')
    one, two = (tifffile.imread(folder / f"{name}.tif") for name in "ab")
    for file in folder.glob("*.tif"):
        file.unlink()
    with tifffile.TiffWriter(folder / "roll.tif") as writer:
        writer.write(np.hstack([one, two]), metadata=None)
        writer.write(two, metadata=None)
    return folder


def test_what_a_scan_shows_next_to_the_frame_that_was_measured_needs_attention(roll: Path) -> None:
    scan = measured_scan(scan_tasks(read_project(roll / "project.toml"), ["roll"])[0])
    finding = " ".join(scan.frame.problems)
    assert "2 pictures of full size (pages 1, 2), and page 1 was measured" in finding
    assert "shows a second frame" in finding or "shows another frame" in finding
    assert "in images.csv" in finding


def test_pages_and_windows_are_images_of_their_own(roll: Path, capsys: Capture, refusal: Refusal) -> None:
    """Their neighbours are in no rectified scan: the second page shows the second frame alone."""
    height, width = tifffile.imread(roll / "roll.tif", key=1).shape
    whole = roll / "whole.toml"
    whole.write_text((roll / "project.toml").read_text() + '[object]\nimages = "images.csv"\n')
    lines = [f"roll-a,1,0 0 {width} {height}", f"roll-b,1,{width} 0 {width} {height}", "roll-c,2,"]
    (roll / "images.csv").write_text("\n".join(["image,page,window", *lines]) + "\n")
    assert command("measure", whole) in (0, LOOK)
    rows = {(row.image, row.point): row for row in read_comparator(roll / "comparator.csv")}
    assert len(rows) == 3 * 4
    for image, number, shift_px in (("roll-a", 1, 0), ("roll-b", 2, width), ("roll-c", 2, 0)):
        for id, place in PLACES.items():
            row = rows[image, id]
            assert row.status is Status.MEASURED
            drawn = pixel_from_camera("0", 0.004 * number) @ (*place, 1.0) + (shift_px, 0.0)
            np.testing.assert_allclose(np.asarray(row.xy_mm) / 0.05 * (1, -1), drawn, atol=0.1)
    output = capsys.readouterr().out
    assert "second frame" not in output
    assert "pictures of full size" not in output
    assert command("resample", whole, roll / "frames", "--pitch-um", "50") in (0, LOOK)
    first, second, alone = (tifffile.imread(roll / "frames" / f"roll-{name}.tif") for name in "abc")
    assert second.shape == alone.shape
    middle = np.s_[10:-10, 10:-10]
    assert np.abs(second[middle].astype(float) - alone[middle]).max() < 0.02 * np.ptp(alone)
    assert max(np.subtract(first.shape, alone.shape)) < 8
    (roll / "images.csv").write_text("image,window\nother,0 0 10 10\n")
    assert "no scan is called as it begins" in refusal("measure", whole)
    (roll / "images.csv").write_text("image,window\nroll,0 0 0 10\n")
    assert '"col row width height" in px' in refusal("measure", whole)


@pytest.fixture(scope="module")
def store() -> Iterator[Any]:
    """A client of a store that runs here, with empty buckets."""
    boto3, fsspec = import_module("boto3"), import_module("fsspec")
    server = ThreadedMotoServer(port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("AWS_ENDPOINT_URL", f"http://{host}:{port}")
        for name, value in {"ACCESS_KEY_ID": "t", "SECRET_ACCESS_KEY": "t", "DEFAULT_REGION": "us-east-1"}.items():
            patch.setenv(f"AWS_{name}", value)
        fsspec.get_filesystem_class("s3").clear_instance_cache()
        client = boto3.client("s3")
        for bucket in ("prints", "boxes"):
            client.create_bucket(Bucket=bucket)
        yield client
    server.stop()


@pytest.fixture(scope="module")
def local(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_project(tmp_path_factory.mktemp("local"), ["a", "b"]).parent


def write_scan_project(folder: Path, scans: str) -> Path:
    write_project(folder, [], PROJECT.replace('"*.tif"', scans))
    return folder


def test_names_are_paths_and_contents_tell_copies(store: Any, local: Path, tmp_path: Path) -> None:
    for key, name in (("box/1/a.tif", "a"), ("box/2/a.tif", "b"), ("box/2/copy.tif", "b"), ("box/2/a.txt", "a")):
        store.upload_file(str(local / f"{name}.tif"), "prints", key)
    scans = read_project(write_scan_project(tmp_path, '"s3://prints/box/**/*.tif"') / "project.toml").scans
    assert {name: str(path) for name, path in scans.items()} == {
        "1/a": "s3://prints/box/1/a.tif",
        "2/a": "s3://prints/box/2/a.tif",
        "2/copy": "s3://prints/box/2/copy.tif",
    }
    states = {name: file_state(path, tmp_path) for name, path in scans.items()}
    assert states["2/a"].uri == "s3://prints/box/2/a.tif"
    assert states["2/a"].bytes == (local / "b.tif").stat().st_size
    assert states["2/a"].etag
    hashes = {name: parts_hash(path) for name, path in scans.items()}
    assert hashes["2/a"] == hashes["2/copy"] != hashes["1/a"]


def test_init_of_a_bucket(store: Any, local: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, key in (("a", "1952/a.tif"), ("b", "1952/sub/b.tif"), ("b", "1952/sub/copy.tif")):
        store.put_object(Bucket="boxes", Key=key, Body=(local / f"{name}.tif").read_bytes())
    store.put_object(Bucket="boxes", Key="1952/broken.tif", Body=b"no scan")
    store.put_object(Bucket="boxes", Key="1952/notes.txt", Body=b"by hand")

    def unnamed(grouped: Catalogue, *_: Any) -> Catalogue:
        return grouped

    monkeypatch.setattr("pipeline.archive.new_project.name_cameras", unnamed)
    assert command("init", "s3://boxes/1952/", "--out", tmp_path) == 1
    text = (tmp_path / "project.toml").read_text(encoding="utf-8")
    assert 'scans = ["s3://boxes/1952/**/*.tif"]' in text
    assert '# camera = "camera.toml"' in text  # which there is not yet
    (tmp_path / "project.toml").write_text(text.replace('# camera = "camera.toml"', 'camera = "camera.toml"'))
    (tmp_path / "camera.toml").write_text((local / "camera.toml").read_text(encoding="utf-8"), encoding="utf-8")
    scans = read_project(tmp_path / "project.toml").scans
    assert {name: str(path) for name, path in scans.items()} == {
        "a": "s3://boxes/1952/a.tif",
        "sub/b": "s3://boxes/1952/sub/b.tif",
    }
    assert command("init", "s3://nowhere/", "--out", tmp_path / "q") == 2


def test_a_bucket_without_scans_and_one_that_is_not_there(store: Any, tmp_path: Path) -> None:
    for pattern in ("s3://prints/nowhere/*.tif", "s3://no-such-bucket/*.tif"):
        with pytest.raises(InputError, match=r"scans.*finds no object.*Check the bucket|there is no s3://no-such"):
            read_project(write_scan_project(tmp_path, f'"{pattern}"') / "project.toml")


def test_a_closed_address_costs_no_other(
    local: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    monkeypatch.setattr(remote, "_WAITS_S", (0.01,))
    with range_server(local) as server:
        folder = write_scan_project(tmp_path, f'"{server.url}/a.tif", "{server.url}/closed/b.tif"')
        assert command("measure", folder / "project.toml", "--workers", "1") == 1
    with sqlite3.connect(folder / "out" / "measurement.db") as db:
        query = "select scan.name, detail ->> '$.failure.code' from result join scan on scan.id = result.scan"
        codes = dict(db.execute(query))
    assert codes == {"a": None, "closed/b": "unreachable"}
    assert "forbids to read it (403)" in capsys.readouterr().err


@pytest.mark.study
def test_credentials_are_reported_nowhere(
    local: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    """By two processes, which are given them. Another signature is the same scan; a wrong one is told without it."""
    monkeypatch.setattr(remote, "_WAITS_S", (0.01,))
    with range_server(local) as server:
        for signature, left in (("s3cr3t1", "2 to go"), ("s3cr3t2", "2 in earlier runs"), ("s3cr3t3", "")):
            server.signature = "s3cr3t2" if signature == "s3cr3t3" else signature
            url, query = server.url.replace("://", "://ann:hunter2@"), f"X-Amz-Date=1&X-Amz-Signature={signature}"
            folder = write_scan_project(tmp_path / "p", f'"{url}/a.tif?{query}", "{url}/b.tif?{query}"')
            code = command("measure", folder / "project.toml", "--workers", "2")
            captured = capsys.readouterr()
            assert f"scans measured ({left})" in captured.err or not left
            assert code == (0 if left else 2)  # where no scan can be read
            command("report", folder / "project.toml")
            command("status", folder / "project.toml", "--csv")
            after = capsys.readouterr()
            result = [captured.out, captured.err, after.out, after.err]
            result += [path.read_bytes().decode("latin-1") for path in folder.rglob("*") if path.is_file()]
            result = [text for text in result if "scans = [" not in text]  # the user's own file
            for secret in ("s3cr3t", "hunter2", "ann:"):
                assert not [text for text in result if secret in text], secret
    assert {mark.image for mark in read_comparator(folder / "comparator.csv")} == {"a", "b"}


@pytest.mark.parametrize(
    ("address", "shown"),
    [
        ("https://ann:pw@h.org/a.tif", "https://h.org/a.tif"),
        ("https://h.org/a.tif?X-Amz-Signature=1/2&X-Amz-Date=3", "https://h.org/a.tif"),
        ("https://h.org/a.tif?sv=1&sig=a%2Fb", "https://h.org/a.tif"),
        ("s3://key:secret@prints/a.tif", "s3://prints/a.tif"),
        ("HTTPS://h.org/a.tif#x", "https://h.org/a.tif"),
        ("scans/a@b?c.tif", "scans/a@b?c.tif"),
    ],
)
def test_what_is_shown_of_an_address(address: str, shown: str) -> None:
    assert remote.public_address(address) == shown
    assert remote.fetch_location(remote.scan_path(address)) == (address if "://" in address else shown)


def test_queries_that_tell_scans_apart_are_kept_and_no_text_shows_a_secret() -> None:
    one, two, again = (f"https://h.org/get?id={k}&token={token}" for k, token in ((1, "a"), (2, "a"), (1, "b")))
    assert remote.public_address(one) == remote.public_address(again) != remote.public_address(two)
    result = "'htps://ann:pw@h.org/a.tif?token=1' finds no file: /x/htps:/ann:pw@h.org/a.tif, tcp://host:8786"
    assert remote.public_text(result) == "'htps://h.org/a.tif' finds no file: /x/htps:/h.org/a.tif, tcp://host:8786"
