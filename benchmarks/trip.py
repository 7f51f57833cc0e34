"""Call trace from a scan file to a row of comparator.csv: the modules in the order of their first call, and those that
are re-entered from a module that they called.

Run: python -m benchmarks trip. It traces the measurement of a small frame of four ring-crosses and of a scan of pure
grain, in which all search methods are tried.
"""

import sys
from collections import Counter
from contextlib import nullcontext
from pathlib import Path
from tempfile import TemporaryDirectory
from types import FrameType
from typing import Any

import cv2
import numpy as np
import tifffile

from benchmarks.harness import ROOT

PACKAGES = ("measure", "adjust", "pipeline")
# Modules that call functions passed to them, as `map` does, or in each Gauss-Newton step: not counted.
CALLERS = ("measure/scans/parallel.py", "measure/matching/gauss_newton.py", "pipeline/provenance.py")


class Followed:
    """Profile function that records the project's modules that are called."""

    def __init__(self) -> None:
        self.stack: list[str] = []
        self.order: dict[str, int] = {}
        self.again: Counter[tuple[str, str]] = Counter()
        self._names: dict[str, str] = {}

    def __call__(self, frame: FrameType, event: str, _: Any) -> None:
        if event not in ("call", "return"):
            return
        name = self._name(frame)
        if event == "return":
            if self.stack:
                self.stack.pop()
            return
        above = self.stack[-1] if self.stack else ""
        if name and name != above:
            if name not in self.order:
                self.order[name] = len(set(self.stack))
            elif name in self.stack:
                self.again[name, above] += 1
        self.stack.append(name or above)

    def _name(self, frame: FrameType) -> str:
        file = frame.f_code.co_filename
        if file not in self._names:
            path = Path(file)
            inside = path.relative_to(ROOT) if path.is_relative_to(ROOT) else Path("elsewhere")
            known = inside.parts[0] in PACKAGES and inside.as_posix() not in CALLERS
            self._names[file] = ".".join(inside.with_suffix("").parts) if known else ""
        return self._names[file]


def followed() -> Followed:
    cv2.setNumThreads(1)  # calls in other threads are not traced
    from projects import write_project

    from pipeline.archive import measure_archive
    from pipeline.archive.results_database import ResultsDatabase
    from pipeline.files.project_file import read_project
    from pipeline.results.comparator_file import write_comparator
    from pipeline.terminal import Reporter
    from pipeline.workers import WorkOptions

    with TemporaryDirectory() as place:
        path = write_project(Path(place), ["frame"])
        grain = np.random.default_rng(2).normal(9000.0, 900.0, (400, 400))
        tifffile.imwrite(path.with_name("grain.tif"), grain.astype(np.uint16))
        project = read_project(path)
        calls = Followed()
        vars(measure_archive)["worker_pool"] = lambda *_: nullcontext()  # nor those in other processes
        sys.setprofile(calls)
        try:
            with ResultsDatabase(project.measurement_path) as database:
                learned = Path(place) / "learned"
                check_run = measure_archive.measure_archive(project, database, learned, Reporter(), WorkOptions())
                assert check_run is not None
                write_comparator(project.comparator, check_run.points(), check_run.pitches_um())
        finally:
            sys.setprofile(None)
    return calls


def main() -> None:
    calls = followed()
    for name, depth in calls.order.items():
        print(f"{'  ' * depth}{name}")
    print(f"\nentered again from one that they have called: {len(calls.again)}")
    for (name, above), count in calls.again.most_common():
        print(f"  {name}, from {above}: {count} times")


if __name__ == "__main__":
    main()
