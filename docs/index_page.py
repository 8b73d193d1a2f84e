"""The page of a package index: README.md, whose links lead to the repository, for nothing lies beside it there."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from hatchling.metadata.plugin.interface import MetadataHookInterface

_RELATIVE = re.compile(r"\]\((?!https?:|#)([^)\s]+)\)")
_PICTURES = (".gif", ".jpg", ".png", ".svg")


def indexed(readme: str, repository: str) -> str:
    """The text with relative links made absolute: pages to ``blob/main``, pictures to ``raw/main``."""

    def absolute(link: re.Match[str]) -> str:
        kind = "raw" if link[1].endswith(_PICTURES) else "blob"
        return f"]({repository}/{kind}/main/{link[1]})"

    return _RELATIVE.sub(absolute, readme)


class CustomMetadataHook(MetadataHookInterface):
    """Called by hatchling, see ``[tool.hatch.metadata.hooks.custom]``."""

    def update(self, metadata: dict[str, Any]) -> None:
        text = (Path(self.root) / "README.md").read_text("utf-8")
        page = indexed(text, metadata["urls"]["Repository"])
        metadata["readme"] = {"content-type": "text/markdown", "text": page}
