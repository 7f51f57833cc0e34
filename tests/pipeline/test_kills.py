"""Whatever ends a command, earlier results are whole or complete new ones are there, and no process is left."""

import random
import shutil
import signal
from collections import Counter
from pathlib import Path

import pytest
from damaged_project import make_project
from kills import Whom, state, time_command, trial

from pipeline.cli import run

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
    camera = project.parent / "camera.toml"
    text = camera.read_text(encoding="utf-8")
    assert "principal_distance_mm = 1.0" in text
    camera.write_text(text.replace("principal_distance_mm = 1.0", "principal_distance_mm = 0.5"), encoding="utf-8")


@pytest.mark.study
def test_a_share_of_the_kills(tmp_path: Path) -> None:
    old = tmp_path / "old"
    old.mkdir()
    project = make_project(old)
    text = (old / "camera.toml").read_text(encoding="utf-8")
    (old / "camera.toml").write_text(text.replace('calibration = "earlier/adjustment.json"\n', ""), encoding="utf-8")
    assert run(["adjust", str(project)]) in (0, 1)
    changed(project)
    found = counted(old, tmp_path, "adjust", 2, ("parent",), 1)
    assert not [what for what in found if "WRONG" in what], found


@pytest.mark.study
def test_two_hundred_kills(rendered_demo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    old = tmp_path / "old"
    shutil.copytree(rendered_demo, old)
    project = old / "project.toml"
    text = project.read_text(encoding="utf-8")
    project.write_text(text.replace(', "scans/frame3.tif"', ""), encoding="utf-8")
    assert run(["run", str(project)]) in (0, 1)
    changed(project)
    project.write_text(f"pitch_um = 45.001\n{project.read_text(encoding='utf-8')}", encoding="utf-8")  # other places
    found = counted(old, tmp_path, "run", 200, ("parent", "worker"), 2)
    with capsys.disabled():
        print("\n" + "\n".join(f"{number:4d}  {what}" for what, number in sorted(found.items())))
    assert not [what for what in found if "WRONG" in what]
