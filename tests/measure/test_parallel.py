"""Work shared among threads: in its order, by as many as OpenCV may use, and with the same result as by one."""

import threading
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from measure import Scan
from measure.scans.cache import WholePicture
from measure.scans.metadata import NO_TAGS
from measure.scans.parallel import map_in_threads, map_or_replace
from measure.targets.detection import DiskSearch, disk_candidates


@pytest.fixture(autouse=True)
def _threads_as_before() -> Iterator[None]:
    threads = cv2.getNumThreads()
    yield
    cv2.setNumThreads(threads)


@pytest.mark.parametrize("threads", [1, 3])
def test_every_item_is_worked_on_in_its_order_while_opencvs_threads_rest(threads: int) -> None:
    """All threads are at work at once: each waits for the others."""
    cv2.setNumThreads(threads)
    all_there = threading.Barrier(threads)

    def view(item: int) -> tuple[int, int, int]:
        all_there.wait(60.0)
        return item, threading.get_ident(), cv2.getNumThreads()

    found = map_in_threads(view, range(6))
    assert [item for item, _, _ in found] == list(range(6))
    assert len({thread for _, thread, _ in found}) == threads
    assert {own for _, _, own in found} == {1}
    assert cv2.getNumThreads() == threads


def test_any_number_of_threads_finds_the_same_disks() -> None:
    rng = np.random.default_rng(1)
    grey = rng.normal(20000.0, 300.0, (700, 900)).astype(np.float32)
    places = [(col, row) for row in range(60, 700, 120) for col in range(60, 900, 120)]
    for place in places:
        cv2.circle(grey, place, 8, 40000.0, -1)
    picture = cv2.GaussianBlur(grey, (0, 0), 1.0).astype(np.uint16)
    found = []
    for threads in (1, 3):
        cv2.setNumThreads(threads)
        scan = Scan(Path("disks.tif"), WholePicture(picture[:, :, None]), NO_TAGS)
        found.append(disk_candidates(scan, DiskSearch((10.0, 24.0), "light", 0.2)))
    one, other = (np.array([disk.center_px for disk in disks]) for disks in found)
    assert len(one) == len(places)
    np.testing.assert_array_equal(one, other)


class EndedOver(ThreadPoolExecutor):
    """Workers that are ended over one item, in whichever part it comes."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        if 5 in args[1]:
            raise BrokenExecutor("its process was ended")
        return super().submit(fn, *args, **kwargs)


@pytest.mark.parametrize("chunk", [1, 4])
def test_an_item_that_its_worker_is_ended_over_costs_none_of_the_others(chunk: int) -> None:
    def lost(item: int, why: str) -> str:
        return f"{item}: {why}"

    with EndedOver(2) as workers:
        found = list(map_or_replace(workers, str, range(9), lost, chunk))
    assert found == ["0", "1", "2", "3", "4", "5: its process was ended", "6", "7", "8"]
