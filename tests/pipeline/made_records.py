"""Records of scans that nobody has measured, and stores of them."""

import hashlib
import random
from pathlib import Path
from typing import Any

from pipeline.archive.results_database import Kept, Store
from pipeline.provenance import FileState, Identity

Json = dict[str, Any]


def record(seed: int = 1, marks: int = 8, status: str = "measured", **changes: Any) -> Json:
    """The record of a frame of so many fiducials."""
    rng = random.Random(seed)
    return {
        "scan": f"scans/{seed}.tif",
        "width_px": 5000,
        "height_px": 4000,
        "pitch_um": [20.0, 20.5],
        "failure": None,
        "pose": {"name": "90m", "decided": True, "evidence": ["its number says so."], "written": {}, "writing": "",
                 "roll": "", "rivals": []},
        "writing": None,
        "pixel_from_camera": [[rng.uniform(40, 60), rng.gauss(0, 1), 2500.0], [rng.gauss(0, 1), -50.0, 2000.0]],
        "weights": None,
        "tone": None,
        "problems": [],
        "notes": ["Light was taken to grow as the grey value."],
        "marks": [mark(rng, str(number), status) for number in range(1, marks + 1)],
        **changes,
    }  # fmt: skip


def mark(rng: random.Random, point: str, status: str = "measured") -> Json:
    noise = [[rng.uniform(1e-4, 2e-4), 1e-5], [1e-5, rng.uniform(1e-4, 2e-4)]]
    film = [[rng.uniform(1e-3, 2e-3), 0.0], [0.0, 1e-3]]
    both = [[a + b for a, b in zip(x, y, strict=True)] for x, y in zip(noise, film, strict=True)]
    return {
        "point": point,
        "kind": "fiducial",
        "col_px": rng.uniform(0, 5000),
        "row_px": rng.uniform(0, 4000),
        "covariance_px2": both,
        "causes_px2": {"noise": noise, "film": film},
        "status": status,
        "reason": "" if status == "measured" else "it is faint",
        "reason_code": "" if status == "measured" else "contrast",
        "quality": {"snr": rng.uniform(5, 50), "contrast_dn": "nan", "blur_px": rng.uniform(1, 2)},
    }


def failed(seed: int = 1) -> Json:
    sentence = f"scans/{seed}.tif is damaged or truncated"
    return record(seed, 2, "absent", failure={"code": "unreadable", "sentence": sentence}, pitch_um=["nan", "nan"],
                  width_px=0, height_px=0, pose=None, pixel_from_camera=None, problems=[sentence])  # fmt: skip


def kept(seed: int = 1, options: str = "{}", mtime_ns: int = 1, **changes: Any) -> Kept:
    """A result of a scan of its own."""
    state = FileState(f"scans/{seed}.tif", 1000 + seed, mtime_ns)
    parts = hashlib.sha256(str(seed).encode()).hexdigest()
    return Kept(Identity(state, parts), options, {**record(seed), **changes}, seconds=0.5, camera="camera.toml")


def dump(path: Path) -> list[str]:
    """All that a store holds, but times, and which rows came first."""
    with Store(path) as store:
        db = store.connection
        results = db.execute(
            "select fingerprint, uri, bytes, mtime_ns, identity_hash, hash, result.id from result "
            "join scan on scan.id = result.scan join options on options.id = result.options order by fingerprint"
        ).fetchall()
        return [f"{row[:-1]} {store.record(row[-1])}" for row in results]
