"""Which camera `reseau cameras --scan` takes real scans for, and what that takes: CPU seconds and peak memory of the
whole command, each scan in a process of its own.

python -m benchmarks cameras_of_scans [SCAN ...] [--pitch UM]

Without scans: the aerial and the reseau frames of ../shared/data, the latter at no pitch, for their files say none.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

DATA = Path(__file__).resolve().parents[2] / "shared" / "data" / "film_scans"


def tried(scan: Path, pitch_um: float | None) -> tuple[str, float, float]:
    """What the command says of the scan, the CPU seconds (user and system) and the peak memory in MB it takes."""
    command = [sys.executable, "-c", "from pipeline.main import main; main()", "cameras", "--json", "--scan", str(scan)]
    command += [] if pitch_um is None else ["--pitch", str(pitch_um)]
    with tempfile.TemporaryFile() as out:
        process = subprocess.Popen(command, stdout=out)
        _, _, used = os.wait4(process.pid, 0)
        out.seek(0)
        told = json.loads(out.read())
    return told["sentence"], used.ru_utime + used.ru_stime, used.ru_maxrss / 1024


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scans", nargs="*", type=Path)
    parser.add_argument("--pitch", type=float)
    options = parser.parse_args()
    scans = options.scans or [*sorted(DATA.glob("aerial/*.jpeg")), *sorted(DATA.glob("reseau/*.jpg"))]
    print("| scan | CPU, s | peak, MB | told |\n|---|---|---|---|")
    for scan in scans:
        sentence, seconds, megabytes = tried(scan, options.pitch)
        print(
            f"| {scan.stem} | {seconds:.1f} | {megabytes:.0f} | {sentence.removeprefix(scan.name + ': ')} |", flush=True
        )


if __name__ == "__main__":
    main()
