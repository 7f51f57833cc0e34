"""Hostile decisions, imports, names and addresses, seeded: all are read rightly or refused by a message."""

import random
import shutil
import string
import traceback
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest
from hostile import change_bytes, counted
from projects import adjusted_project
from studies import parametrize_with_studies

from adjust import AdjustmentError
from measure import MeasurementError
from measure.scans.remote import Address
from pipeline import InputError, read_project
from pipeline.exchange.exchange_stage import run_export, run_import
from pipeline.exchange.formats import ExportOptions
from pipeline.exchange.incoming import ImportOptions
from pipeline.files.decisions_file import Choice, Decision, append_decisions, read_decisions
from pipeline.text.files import names_below

REFUSED = (InputError, MeasurementError, AdjustmentError)
SECRETS = ("hunter2", "s3cr3t-signature", "AKIAEXAMPLE")
GOOD, WRONG, OUTSIDE = "right or refused", "wrong as right", "outside"
Trial = Callable[[random.Random, Path, Path], str]


@pytest.fixture(scope="module")
def adjusted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return adjusted_project(tmp_path_factory.mktemp("adjusted"))


def decisions_trial(rng: random.Random, folder: Path, adjusted: Path) -> str:
    """A file of good lines, one of them spoiled: all good ones are read, or the bad one is named; and appending writes
    all of a batch or nothing."""
    path = folder / "decisions.jsonl"
    choices = (Choice.ACCEPT, Choice.REJECT, Choice.ABSENT, Choice.UNDO)
    lines = [Decision(rng.choice("abz"), rng.choice(choices), rng.choice("129"), "fiducial") for _ in range(8)]
    append_decisions(path, lines)
    if is_spoilt := rng.random() < 0.7:
        path.write_bytes(change_bytes(path.read_bytes(), rng))
    read = read_decisions(path)
    if not is_spoilt and read != tuple(lines):
        return WRONG
    bad = Decision("a", Choice.PLACE, "1", "fiducial", col_px=rng.choice([float("nan"), 1e300]), row_px=1.0)
    before = path.read_bytes()
    try:
        append_decisions(path, [lines[0], bad])
    except InputError:
        return GOOD if path.read_bytes() == before else WRONG
    return WRONG


def word(rng: random.Random) -> str:
    pieces = ["..", "/", "\\", ".", "x", "~", "C:", "\0", "\n", "%2e%2e", "σ", " ", "a" * 300, "$(x)", "<b>", '"', "'"]
    return "".join(rng.choice(pieces) for _ in range(rng.randrange(1, 6)))


def xml(text: str) -> str:
    return "".join(f"&#{ord(letter)};" if letter in '<>&"' else letter for letter in text)


def written(write: Callable[[Path], object], folder: Path) -> str:
    """Whether writing into a folder of the given one left its surroundings alone."""
    around, out = folder.parent, folder / "o" / "out"
    before = set(around.rglob("*"))
    with suppress(*REFUSED):
        write(out)
    news = {path for path in set(around.rglob("*")) - before if path.is_file()}
    return GOOD if all(path.is_relative_to(out) for path in news) else OUTSIDE


def imports_trial(rng: random.Random, folder: Path, adjusted: Path) -> str:
    place = rng.choice(["1 2", "nan 1", "1e999 0", "x", "1"])
    mark = f"<OneMesureAF1I><NamePt>{xml(word(rng))}</NamePt><PtIm>{place}</PtIm></OneMesureAF1I>"
    one = f"<MesureAppuiFlottant1Im><NameIm>{xml(word(rng))}</NameIm>{mark * rng.randrange(3)}</MesureAppuiFlottant1Im>"
    text = bytearray(one.encode())
    if rng.random() < 0.3:
        text[rng.randrange(len(text))] = rng.randrange(256)
    source = folder / rng.choice(["MeasuresIm-a.xml", "MeasuresCamera.xml", "MesIm-a.xml", "a.xml"])
    source.write_bytes(text)
    format = rng.choice(["micmac", "mmvii", "metashape", "opencv", "certificate", "bingo"])
    options = ImportOptions(pitch_um=10.0, sigma_px=0.1)
    return written(lambda out: run_import(format, [source], out, options), folder)


def names_trial(rng: random.Random, folder: Path, adjusted: Path) -> str:
    name = word(rng)
    for file in ("project.toml", "camera.toml", "points.csv"):
        if (adjusted.parent / file).exists():
            shutil.copy(adjusted.parent / file, folder / file)
    project = folder / "project.toml"
    project.write_text(project.read_text().replace('scans = ["scans/*.tif"]\n', ""))
    cell = '"' + name.replace('"', '""') + '"'
    lines = adjusted.with_name("comparator.csv").read_text().splitlines()
    (folder / "comparator.csv").write_text(
        "\n".join(cell + line[2:] if line.startswith("f1,") else line for line in lines)
    )
    format = rng.choice(["csv", "mmvii", "micmac"])
    read = read_project(project)
    return written(lambda out: run_export(read, format, out, ExportOptions()), folder)


def addresses_trial(rng: random.Random, folder: Path, adjusted: Path) -> str:
    """No secret is told, and another signature is the same scan."""
    signed = [
        "X-Amz-Signature={0}&X-Amz-Credential={1}&X-Amz-Date={2}",
        "AWSAccessKeyId={1}&Signature={0}&Expires={2}",
        "sv={2}&se={2}&sr=b&sig={0}",
        "token={0}",
        "Policy={2}&Signature={0}&Key-Pair-Id={1}",
        "X-Goog-Signature={0}&X-Goog-Date={2}",
    ]
    form, user = rng.choice(signed), rng.choice(["", "ann:hunter2@", "hunter2@", "ann%40x:hunter2@"])
    host, path = rng.choice(["h.org", "h.org:8080", "[::1]"]), rng.choice(["0001.tif", "a/b/0001.tif", "a b/0001.tif"])
    base = f"{rng.choice(['https', 'http', 'HTTPS'])}://{user}{host}/{path}"

    def query() -> str:
        when = "".join(rng.choices(string.digits, k=8))
        return form.format(f"s3cr3t-signature{rng.choice('/+=%')}{rng.random()}", f"AKIAEXAMPLE{when}", when)

    one, two = Address(f"{base}?{query()}"), Address(f"{base}?{query()}")
    result = [str(one), repr(one), one.name, *names_below([one, one.with_name("b.tif")]), f"{one}", str([one])]
    if str(one) != str(two) or any(secret in text for secret in SECRETS for text in result):
        return WRONG
    return GOOD if names_below([one]) == ["0001"] else WRONG


@parametrize_with_studies(("trials", "seed"), [(4, 1), (600, 36)])
@pytest.mark.parametrize("trial", [decisions_trial, imports_trial, names_trial, addresses_trial])
def test_hostile_inputs(trial: Trial, trials: int, seed: int, adjusted: Path, tmp_path: Path) -> None:
    def ending(rng: random.Random) -> str:
        folder = tmp_path / "around" / "p"
        folder.mkdir(parents=True)
        try:
            return trial(rng, folder, adjusted)
        except REFUSED:
            return GOOD
        except Exception:
            return traceback.format_exc()
        finally:
            shutil.rmtree(folder.parent)

    assert counted(trials, seed, ending) == {GOOD: trials}
