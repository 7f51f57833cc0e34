"""A small project of tables and an earlier calibration, and what damage and malice do to its files."""

import io
import json
import random
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from networks import Truth, simulated
from simulated_project import write_project

from adjust.problem.network import Network
from pipeline.cli import run

FILES = ("project.toml", "camera.toml", "points.csv", "images.csv", "distances.csv", "comparator.csv",
         "earlier/adjustment.json", "earlier/adjustment.npz")  # fmt: skip
HOSTILE = (
    "9" * 5000, "-1", "0", "1e999", "nan", "-inf", "0x" + "f" * 5000, "10000000000", "1e-320", '""', '"\\u0000"',
    "\x00", '"' + "n" * 5000 + '"', "[" * 5000, "{a=" * 2000, "a." * 3000 + "b", '"/dev/zero"', '"\x1b[31mred"',
    "=cmd|' /C calc'!A0", "true", "null", "[]", "{}", "{", '"', "'", ",", "\n", "\n\n[x]\n", "#", "é", "\ufeff",
    "\u202e", "x" * 200_000,
)  # fmt: skip


def make_project(folder: Path) -> Path:
    """A project that names every kind of table, adjusted once, with that as the camera's earlier calibration."""
    truth = Truth()
    network, _ = simulated(np.random.default_rng(5), truth, free={"k3": np.inf, "p1": np.inf})
    project = write_project(network, folder)
    assert run(["adjust", str(project)]) in (0, 1)
    (folder / "out").rename(folder / "earlier")
    _replace(folder / "camera.toml", "[sigma]\n", '[sigma]\ncalibration = "earlier/adjustment.json"\n')
    _replace(project, "[object]\n", '[object]\nimages = "images.csv"\ndistances = "distances.csv"\n')
    rows = ["image,X0,Y0,Z0,omega_deg,phi_deg,kappa_deg"]
    for i, (station, angles) in enumerate(zip(truth.stations, truth.attitudes, strict=True)):
        rows.append(",".join([f"f{i}", *(f"{value:.1f}" for value in (*station, *np.degrees(angles)))]))
    (folder / "images.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    length = float(np.linalg.norm(np.array(_place(network, "0")) - np.array(_place(network, "1"))))
    (folder / "distances.csv").write_text(f"from,to,distance,sigma\n0,1,{length:.3f},0.01\n", encoding="utf-8")
    return project


def _replace(path: Path, old: str, new: str) -> None:
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new, 1), encoding="utf-8")


def _place(network: Network, id: str) -> list[float]:
    point = network.point_by_id[id]
    return [axis.value for axis in (point.X, point.Y, point.Z) if axis is not None]


def damaged(data: bytes, name: str, rng: random.Random) -> bytes:
    """The content of a file with one mishap: of its bytes, of its words, or of what it says."""
    kinds: list[Callable[[bytes, random.Random], bytes]] = [_bits, _lost, _cut, _doubled, _strange]
    if name.endswith(".npz"):
        kinds += [_array] * 6
    else:
        kinds += [_word] * 4 + [_lines] * 2
    if name.endswith(".json"):
        kinds += [_value] * 6
    return rng.choice(kinds)(data, rng)


def _bits(data: bytes, rng: random.Random) -> bytes:
    changed = bytearray(data)
    for _ in range(rng.choice((1, 1, 3, 30))):
        changed[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    return bytes(changed)


def _lost(data: bytes, rng: random.Random) -> bytes:
    at = rng.randrange(len(data))
    return data[:at] + data[at + rng.choice((1, 30, 1000)) :]


def _cut(data: bytes, rng: random.Random) -> bytes:
    return data[: rng.randrange(len(data))]


def _doubled(data: bytes, rng: random.Random) -> bytes:
    at, length = rng.randrange(len(data)), rng.choice((1, 50, 3000))
    return data[: at + length] + data[at:]


def _strange(_: bytes, rng: random.Random) -> bytes:
    return rng.choice((b"", b"\x00" * 100, b"PK\x03\x04", rng.randbytes(3000), b"\xff\xfe", b"\x89PNG\r\n\x1a\n"))


def _word(data: bytes, rng: random.Random) -> bytes:
    """One word, number or sign, replaced."""
    text = data.decode("utf-8")
    at = rng.randrange(len(text))
    end = at + 1
    while end < len(text) and text[end] not in ' ,"\n=[]':
        end += 1
    return (text[:at] + rng.choice(HOSTILE) + text[end:]).encode("utf-8", "replace")


def _lines(data: bytes, rng: random.Random) -> bytes:
    lines = data.split(b"\n")
    i, j = rng.randrange(len(lines)), rng.randrange(len(lines))
    how = rng.randrange(3)
    if how == 0:
        lines[i], lines[j] = lines[j], lines[i]
    elif how == 1:
        lines.insert(i, lines[j])
    else:
        del lines[i]
    return b"\n".join(lines)


def _value(data: bytes, rng: random.Random) -> bytes:
    """One value or key of a JSON file replaced."""
    content = json.loads(data)
    node, key = content, rng.choice(list(content))
    while isinstance(node[key], dict | list) and node[key] and rng.random() < 0.9:
        node = node[key]
        key = rng.choice(list(node)) if isinstance(node, dict) else rng.randrange(len(node))
    new: Any = rng.choice((None, -1, 0, 1e308, "9", [], {}, True, [[]] * 9, "\x1b[2J", 10**400, float("nan"), 2.5))
    if isinstance(node, dict) and rng.random() < 0.3:
        node["other"] = node.pop(key)
    elif isinstance(node[key], float) and rng.random() < 0.5:
        node[key] *= 1.001
    else:
        node[key] = new
    return json.dumps(content).encode()


def _array(data: bytes, rng: random.Random) -> bytes:
    """One array of an npz file replaced, or the file packed otherwise."""
    with np.load(io.BytesIO(data)) as arrays:
        content: dict[str, Any] = dict(arrays)
    name = rng.choice(("names", "values", "matrix"))
    array = content[name]
    where = tuple(rng.randrange(size) for size in array.shape)
    how = rng.randrange(9)
    if how == 0:
        del content[name]
    elif how == 1:
        content[name] = array.astype(object)
    elif how == 2:
        content[name] = array.astype(str) if array.dtype.kind == "f" else np.zeros(array.shape, complex)
    elif how == 3:
        content[name] = array[..., :-1]
    elif how == 4:
        array[where] = (
            rng.choice(("nobody", "")) if array.dtype.kind == "U" else rng.choice((np.inf, np.nan, 1e308, -1))
        )
    elif how == 5:
        array[where] = array.flat[rng.randrange(array.size)]
    elif how == 6:
        plain = io.BytesIO()
        np.save(plain, array)
        return plain.getvalue()
    elif how == 7:
        return _bomb(name)
    else:
        content[name] = array * 1.001 if array.dtype.kind == "f" else array[::-1]
    packed = io.BytesIO()
    np.savez_compressed(packed, **content)
    return packed.getvalue()


def _bomb(name: str) -> bytes:
    """An array of a gigabyte and more of zeros, in a megabyte; its header claims still more."""
    packed = io.BytesIO()
    head = io.BytesIO()
    np.lib.format.write_array_header_1_0(head, {"descr": "<f8", "fortran_order": False, "shape": (10**6, 10**6)})
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive, archive.open(f"{name}.npy", "w") as member:
        member.write(head.getvalue())
        for _ in range(300):
            member.write(bytes(1_000_000))
    return packed.getvalue()


def copied(source: Path, folder: Path) -> Path:
    shutil.copytree(source, folder)
    return folder / "project.toml"
