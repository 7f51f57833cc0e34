"""Scans, photographs and published calibrations that lie beside the project: they may not be copied into it."""

from pathlib import Path

import pytest

DATA = Path(__file__).parents[2] / "shared" / "data"
REASON = "real data are not beside the project"


def needs(*parts: str) -> pytest.MarkDecorator:
    """The mark of tests that need a file or folder of the real data: left out, and counted, where it is missing."""
    path = DATA.joinpath(*parts)
    return pytest.mark.skipif(not path.exists(), reason=f"{REASON}: {'/'.join(parts) or 'all'}")
