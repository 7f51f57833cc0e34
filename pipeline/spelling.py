"""The known word that a misspelt one was probably meant to be."""

import difflib
from collections.abc import Iterable


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """The question " Did you mean '...'?", with the blank in front; "" where nothing is near."""
    words = list(known)
    alike = [each for each in words if each.casefold() == word.casefold()]
    close = alike or difflib.get_close_matches(word, words, n=1)
    return f" Did you mean {close[0]!r}?" if close else ""
