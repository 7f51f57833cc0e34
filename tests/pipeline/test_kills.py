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

import pytest
from projects import Capture, replace_text, scan_content

from pipeline.cli import run

END_S = 5.0  # within which every process is to be gone
LONGEST_S = 300.0
State = dict[str, bytes]


@dataclass(frozen=True)
class Ended:
    """What stands in the folder, what runs END_S after the command's end, and whether it ended within END_S."""

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


def kill(source: Path, folder: Path, command: str, sign: signal.Signals, after_s: float) -> Ended:
    """A copy of a project in which the command is begun, and ended after so many seconds."""
    shutil.copytree(source, folder)
    parent = started(folder, command)
    _wait(lambda: parent.poll() is not None, after_s)
    before = parent.poll() is not None
    begun = time.monotonic()
    if not before:
        parent.send_signal(sign)
    parent.wait(LONGEST_S)
    in_time = before or time.monotonic() - begun < END_S
    _wait(lambda: not _session(parent.pid), END_S)
    left = _session(parent.pid)
    for pid in left:
        os.kill(pid, signal.SIGKILL)
    return Ended(state(folder), tuple(left), in_time, before)


def _wait(holds: Callable[[], bool], most_s: float) -> None:
    end = time.monotonic() + most_s
    while time.monotonic() < end and not holds():
        time.sleep(0.02)


def _session(leader: int) -> list[int]:
    """The processes of a session that are no zombies."""
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            text = (entry / "stat").read_text(encoding="utf-8", errors="replace").rpartition(")")[2].split()
        except OSError:
            continue
        if text[0] != "Z" and int(text[3]) == leader:
            found.append(int(entry.name))
    return found


SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)


def counted(old: Path, folder: Path, command: str, trials: int, seed: int) -> Counter[str]:
    """How so many trials ended. old: a project whose results are of other input than it has now."""
    rng = random.Random(seed)
    earlier = state(old)
    seconds, complete = time_command(old, folder / "trial", command)
    assert complete.keys() >= earlier.keys() - {"out/check.json", "out/report.html"}
    assert all(complete[name] != earlier[name] for name in ("out/adjustment.json", "out/adjustment.npz"))
    found: Counter[str] = Counter()
    for number in range(trials):
        sign, after_s = SIGNALS[number % len(SIGNALS)], rng.uniform(0.0, 1.1 * seconds)
        ended = kill(old, folder / "trial", command, sign, after_s)
        left = "earlier" if ended.state == earlier else "complete" if ended.state == complete else "mixed"
        kind = "ended before" if ended.before else sign.name
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
def test_two_hundred_kills(rendered_demo: Path, tmp_path: Path, capsys: Capture) -> None:
    old = tmp_path / "old"
    shutil.copytree(rendered_demo, old)
    project = old / "project.toml"
    replace_text(project, ', "scans/frame3.tif"', "")
    assert run(["run", str(project)]) in (0, 1)
    changed(project)
    project.write_text(f"pitch_um = 45.001\n{project.read_text(encoding='utf-8')}", encoding="utf-8")  # other places
    found = counted(old, tmp_path, "run", 200, 2)
    with capsys.disabled():
        print("\n" + "\n".join(f"{number:4d}  {what}" for what, number in sorted(found.items())))
    assert not [what for what in found if "WRONG" in what]
