"""A cluster measures as one machine does; a worker that is killed loses nothing and is replaced."""

import os
import signal
import sys
import time
from concurrent.futures import Executor, Future
from pathlib import Path
from typing import Any

import pytest
from range_server import range_server

from pipeline import workers
from pipeline.errors import InputError
from pipeline.workers import SubmittedAgain, WorkerKilled, cluster_executor

pytestmark = pytest.mark.filterwarnings("ignore")  # Dask's own, of what it closes


def process(number: int, seconds: float = 0.0) -> tuple[int, int]:
    time.sleep(seconds)
    return number, os.getpid()


@pytest.mark.study
def test_a_killed_worker_loses_nothing_and_is_replaced(tmp_path: Path) -> None:
    (tmp_path / "scan.tif").write_bytes(b"scan")
    with cluster_executor("local", [str(tmp_path / "scan.tif")], workers=2) as executor:
        futures = [executor.submit(process, number, 0.03) for number in range(40)]
        first = futures[0].result(60)[1]
        os.kill(first, signal.SIGKILL)
        results = [future.result(60) for future in futures]
        assert [number for number, _ in results] == list(range(40))
        end, view = time.monotonic() + 60, set[int]()
        while len(view - {first}) < 2:
            assert time.monotonic() < end
            pair = [executor.submit(process, number, 0.05) for number in range(2)]  # one for each worker
            view = {future.result(60)[1] for future in pair}
        assert first not in view


def test_without_dask_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InputError, match=r"reseau\[cluster\]"), cluster_executor("local", []):
        pass


def test_a_scheduler_that_does_not_answer_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers, "_ANSWER_S", 0.5)
    with pytest.raises(InputError, match="no scheduler answers there"), cluster_executor("tcp://127.0.0.1:9", []):
        pass


class Answers:
    """A client whose workers answer so."""

    def __init__(self, answers: dict[str, Any]) -> None:
        self.answers = answers

    def wait_for_workers(self, *_: Any, **__: Any) -> None:
        pass

    def run(self, *_: Any, **__: Any) -> dict[str, Any]:
        return self.answers


def test_workers_are_requested_their_versions_and_their_way_to_the_scans() -> None:
    same = workers.versions()
    good = (same, list[tuple[str, str]]())
    workers._check_workers(Answers({"a": good}), "x", [])
    other = ({**same, "numpy": "1.0"}, list[tuple[str, str]]())
    cases = {
        "b: has numpy 1.0, here": other,
        r"b: cannot read /scans/1.tif \(No such file\). Give it the same path": (
            same,
            [("/scans/1.tif", "No such file")],
        ),
        r"b: cannot read s3://x/1.tif \(403\). Give it the extra, the credentials": (same, [("s3://x/1.tif", "403")]),
        "b: does not answer .*is reseau installed": ModuleNotFoundError("pipeline"),
    }
    for words, answer in cases.items():
        with pytest.raises(InputError, match=words):
            workers._check_workers(Answers({"a": good, "b": answer}), "x", [])


def test_one_scan_a_folder_is_inspected_for(tmp_path: Path) -> None:
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        for name in "12":
            (tmp_path / folder / name).write_bytes(b"1")
    scans = [str(tmp_path / place) for place in ("a/0", "a/1", "a/2", "b/1", "c/1")]
    assert workers._one_a_folder([*scans, ""]) == [str(tmp_path / "a/1"), str(tmp_path / "b/1")]


def test_addresses_are_inspected_for_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("measure.scans.remote._WAITS_S", (0.01,))
    for name in ("a/1.tif", "a/2.tif", "closed/1.tif", "closed/2.tif"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"1")
    with range_server(tmp_path) as server:
        scans = [f"{server.url}/{name}" for name in ("closed/1.tif", "a/1.tif", "closed/2.tif", "a/2.tif")]
        assert workers._one_a_folder(scans) == [f"{server.url}/a/1.tif"]
        _, missing = workers._versions_and_unreachable(scans[:2])
        ((scan, why),) = missing
    assert scan == scans[0]
    assert "forbids to read it (403)" in why


class Loses(Executor):
    """Loses the first tasks that it is given."""

    def __init__(self, times: int) -> None:
        self.times = times

    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        self.times -= 1
        if self.times >= 0:
            future.set_exception(ValueError("not enough values to unpack"))
        else:
            future.set_result(fn(*args, **kwargs))
        return future


def test_what_an_executor_loses_is_submitted_again_once() -> None:
    assert SubmittedAgain(Loses(1)).submit(process, 3).result()[0] == 3
    with pytest.raises(WorkerKilled):
        SubmittedAgain(Loses(2)).submit(process, 3).result()
