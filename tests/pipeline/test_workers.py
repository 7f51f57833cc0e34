"""Processes and clusters that measure: what is lost with a killed one, and when they end."""

import multiprocessing
import os
import signal
import subprocess
import sys
import time
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import pytest
from in_process import wait_until
from studies import parametrize_with_studies

from pipeline import InputError, workers
from pipeline.workers import LocalPool, SubmittedAgain, WorkerKilled, cluster_executor, worker_pool


def count_up(told: Path) -> None:
    """What never lets go of the interpreter for long, nor comes to an end."""
    told.write_text(str(os.getpid()))
    number = 0
    while True:
        number += 1


def wait_for_a_pipe(told: Path) -> None:
    """What waits for the operating system."""
    os.mkfifo(pipe := told.with_suffix(".pipe"))
    told.write_text(str(os.getpid()))
    pipe.open("rb").read()


KINDS = {work.__name__: work for work in (count_up, wait_for_a_pipe)}


def begin(kind: str, told: Path) -> None:
    with worker_pool(1) as workers:
        workers.submit(KINDS[kind], told)
        time.sleep(600.0)


@parametrize_with_studies("kind", KINDS)
def test_a_worker_ends_with_the_process_that_started_it(kind: str, tmp_path: Path) -> None:
    result = tmp_path / "pid"
    program = f"from pathlib import Path; from test_workers import begin; begin({kind!r}, Path({str(result)!r}))"
    paths = os.pathsep.join(sys.path)
    parent = subprocess.Popen([sys.executable, "-c", program], env=os.environ | {"PYTHONPATH": paths})
    assert wait_until(lambda: result.is_file() and result.read_text() != "", 120.0)
    worker = int(result.read_text())
    assert is_alive(worker)
    time.sleep(0.3)
    parent.send_signal(signal.SIGKILL)
    parent.wait()
    assert wait_until(lambda: not is_alive(worker), 60.0)


def is_alive(pid: int) -> bool:
    """Whether a process is there and no zombie that its new parent has not asked after yet."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return False
    return state != "Z"


def killed_times(times: int, folder: Path, number: int) -> int:
    """Ends its process the first times that it is called."""
    marks = len(list(folder.iterdir()))
    if marks < times:
        (folder / f"{marks}").touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def test_a_killed_process_is_replaced_and_its_task_begun_again(tmp_path: Path) -> None:
    """Killed without a task, and then with one. What a task raises is its own."""
    with worker_pool(2, workers=1) as pool:
        with pytest.raises(ValueError, match="invalid literal"):
            pool.submit(int, "a").result(60)
        first = pool.submit(os.getpid).result(60)
        os.kill(first, signal.SIGKILL)
        time.sleep(0.2)
        assert pool.submit(os.getpid).result(60) != first
        others = [pool.submit(abs, -number) for number in range(6)]
        assert pool.submit(killed_times, 1, tmp_path, 7).result(60) == 7
        assert [other.result(60) for other in others] == list(range(6))
        assert list(pool.map(abs, (-1, -2))) == [1, 2]


def test_a_script_without_a_guard_starts_the_workers_once(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(
        "import operator\nfrom pipeline.workers import worker_pool\n"
        "with worker_pool(1, workers=1) as pool:\n    print(pool.submit(operator.add, 2, 3).result(60))\n"
    )
    variables = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run([sys.executable, str(script)], env=variables, capture_output=True, text=True)
    assert (done.stdout, done.returncode) == ("5\n", 0), done.stderr


@pytest.mark.study
def test_a_task_that_kills_its_process_twice_is_given_up_and_none_else(tmp_path: Path) -> None:
    with worker_pool(2, workers=2) as pool:
        bad = pool.submit(killed_times, 99, tmp_path, 7)
        others = [pool.submit(abs, -number) for number in range(6)]
        with pytest.raises(WorkerKilled, match="its process was ended, most likely because the memory was full"):
            bad.result(60)
        assert [other.result(60) for other in others] == list(range(6))
    assert len(list(tmp_path.iterdir())) == 2


def half_sent() -> bytes:
    """Ends its process in the middle of the result."""

    def send_half(sender: Connection, content: bytes) -> None:
        os.write(sender.fileno(), content[: len(content) // 2])
        os._exit(1)

    Connection._send = send_half  # type: ignore[attr-defined]
    return bytes(1000)


def test_a_process_that_ends_in_the_middle_of_its_result_is_not_waited_for() -> None:
    with worker_pool(1, workers=1) as pool:
        with pytest.raises(WorkerKilled):
            pool.submit(half_sent).result(30)
        assert pool.submit(abs, -1).result(60) == 1


def test_a_process_killed_on_its_way_says_nothing_of_the_task(tmp_path: Path) -> None:
    with worker_pool(1, workers=1) as pool:
        killed = {pool.submit(os.getpid).result(60)}
        task = pool.submit(killed_times, 1, tmp_path, 7)
        for _ in range(2):
            while not (coming := [child for child in multiprocessing.active_children() if child.pid not in killed]):
                assert not task.done()
                time.sleep(0.001)
            killed.add(coming[0].pid or 0)
            coming[0].kill()
        assert task.result(60) == 7


def test_a_process_that_is_begun_while_the_pool_ends_is_ended_too(monkeypatch: pytest.MonkeyPatch) -> None:
    begin = LocalPool._start

    def late(pool: LocalPool) -> ProcessPoolExecutor:
        time.sleep(0.4)
        return begin(pool)

    def interrupted() -> None:
        with worker_pool(1, workers=1) as pool:
            pool.submit(time.sleep, 20.0)
            time.sleep(0.1)  # its thread has seen that the pool goes on
            raise KeyboardInterrupt

    monkeypatch.setattr(LocalPool, "_start", late)
    # A process of the calling program goes on.
    own = multiprocessing.get_context("spawn").Process(target=time.sleep, args=(60.0,), daemon=True)
    own.start()
    start = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert time.monotonic() - start < 15.0
    assert multiprocessing.active_children() == [own]
    own.kill()
    own.join()


def cluster_process(number: int, seconds: float = 0.0) -> tuple[int, int]:
    time.sleep(seconds)
    return number, os.getpid()


@pytest.mark.filterwarnings("ignore")
@pytest.mark.study
def test_a_killed_worker_loses_nothing_and_is_replaced(tmp_path: Path) -> None:
    (tmp_path / "scan.tif").write_bytes(b"scan")
    with cluster_executor("local", [str(tmp_path / "scan.tif")], workers=2) as executor:
        futures = [executor.submit(cluster_process, number, 0.03) for number in range(40)]
        first = futures[0].result(60)[1]
        os.kill(first, signal.SIGKILL)
        results = [future.result(60) for future in futures]
        assert [number for number, _ in results] == list(range(40))
        end, view = time.monotonic() + 60, set[int]()
        while len(view - {first}) < 2:
            assert time.monotonic() < end
            pair = [executor.submit(cluster_process, number, 0.05) for number in range(2)]  # one for each worker
            view = {future.result(60)[1] for future in pair}
        assert first not in view


@pytest.mark.filterwarnings("ignore")
def test_a_cluster_that_cannot_be_had_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers, "_ANSWER_S", 0.5)
    with pytest.raises(InputError, match="no scheduler answers there"), cluster_executor("tcp://127.0.0.1:9", []):
        pass
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InputError, match=r"reseau\[cluster\]"), cluster_executor("local", []):
        pass


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        (({"numpy": "1.0"}, []), "b: has numpy 1.0, here"),
        (({}, [("/1.tif", "No such file")]), r"b: cannot read /1.tif \(No such file\). Give it the same path"),
        (({}, [("s3://1.tif", "403")]), r"b: cannot read s3://1.tif \(403\). Give it the extra, the credentials"),
        (ModuleNotFoundError("pipeline"), "b: does not answer .*is reseau installed"),
    ],
)
def test_workers_are_requested_their_versions_and_their_way_to_the_scans(answer: Any, words: str) -> None:
    good: tuple[dict[str, str], list[tuple[str, str]]] = (workers.versions(), [])
    client = MagicMock(run=lambda *_, **__: {"a": good})
    workers._check_workers(client, "x", [])
    other = answer if isinstance(answer, Exception) else (good[0] | answer[0], answer[1])
    client = MagicMock(run=lambda *_, **__: {"a": good, "b": other})
    with pytest.raises(InputError, match=words):
        workers._check_workers(client, "x", [])


class LosesFirst(Executor):
    """The first tasks that it is given."""

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


@pytest.mark.filterwarnings("ignore")
def test_what_an_executor_loses_is_submitted_again_once() -> None:
    assert SubmittedAgain(LosesFirst(1)).submit(cluster_process, 3).result()[0] == 3
    with pytest.raises(WorkerKilled):
        SubmittedAgain(LosesFirst(2)).submit(cluster_process, 3).result()
