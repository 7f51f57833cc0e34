"""Files damaged at random, seeded, and how the program answers: by a message or a result, never by a traceback."""

import json
import random
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from typing import Any

from projects import Capture

from pipeline.cli import run

WORDS = (
    "9" * 5000, "-1", "0", "1e999", "nan", "-inf", "0x" + "f" * 5000, "10000000000", "1e-320", '""', '"\\u0000"',
    "\x00", '"' + "n" * 5000 + '"', "[" * 5000, "{a=" * 2000, "a." * 3000 + "b", '"/dev/zero"', '"\x1b[31mred"',
    "=cmd|' /C calc'!A0", "true", "null", "[]", "{}", "{", '"', "'", ",", "\n", "\n\n[x]\n", "#", "é", "\ufeff",
    "\u202e", "x" * 200_000,
)  # fmt: skip
VALUES: tuple[Any, ...] = (
    "text", "9", "\x1b[2J", -1, 0, 1e300, 10**400, float("nan"), 2.5, True, None, [], {}, [[1.0]] * 9, {"a": 1},
)  # fmt: skip
MISSING = "missing"
MESSAGE, RESULT, LONGEST_MESSAGE = "message", "result", 4000


def counted(trials: int, seed: int, trial: Callable[[random.Random], str]) -> Counter[str]:
    """How so many trials ended."""
    return Counter(trial(random.Random(f"{seed} {number}")) for number in range(trials))


def command_ending(arguments: list[str], capsys: Capture, what: str) -> str:
    """How a command ended: MESSAGE, RESULT, or what was wrong where that was changed."""
    code, captured = run(arguments), capsys.readouterr()
    if code not in (0, 1, 2) or "Traceback" in captured.err or (code == 2) != (captured.err.count("reseau: ") == 1):
        return f"code {code}: {what}: {captured.err[-2000:]}"
    if len(captured.err) > LONGEST_MESSAGE or "\x1b" in captured.out + captured.err:
        return f"too long, or an escape sequence: {what}: {captured.err[:500]}"
    return MESSAGE if code == 2 else RESULT


def damaged(data: bytes, name: str, rng: random.Random) -> bytes:
    """The content of a file with one mishap: of its bytes, of its words, or of what it says."""
    if name.endswith(".json") and rng.random() < 0.4:
        return change_json(data.decode(), rng)[0].encode()
    if not name.endswith((".npz", ".db")) and rng.random() < 0.5:
        return change_word(data.decode(), rng).encode("utf-8", "replace")
    return change_bytes(data, rng)


def change_bytes(data: bytes, rng: random.Random) -> bytes:
    """Some changed, or a piece lost."""
    if rng.random() < 0.3:
        at = rng.randrange(len(data))
        return data[:at] + data[at + rng.choice((1, 30, 1000, len(data))) :]
    changed = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 8, 64))):
        at = rng.randrange(len(data))
        changed[at] = rng.choice((0, 255, changed[at] ^ (1 << rng.randrange(8)), rng.randrange(256)))
    return bytes(changed)


def change_word(text: str, rng: random.Random) -> str:
    """One word, number or sign, replaced."""
    at = rng.randrange(len(text))
    end = at + 1
    while end < len(text) and text[end] not in ' ,"\n=[]':
        end += 1
    return text[:at] + rng.choice(WORDS) + text[end:]


def change_json(text: str, rng: random.Random) -> tuple[str, str]:
    """One value changed, the place drawn first, that many entries share, and what was done."""
    content = json.loads(text)
    found = defaultdict[tuple[str, ...], list[tuple[Any, Any]]](list)
    for form, holder, key in places(content):
        found[form].append((holder, key))
    form = rng.choice(sorted(found))
    holder, key = rng.choice(found[form])
    new = rng.choice((*VALUES, MISSING))
    if new == MISSING:
        del holder[key]
    else:
        holder[key] = new
    return json.dumps(content), f"{'.'.join(form)} = {str(new)[:50]!r}"


def places(content: Any, form: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any, Any]]:
    """Every value: its place, the same for all entries of a list or of a table from names, what holds it, its key."""
    is_named = form != () and form[-1] in ("cameras", "images", "points", "fiducials", "made_from", "groups")
    if isinstance(content, dict | list) and content:
        for key in list(content) if isinstance(content, dict) else range(len(content)):
            inner = (*form, key if isinstance(key, str) and not is_named else "*")
            yield inner, content, key
            yield from places(content[key], inner)
