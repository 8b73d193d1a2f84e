"""The errors that users can cause; the command line prints them in one line and exits with code 2."""

from __future__ import annotations

import contextlib
import re
import unicodedata
from collections.abc import Iterator

_WORD = 300
"""Characters of a word of a message, which may be a path, or a name that somebody gave."""


def printable(text: str) -> str:
    """A text as a terminal may show it: control characters, which could move its cursor, are escaped.

    Line ends and tabs stay.
    """
    hidden = {c for c in set(text) - set("\n\t") if unicodedata.category(c).startswith("C")}
    return text.translate({ord(c): c.encode("unicode_escape").decode() for c in hidden})


class RsbenchError(Exception):
    """Bad input: the message names the file, the field, the value and what is allowed.

    A word of more than ``_WORD`` characters, which is user's text, is shortened to its ends.
    """

    exit_code = 2
    """Exit code of a command that ends with this error."""

    def __init__(self, message: object = "") -> None:
        shortened = re.sub(rf"\S{{{_WORD + 1},}}", lambda word: f"{word[0][:60]}...{word[0][-20:]}", str(message))
        super().__init__(shortened)


@contextlib.contextmanager
def naming(where: object, *kinds: type[Exception]) -> Iterator[None]:
    """Raise errors of these kinds, ValueError without any, as RsbenchError with ``where`` in front."""
    kinds = kinds or (ValueError,)
    try:
        yield
    except kinds as error:
        raise RsbenchError(f"{where}: {error}") from error
