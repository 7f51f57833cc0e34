"""The processes that measure end with the one that started them, whatever they do and however it ends."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from pipeline.workers import worker_pool

WAIT_S = 60.0


def count_up(told: Path) -> None:
    """What never lets go of the interpreter for long, nor comes to an end."""
    told.write_text(str(os.getpid()), encoding="utf-8")
    number = 0
    while True:
        number += 1


def factorise(told: Path) -> None:
    """What is almost always in a library."""
    told.write_text(str(os.getpid()), encoding="utf-8")
    matrix = np.random.default_rng(1).normal(size=(1500, 1500))
    while True:
        np.linalg.svd(matrix)


def wait_for_a_pipe(told: Path) -> None:
    """What waits for the operating system."""
    os.mkfifo(pipe := told.with_suffix(".pipe"))
    told.write_text(str(os.getpid()), encoding="utf-8")
    pipe.open("rb").read()


def rest(told: Path) -> None:
    """A process without work."""
    told.write_text(str(os.getpid()), encoding="utf-8")


KINDS = {work.__name__: work for work in (count_up, factorise, wait_for_a_pipe, rest)}


def begin(kind: str, told: Path) -> None:
    with worker_pool(1) as workers:
        workers.submit(KINDS[kind], told)
        time.sleep(600.0)


@pytest.mark.parametrize("kind", KINDS)
def test_a_worker_ends_with_the_process_that_started_it(kind: str, tmp_path: Path) -> None:
    result = tmp_path / "pid"
    program = f"from pathlib import Path; from test_workers import begin; begin({kind!r}, Path({str(result)!r}))"
    paths = os.pathsep.join([str(Path(__file__).parent), str(Path(__file__).parents[2])])
    parent = subprocess.Popen([sys.executable, "-c", program], env=os.environ | {"PYTHONPATH": paths})
    _wait(lambda: result.is_file() and result.read_text(encoding="utf-8") != "", 120.0)
    worker = int(result.read_text(encoding="utf-8"))
    assert is_alive(worker)
    time.sleep(0.3)
    parent.send_signal(signal.SIGKILL)
    parent.wait()
    _wait(lambda: not is_alive(worker), WAIT_S)


def _wait(holds: Callable[[], bool], most_s: float) -> None:
    end = time.monotonic() + most_s
    while not holds():
        assert time.monotonic() < end
        time.sleep(0.05)


def is_alive(pid: int) -> bool:
    """Whether a process is there and no zombie that its new parent has not asked after yet."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return False
    return state != "Z"
