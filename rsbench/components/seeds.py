"""Random generators seeded by name: every draw has its own, so results do not depend on order or on workers."""

from __future__ import annotations

import hashlib

import numpy as np


def generator(*names: str | int) -> np.random.Generator:
    """Generator of (suite seed, track, sequence, solver, repetition, ...), or of a text for a purpose; equal names
    give equal draws."""
    text = "\x1f".join(map(str, names))
    return np.random.default_rng(int.from_bytes(hashlib.sha256(text.encode()).digest()[:16], "little"))
