"""Imports Dr.Jit and Mitsuba at their first use: this takes a second and must follow the choice of a backend."""

from __future__ import annotations

import sys
from importlib import import_module
from typing import Any


class _ImportedAtFirstUse:
    """Placeholder of a module; its first use replaces it by the module in all modules of rsbench.

    A lookup through this class takes 20 times as long as one in the module, and scalar tracing makes dozens of
    lookups per ray.
    """

    def __init__(self, alias: str, name: str) -> None:
        self._alias, self._name = alias, name

    def __getattr__(self, attribute: str) -> Any:
        module = import_module(self._name)
        for name, user in list(sys.modules.items()):
            if name.startswith("rsbench.") and vars(user).get(self._alias) is self:
                setattr(user, self._alias, module)
        return getattr(module, attribute)


dr: Any = _ImportedAtFirstUse("dr", "drjit")
mi: Any = _ImportedAtFirstUse("mi", "mitsuba")
