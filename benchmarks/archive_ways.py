"""The same scans measured in one process, in two shards that are merged, and by a Dask cluster of which a worker is
killed: whether comparator.csv is the same, byte for byte.

    python -m benchmarks archive_ways [SCANS]
"""

import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

from benchmarks.archive_kills import workers
from benchmarks.archive_real import draw, results

_SIDE_PX = 1200


def main(scans: int) -> None:
    with TemporaryDirectory() as place:
        first = Path(place) / "one process"
        draw(first, scans, _SIDE_PX)
        for name in ("two shards", "cluster"):
            shutil.copytree(first, Path(place) / name)
        command(first, "measure", "--workers", "1").wait()
        print(f"{scans} scans; measured in one process: {results(first)}", flush=True)
        shards = Path(place) / "two shards"
        for part in ("1/2", "2/2"):
            command(shards, "measure", "--shard", part, "--workers", "1").wait()
        command(shards, "merge", *(str(shards / "out" / f"measurement.{k}-of-2.db") for k in (1, 2))).wait()
        told(shards, first, results(shards))
        cluster = Path(place) / "cluster"
        process = command(cluster, "measure", "--cluster", "local", "--workers", "2")
        killed = kill_one(process, cluster, scans // 3)
        process.wait()
        told(cluster, first, results(cluster))
        print(f"a worker of the cluster was killed after {killed} scans" if killed else "no worker was killed")


def command(folder: Path, name: str, *more: str) -> "subprocess.Popen[bytes]":
    own = [sys.executable, "-c", "from pipeline.main import main; main()", name, str(folder / "project.toml"), *more]
    return subprocess.Popen(own, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def kill_one(process: "subprocess.Popen[bytes]", folder: Path, after: int) -> int:
    """Kill a worker once so many scans are kept, and say how many there were; 0 where there was none to kill."""
    while process.poll() is None:
        if (kept := results(folder)) >= after and (victims := workers(process.pid)):
            os.kill(random.Random(1).choice(victims), signal.SIGKILL)
            return kept
        time.sleep(0.05)
    return 0


def told(folder: Path, first: Path, measured: int) -> None:
    same = (folder / "comparator.csv").read_bytes() == (first / "comparator.csv").read_bytes()
    print(f"{folder.name}: {measured} measured, comparator.csv is the same byte for byte: {same}", flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 24)
