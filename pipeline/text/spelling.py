"""The known word that a misspelt one was probably meant to be."""

import difflib
from collections.abc import Iterable


def nearest(word: str, known: Iterable[str]) -> str | None:
    """The known word that is the most like it; None where none is near."""
    words = list(known)
    alike = [each for each in words if each.casefold() == word.casefold()]
    return next(iter(alike or difflib.get_close_matches(word, words, n=1)), None)


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """The question " Did you mean '...'?", with the blank in front; "" where nothing is near."""
    near = nearest(word, known)
    return "" if near is None else f" Did you mean {near!r}?"
