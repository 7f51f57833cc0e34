"""Whatever ends a command, earlier results are whole or complete new ones are there, and no process is left."""

import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import pytest
from projects import replace_text, scan_content

from pipeline.cli import run

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
    return {name: result for name, file in left.items() if (result := scan_content(file))}


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


SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)


def counted(old: Path, folder: Path, command: str, trials: int, whoms: tuple[Whom, ...], seed: int) -> Counter[str]:
    """How so many trials ended. old: a project whose results are of other input than it has now."""
    rng = random.Random(seed)
    earlier = state(old)
    seconds, complete = time_command(old, folder / "trial", command)
    assert complete.keys() >= earlier.keys() - {"out/check.json", "out/report.html"}
    assert all(complete[name] != earlier[name] for name in ("out/adjustment.json", "out/adjustment.npz"))
    found: Counter[str] = Counter()
    for number in range(trials):
        whom, sign = whoms[number % len(whoms)], SIGNALS[number // len(whoms) % len(SIGNALS)]
        after_s = rng.uniform(0.0, 1.1 * seconds if whom == "parent" else 0.5 * seconds)
        ended = trial(old, folder / "trial", command, sign, whom, after_s)
        left = "earlier" if ended.state == earlier else "complete" if ended.state == complete else "mixed"
        kind = "ended before" if ended.before else f"{sign.name} to the {whom}"
        found[f"{kind}: {left}"] += 1
        if ended.processes:
            found[f"WRONG, processes left: {kind} after {after_s:.1f} s"] += 1
        if not ended.in_time:
            found[f"WRONG, not ended in time: {kind} after {after_s:.1f} s"] += 1
        if left == "mixed":
            names = [name for name in complete if ended.state.get(name) != complete[name]]
            found[f"WRONG, {kind} after {after_s:.1f} s: earlier {names}"] += 1
        shutil.rmtree(folder / "trial")
    return found


def changed(project: Path) -> None:
    """Other input than the results were made from."""
    replace_text(project.with_name("camera.toml"), "principal_distance_mm = 1.0", "principal_distance_mm = 0.5")


@pytest.mark.study
def test_two_hundred_kills(rendered_demo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    old = tmp_path / "old"
    shutil.copytree(rendered_demo, old)
    project = old / "project.toml"
    replace_text(project, ', "scans/frame3.tif"', "")
    assert run(["run", str(project)]) in (0, 1)
    changed(project)
    project.write_text(f"pitch_um = 45.001\n{project.read_text(encoding='utf-8')}", encoding="utf-8")  # other places
    found = counted(old, tmp_path, "run", 200, ("parent", "worker"), 2)
    with capsys.disabled():
        print("\n" + "\n".join(f"{number:4d}  {what}" for what, number in sorted(found.items())))
    assert not [what for what in found if "WRONG" in what]
