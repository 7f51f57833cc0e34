"""Fifty thousand scans through the archive: memory, the store's share of a scan's time, status, and nothing to do.

    python -m benchmarks archive_scale [SCANS]

Stand-ins for the measuring of a scan, so that only the rest is timed; two processes. Each command runs in a process of
its own, whose largest memory and CPU time are printed.
"""

import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.archive_stand_ins import use, write_project

_COMMANDS = {
    "measure": ["measure"],
    "measure, nothing to do": ["measure"],
    "status": ["status"],
    "status --json": ["status", "--json"],
}


def main(scans: int) -> None:
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        project = write_project(folder, scans)
        print(f"{scans} scans of eight marks, two processes")
        print(f"{'command':<28}{'clock s':>9}{'CPU s':>9}{'ms a scan':>11}{'MB at most':>12}")
        for title, command in _COMMANDS.items():
            _row(title, [*command, str(project)], scans)
        one = folder / "scans" / "box00" / "one more.tif"
        one.write_bytes(b"one more")
        _row("measure, one scan more", ["measure", str(project)], scans)
        size = sum(file.stat().st_size for file in (folder / "out").glob("measurement.db*"))
        print(f"measurement.db {size / 1e6:.0f} MB, {size / scans / 1e3:.2f} kB a scan; "
              f"comparator.csv {(folder / 'comparator.csv').stat().st_size / 1e6:.0f} MB")  # fmt: skip


def _row(title: str, arguments: list[str], scans: int) -> None:
    start = time.monotonic()
    cpu_s, peak_mb = told_of(arguments)
    clock_s = time.monotonic() - start
    print(f"{title:<28}{clock_s:9.1f}{cpu_s:9.1f}{1e3 * cpu_s / scans:11.2f}{peak_mb:12.0f}", flush=True)


def told_of(arguments: list[str]) -> tuple[float, float]:
    """CPU seconds, and MB at most, of one command in a process of its own."""
    own = [sys.executable, __file__, "--command", *arguments]
    ended = subprocess.run(own, capture_output=True, text=True, check=False)
    told = ended.stderr.strip().splitlines()[-1].split() if ended.stderr.strip() else []
    if ended.returncode not in (0, 1) or len(told) != 3:
        raise SystemExit(f"{' '.join(arguments)} ended with {ended.returncode}:\n{ended.stderr[-3000:]}")
    return float(told[1]), float(told[2])


def command(arguments: list[str]) -> int:
    """One command in this process, and at its end what it took, processes that it started not counted."""
    from pipeline.cli import run

    if arguments[0] == "measure":
        use()
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    code = run([*arguments, "--workers", "2"] if arguments[0] == "measure" else arguments)
    used = resource.getrusage(resource.RUSAGE_SELF)
    print(f"used {used.ru_utime + used.ru_stime:.2f} {used.ru_maxrss / 1024:.0f}", file=sys.stderr)
    return code


if __name__ == "__main__":
    if sys.argv[1:2] == ["--command"]:
        sys.exit(command(sys.argv[2:]))
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 50_000)
