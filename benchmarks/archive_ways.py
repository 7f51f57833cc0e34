"""The same scans measured in one process, in two merged shards, and by a Dask cluster with one worker killed: whether
comparator.csv is identical.
"""

import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

from benchmarks.archive_kills import workers
from benchmarks.archive_real import draw, results
from benchmarks.harness import START, Row

_SIDE_PX = 1200


COLUMNS = {"way": "", "measured": "d", "killed after": "d", "the same bytes": ""}


def cells() -> Iterator[Row]:
    yield from ({"way": way} for way in ("two shards", "cluster"))


def case(way: str, scans: int = 24) -> Row:
    with TemporaryDirectory() as place:
        first, folder = Path(place) / "one process", Path(place) / "other"
        draw(first, scans, _SIDE_PX)
        shutil.copytree(first, folder)
        command(first, "measure", "--workers", "1").wait()
        killed = None
        if way == "two shards":
            for part in ("1/2", "2/2"):
                command(folder, "measure", "--shard", part, "--workers", "1").wait()
            command(folder, "merge", *(str(folder / "out" / f"measurement.{k}-of-2.db") for k in (1, 2))).wait()
        else:
            process = command(folder, "measure", "--cluster", "local", "--workers", "2")
            killed = kill_one(process, folder, scans // 3)
            process.wait()
        same = (folder / "comparator.csv").read_bytes() == (first / "comparator.csv").read_bytes()
        return {"measured": results(folder), "killed after": killed, "the same bytes": str(same)}


def command(folder: Path, name: str, *more: str) -> "subprocess.Popen[bytes]":
    own = [sys.executable, "-c", START, name, str(folder / "project.toml"), *more]
    return subprocess.Popen(own, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def kill_one(process: "subprocess.Popen[bytes]", folder: Path, after: int) -> int:
    """Kill a worker once `after` scans are stored; returns the number stored, 0 if no worker was killed."""
    while process.poll() is None:
        if (kept := results(folder)) >= after and (victims := workers(process.pid)):
            os.kill(random.Random(1).choice(victims), signal.SIGKILL)
            return kept
        time.sleep(0.05)
    return 0
