"""A process that is killed costs its own scan at most, and only when it is killed with it again."""

import multiprocessing
import os
import signal
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import pytest

from pipeline.workers import LocalPool, WorkerKilled, worker_pool


def square(number: int) -> int:
    return number * number


def killed_times(times: int, folder: Path, number: int) -> int:
    """Ends its process the first times that it is called."""
    marks = len(list(folder.iterdir()))
    if marks < times:
        (folder / f"{marks}").touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def process() -> int:
    return os.getpid()


def test_a_killed_process_is_replaced_and_its_task_begun_again(tmp_path: Path) -> None:
    with worker_pool(2, workers=2) as pool:
        others = [pool.submit(square, number) for number in range(6)]
        assert pool.submit(killed_times, 1, tmp_path, 7).result(60) == 7
        assert [other.result(60) for other in others] == [0, 1, 4, 9, 16, 25]
        assert list(pool.map(square, range(4))) == [0, 1, 4, 9]


@pytest.mark.study
def test_a_task_that_kills_its_process_twice_is_given_up_and_none_else(tmp_path: Path) -> None:
    with worker_pool(2, workers=2) as pool:
        bad = pool.submit(killed_times, 99, tmp_path, 7)
        others = [pool.submit(square, number) for number in range(6)]
        with pytest.raises(WorkerKilled, match="its process was ended, most likely because the memory was full"):
            bad.result(60)
        assert [other.result(60) for other in others] == [0, 1, 4, 9, 16, 25]
    assert len(list(tmp_path.iterdir())) == 2


def test_a_process_killed_without_a_task_is_replaced() -> None:
    with worker_pool(1, workers=1) as pool:
        first = pool.submit(process).result(60)
        os.kill(first, signal.SIGKILL)
        time.sleep(0.2)
        assert pool.submit(process).result(60) != first


def test_a_process_killed_on_its_way_says_nothing_of_the_task(tmp_path: Path) -> None:
    with worker_pool(1, workers=1) as pool:
        killed = {pool.submit(process).result(60)}
        task = pool.submit(killed_times, 1, tmp_path, 7)
        for _ in range(2):
            while not (coming := [child for child in multiprocessing.active_children() if child.pid not in killed]):
                assert not task.done()
                time.sleep(0.001)
            killed.add(coming[0].pid or 0)
            coming[0].kill()
        assert task.result(60) == 7


@pytest.mark.study
def test_where_no_process_stands_tasks_are_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pipeline.workers.prepare", os.abort)
    with worker_pool(1, workers=1) as pool:
        for task in [pool.submit(square, number) for number in range(2)]:
            with pytest.raises(WorkerKilled):
                task.result(60)


def test_what_a_task_raises_is_its_own() -> None:
    with worker_pool(1, workers=1) as pool:
        with pytest.raises(ValueError, match="invalid literal"):
            pool.submit(int, "a").result(60)
        assert pool.submit(square, 3).result(60) == 9


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
    start = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert time.monotonic() - start < 15.0
    assert not multiprocessing.active_children()
