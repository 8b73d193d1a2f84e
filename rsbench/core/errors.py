"""The errors that users can cause; the command line prints them in one line and exits with code 2."""

from __future__ import annotations

import re

_WORD = 300
"""Characters of a word of a message, which may be a path, or a name that somebody gave."""


class RsbenchError(Exception):
    """Bad input: the message names the file, the field, the value and what is allowed.

    A word of more than ``_WORD`` characters, which is user's text, is shortened to its ends.
    """

    def __init__(self, message: str = "") -> None:
        super().__init__(re.sub(rf"\S{{{_WORD + 1},}}", lambda word: f"{word[0][:60]}...{word[0][-20:]}", message))

    exit_code = 2
    """Of the command that it ends."""
