"""The errors that users can cause; the command line prints them in one line and exits with code 2."""

from __future__ import annotations


class RsbenchError(Exception):
    """Bad input: the message names the file, the field, the value and what is allowed."""

    exit_code = 2
    """Of the command that it ends."""
