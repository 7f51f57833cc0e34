"""A project of scans in an object store or on a server gives the rows of the same scans on the disk."""

import sqlite3
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
from drawn_project import PROJECT, write_project
from moto.server import ThreadedMotoServer
from range_server import range_server

from measure.scans import remote
from pipeline.archive.scan_groups import GroupedScans
from pipeline.cli import run
from pipeline.errors import InputError
from pipeline.files.project_file import read_project
from pipeline.provenance import file_state, parts_hash


@pytest.fixture(scope="module")
def store() -> Iterator[Any]:
    """A client of a store that runs here, with an empty bucket `prints`."""
    boto3, fsspec = import_module("boto3"), import_module("fsspec")
    server = ThreadedMotoServer(port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("AWS_ENDPOINT_URL", f"http://{host}:{port}")
        patch.setenv("AWS_ACCESS_KEY_ID", "test")
        patch.setenv("AWS_SECRET_ACCESS_KEY", "test")
        patch.setenv("AWS_DEFAULT_REGION", "us-east-1")
        fsspec.get_filesystem_class("s3").clear_instance_cache()
        client = boto3.client("s3")
        client.create_bucket(Bucket="prints")
        client.create_bucket(Bucket="boxes")
        yield client
    server.stop()


@pytest.fixture(scope="module")
def local(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("local")
    write_project(folder, ["a", "b"])
    return folder


def write_scan_project(folder: Path, scans: str) -> Path:
    write_project(folder, [], PROJECT.replace('"*.tif"', scans))
    return folder


def measure_picture(folder: Path, *options: str) -> int:
    return run(["measure", str(folder / "project.toml"), *options])


def rows(folder: Path) -> list[str]:
    lines = (folder / "comparator.csv").read_text(encoding="utf-8").splitlines()
    return [line for line in lines if not line.startswith("#")]


@pytest.mark.study
def test_a_bucket_and_a_server_give_the_rows_of_the_disk(
    store: Any, local: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert measure_picture(local) == 0
    for name in ("a", "b"):
        store.upload_file(str(local / f"{name}.tif"), "prints", f"1952/{name}.tif")
    bucket = write_scan_project(tmp_path / "bucket", '"s3://prints/1952/*.tif"')
    assert measure_picture(bucket) == 0
    assert rows(bucket) == rows(local)
    with range_server(local) as server:
        named = write_scan_project(tmp_path / "named", f'"{server.url}/a.tif", "{server.url}/b.tif"')
        assert measure_picture(named) == 0
    assert rows(named) == rows(local)
    capsys.readouterr()
    assert measure_picture(bucket) == 0
    assert "2 of 2 scans measured already" in capsys.readouterr().err


def test_names_are_those_below_the_common_folder_and_contents_tell_copies(
    store: Any, local: Path, tmp_path: Path
) -> None:
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


def test_init_makes_a_project_of_a_bucket(
    store: Any, local: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, key in (("a", "1952/a.tif"), ("b", "1952/sub/b.tif"), ("b", "1952/sub/copy.tif")):
        store.put_object(Bucket="boxes", Key=key, Body=(local / f"{name}.tif").read_bytes())
    store.put_object(Bucket="boxes", Key="1952/broken.tif", Body=b"no scan")
    store.put_object(Bucket="boxes", Key="1952/notes.txt", Body=b"by hand")

    def unnamed(grouped: GroupedScans, *_: Any) -> GroupedScans:
        return grouped

    monkeypatch.setattr("pipeline.archive.new_project.name_cameras", unnamed)
    assert run(["init", "s3://boxes/1952/", "--out", str(tmp_path)]) == 1
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
    assert run(["init", "s3://nowhere/", "--out", str(tmp_path / "q")]) == 2


def test_a_bucket_without_scans_and_one_that_is_not_there(store: Any, tmp_path: Path) -> None:
    for pattern in ("s3://prints/nowhere/*.tif", "s3://no-such-bucket/*.tif"):
        with pytest.raises(InputError, match=r"scans.*finds no object.*Check the bucket|there is no s3://no-such"):
            read_project(write_scan_project(tmp_path, f'"{pattern}"') / "project.toml")


def test_an_address_that_does_not_answer_costs_the_others_nothing(
    local: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(remote, "_WAITS_S", (0.01,))
    with range_server(local) as server:
        folder = write_scan_project(tmp_path, f'"{server.url}/a.tif", "{server.url}/closed/b.tif"')
        assert measure_picture(folder, "--workers", "1") == 1
    with sqlite3.connect(folder / "out" / "measurement.db") as db:
        query = "select scan.name, detail ->> '$.failure.code' from result join scan on scan.id = result.scan"
        codes = dict(db.execute(query))
    assert codes == {"a": None, "closed/b": "unreachable"}
    assert "forbids to read it (403)" in capsys.readouterr().err


@pytest.mark.study
def test_credentials_and_signatures_are_used_and_reported_nowhere(
    local: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """By two processes, which are given them. Another signature is the same scan; a wrong one is told without it."""
    monkeypatch.setattr(remote, "_WAITS_S", (0.01,))
    with range_server(local) as server:
        for signature, left in (("s3cr3t1", "0 of 2"), ("s3cr3t2", "2 of 2"), ("s3cr3t3", "")):
            server.signature = "s3cr3t2" if signature == "s3cr3t3" else signature
            url, query = server.url.replace("://", "://ann:hunter2@"), f"X-Amz-Date=1&X-Amz-Signature={signature}"
            folder = write_scan_project(tmp_path / "p", f'"{url}/a.tif?{query}", "{url}/b.tif?{query}"')
            code = measure_picture(folder, "--workers", "2")
            captured = capsys.readouterr()
            assert f"{left} scans measured already" in captured.err or not left
            assert code == (0 if left else 2)  # where no scan can be read
            run(["report", str(folder / "project.toml")])
            run(["status", str(folder / "project.toml"), "--csv"])
            after = capsys.readouterr()
            result = [captured.out, captured.err, after.out, after.err]
            result += [path.read_bytes().decode("latin-1") for path in folder.rglob("*") if path.is_file()]
            result = [text for text in result if "scans = [" not in text]  # the user's own file
            for secret in ("s3cr3t", "hunter2", "ann:"):
                assert not [text for text in result if secret in text], secret
    assert {row.partition(",")[0] for row in rows(folder)[1:]} == {"a", "b"}


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


def test_scans_that_a_query_tells_apart_are_two() -> None:
    one, two, again = (f"https://h.org/get?id={k}&token={token}" for k, token in ((1, "a"), (2, "a"), (1, "b")))
    assert remote.public_address(one) == remote.public_address(again) != remote.public_address(two)


def test_a_text_is_shown_without_what_opens_its_addresses() -> None:
    result = "'htps://ann:pw@h.org/a.tif?token=1' finds no file: /x/htps:/ann:pw@h.org/a.tif, tcp://host:8786"
    assert remote.public_text(result) == "'htps://h.org/a.tif' finds no file: /x/htps:/h.org/a.tif, tcp://host:8786"
