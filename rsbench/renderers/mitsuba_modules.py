"""Dr.Jit and Mitsuba, imported at their first use: that takes a second, and the backend must be chosen before."""

from __future__ import annotations

from importlib import import_module
from typing import Any


class _ImportedAtFirstUse:
    """Stands for a module."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __getattr__(self, attribute: str) -> Any:
        return getattr(import_module(self._name), attribute)


dr: Any = _ImportedAtFirstUse("drjit")
mi: Any = _ImportedAtFirstUse("mitsuba")
