"""What a result must carry to be made again: versions, machine, seed, inputs, date."""

from __future__ import annotations

import datetime
import os
import platform
from importlib.metadata import version
from pathlib import Path
from typing import Any

from rsbench import __version__
from rsbench.dataset.files import sha256

_PACKAGES = ("numpy", "scipy", "opencv-python-headless", "mitsuba", "drjit", "numba", "poselib", "pandas")


def provenance(command: str, **inputs: Any) -> dict[str, Any]:
    """JSON-ready record of how a result came about."""
    return {
        "command": command,
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "rsbench": __version__,
        "python": platform.python_version(),
        "packages": {name: _version(name) for name in _PACKAGES},
        "machine": {"system": platform.system(), "architecture": platform.machine(), "cores": os.cpu_count()},
        "inputs": inputs,
    }


def _version(name: str) -> str:
    try:
        return version(name)
    except ModuleNotFoundError:  # PackageNotFoundError: an optional package of this platform
        return "not installed"


def dataset_record(folder: Path) -> dict[str, str]:
    """Identity of a dataset: its name and the hash of its manifest, which holds the hashes of all its files."""
    return {"dataset": folder.name, "dataset_json_sha256": sha256(folder / "dataset.json")}
