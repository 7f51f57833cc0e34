"""The environment that holds what a plain installation has, and nothing of what tests need."""

import os
from pathlib import Path

ROOT = Path(__file__).parents[1]
READY = Path(".venv-plain", "ready")  # made by make, below the root
NO_COMPILER = "no compiler was there at the installation"
REASON = "there is no plain environment"
PYTHON = ROOT / READY.parent / "bin" / "python"


def plain_variables() -> dict[str, str]:
    """The variables of this process, but for those that would show Python other packages; the program is that of this
    tree."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    return {**kept, "PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1"}
