"""Recovery from kill -9 of the parent and of workers at random moments of a run of 200 stand-in scans.

At the end the results database is compared with that of an undisturbed run, except for times, and the scans that were
started more than once are counted.
"""

import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

from benchmarks.archive_stand_ins import USE, write_project
from benchmarks.harness import ROOT, START, Row, table
from pipeline.archive.checked_results import latest
from pipeline.archive.results_database import ResultsDatabase
from pipeline.results.measured_record import mark_row, scan_detail

_SCANS, _SCAN_S, _WORKERS = 200, 0.2, 2


def case(kills: int = 50, seed: int = 1) -> Row:
    rng = random.Random(seed)
    with TemporaryDirectory() as place:
        calm, wild = Path(place) / "calm", Path(place) / "wild"
        calm.mkdir()
        write_project(calm, _SCANS)
        shutil.copytree(calm, wild)
        started(calm).wait()
        total: Counter[str] = Counter()
        runs = []
        while total["parent"] + total["worker"] < kills:
            shutil.rmtree(wild / "out", ignore_errors=True)
            (wild / "starts").write_text("", encoding="utf-8")
            done = measured_to_its_end(wild, rng)
            starts = Counter((wild / "starts").read_text(encoding="utf-8").split())
            total += done
            runs.append({
                "of the parent": done["parent"], "of workers": done["worker"],
                "results equal": content(wild) == content(calm), "marks equal": marks(wild) == marks(calm),
                "begun again": starts.total() - len(starts),
                "in hand when killed": _WORKERS * done["parent"] + done["worker"],
            })  # fmt: skip
    return {"runs": runs, "kills": dict(total)}


def report(rows: list[Row]) -> Iterator[str]:
    for row in rows:
        yield from table(dict.fromkeys(row["runs"][0], ""), row["runs"])
        yield f"in all {row['kills']}"


def measured_to_its_end(folder: Path, rng: random.Random) -> Counter[str]:
    """Run the measurement, restarted after each kill of the parent, until it ends by itself; returns the numbers of
    kills."""
    done: Counter[str] = Counter()
    while True:
        process = started(folder)
        while process.poll() is None:
            after = time.monotonic() + rng.uniform(1.0, 12.0)
            while time.monotonic() < after and process.poll() is None:
                time.sleep(0.02)
            whom = rng.choice(("parent", "worker"))
            victims = [process.pid] if whom == "parent" else workers(process.pid)
            if process.poll() is None and victims:
                os.kill(rng.choice(victims), signal.SIGKILL)
                done[whom] += 1
                if whom == "parent":
                    process.wait()
        if process.returncode in (0, 1):
            return done


def started(folder: Path) -> "subprocess.Popen[bytes]":
    environment = os.environ | {"RESEAU_STAND_IN_S": str(_SCAN_S), "RESEAU_STAND_IN_LOG": str(folder / "starts")}
    arguments = ["measure", str(folder / "project.toml"), "--workers", str(_WORKERS)]
    command = [sys.executable, "-c", f"{USE}; {START}", *arguments]
    return subprocess.Popen(command, cwd=ROOT, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def workers(parent: int) -> list[int]:
    """Process ids of the workers of a parent."""
    children = Path(f"/proc/{parent}/task/{parent}/children")
    threads = Path(f"/proc/{parent}/task").glob("*/children") if children.exists() else ()
    pids = [int(pid) for file in threads for pid in file.read_text(encoding="ascii").split()]
    return [pid for pid in pids if b"spawn_main" in Path(f"/proc/{pid}/cmdline").read_bytes()]


def content(folder: Path) -> list[str]:
    with ResultsDatabase(folder / "out" / "measurement.db") as database:
        check_run = latest(database)
        assert check_run is not None
        keys = sorted(database.fingerprints())
        scans = check_run.scans()
        return [*keys, *(f"{scan_detail(scan, '')} {list(map(mark_row, scan.frame.marks))}" for scan in scans)]


def marks(folder: Path) -> bytes:
    return (folder / "comparator.csv").read_bytes()
