"""Commands that are ended at random moments, and what they leave: files, and processes."""

import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from kept_scans import content

END_S = 5.0  # within which every process is to be gone
LONGEST_S = 300.0
Whom = Literal["parent", "worker"]
State = dict[str, bytes]


@dataclass(frozen=True)
class Ended:
    """One trial: what stands in the folder, and what was left running END_S after the command's own end.

    in_time: whether a parent that was asked to end did so within END_S.
    """

    state: State
    processes: tuple[int, ...]
    in_time: bool
    before: bool


def state(folder: Path) -> State:
    """The results in a project's folder; what begins with a point has not taken its place."""
    files = [folder / "comparator.csv", *sorted((folder / "out").rglob("*"))]
    names = {str(file.relative_to(folder)): file for file in files if file.is_file()}
    left = {name: file for name, file in names.items() if "/." not in name and not name.endswith(("-wal", "-shm"))}
    return {name: result for name, file in left.items() if (result := content(file))}


def started(folder: Path, command: str) -> subprocess.Popen[bytes]:
    # What is started in the background of a shell inherits that it hears no interrupt.
    heard = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)"
    program = f"{heard}; from pipeline.main import main; main()"
    return subprocess.Popen(
        [sys.executable, "-c", program, command, str(folder / "project.toml")],
        start_new_session=True,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )


def time_command(source: Path, folder: Path, command: str) -> tuple[float, State]:
    """How long the command takes when nobody ends it, and its results. folder: for now; the report has its name."""
    shutil.copytree(source, folder)
    start = time.monotonic()
    started(folder, command).wait(LONGEST_S)
    seconds, results = time.monotonic() - start, state(folder)
    shutil.rmtree(folder)
    return seconds, results


def trial(source: Path, folder: Path, command: str, sign: signal.Signals, whom: Whom, after_s: float) -> Ended:
    """A copy of a project in which the command is begun, and one of its processes ended after so many seconds (of a
    worker: after the first is there)."""
    shutil.copytree(source, folder)
    parent = started(folder, command)
    if whom == "worker":
        _wait(lambda: bool(_workers(parent.pid)) or parent.poll() is not None, LONGEST_S)
    _wait(lambda: parent.poll() is not None, after_s)
    before = parent.poll() is not None
    requests = time.monotonic()
    targets = [parent.pid] if whom == "parent" else _workers(parent.pid)
    if targets and not before:
        os.kill(random.Random(after_s).choice(targets), sign)
    else:
        before = True
    parent.wait(LONGEST_S)
    in_time = whom == "worker" or before or time.monotonic() - requests < END_S
    _wait(lambda: not _session(parent.pid), END_S)
    left = _session(parent.pid)
    for pid in left:
        os.kill(pid, signal.SIGKILL)
    return Ended(state(folder), tuple(left), in_time, before)


def _wait(holds: Callable[[], bool], most_s: float) -> None:
    end = time.monotonic() + most_s
    while time.monotonic() < end and not holds():
        time.sleep(0.02)


def _workers(parent: int) -> list[int]:
    """The processes that measure, of a command."""
    return [
        pid
        for pid, fields in _processes()
        if fields[1] == parent and b"spawn_main" in (Path(f"/proc/{pid}/cmdline").read_bytes() if _is(pid) else b"")
    ]


def _session(leader: int) -> list[int]:
    return [pid for pid, fields in _processes() if fields[3] == leader]


def _is(pid: int) -> bool:
    return Path(f"/proc/{pid}/cmdline").exists()


def _processes() -> list[tuple[int, list[int]]]:
    """Every process that is no zombie, with what follows its name in /proc: state, parent, group, session."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                text = (entry / "stat").read_text(encoding="utf-8", errors="replace").rpartition(")")[2].split()
            except OSError:
                continue
            if text[0] != "Z":
                found.append((int(entry.name), [0, *map(int, text[1:4])]))
    return found
