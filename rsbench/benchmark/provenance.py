"""Provenance of results, with which they can be reproduced: versions, machine, seed, inputs, date."""

from __future__ import annotations

import datetime
import os
import platform
import subprocess
from functools import cache, partial
from importlib import resources
from importlib.metadata import version
from pathlib import Path
from typing import Any

from rsbench.components.imports import own_source_version
from rsbench.core.version import __version__
from rsbench.storage.files import sha256

_NUMERIC = ("numpy", "scipy", "opencv-python-headless", "numba", "poselib")
"""Packages whose version may change the last digit of a prediction."""
_PACKAGES = ("numpy", "scipy", "opencv-python-headless", "mitsuba", "drjit", "numba", "poselib", "pandas")


def provenance(command: str, **inputs: Any) -> dict[str, Any]:
    """JSON-ready record of the origin of a result."""
    return {
        "command": command,
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "rsbench": __version__,
        "commit": commit(),
        "source": own_source_version(),
        "python": platform.python_version(),
        "packages": {name: package_version(name) for name in _PACKAGES},
        "machine": {
            "system": platform.system(),
            "architecture": platform.machine(),
            "processor": processor(),
            "cores": os.cpu_count(),
        },
        "inputs": inputs,
    }


def numeric_version() -> dict[str, str]:
    """Return the versions that affect predictions, apart from components and data: rsbench and its packages."""
    return {"source": own_source_version(), **{name: package_version(name) for name in _NUMERIC}}


def commit() -> str:
    """Return the commit of the checkout with this code, with ``-dirty`` if files differ; empty without a checkout.

    Changes of results and of README.md are ignored, because the run makes them.
    """
    root = Path(str(resources.files("rsbench"))).parent
    if not (root / ".git").exists():
        return ""
    git = partial(subprocess.run, cwd=root, capture_output=True, text=True, check=True)
    try:
        name = git(["git", "rev-parse", "HEAD"]).stdout.strip()
        others = (":!results", ":!README.md")
        changed = git(["git", "status", "--porcelain", "--untracked-files=no", "--", ".", *others]).stdout
    except (OSError, subprocess.CalledProcessError):  # no git, or a folder that it does not trust
        return ""
    return f"{name}-dirty" if changed else name


def processor() -> str:
    """The processor's name, if the system provides it."""
    try:
        lines = Path("/proc/cpuinfo").read_text("utf-8").splitlines()
    except OSError:  # not Linux
        lines: list[str] = []
    named = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(named, "") or platform.processor() or "unknown"


@cache
def package_version(name: str) -> str:
    try:
        return version(name)
    except ModuleNotFoundError:  # PackageNotFoundError: an optional package of this platform
        return "not installed"


def dataset_record(folder: Path) -> dict[str, str]:
    """Identity of a dataset: its name and the hash of its manifest, which holds the hashes of all its files."""
    return {"dataset": folder.name, "dataset_json_sha256": sha256(folder / "dataset.json")}
