"""Frames rendered once and kept, so that thousands of runs need no renderer: what they write is the same."""

from __future__ import annotations

import hashlib
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np


def keep_frames(folder: Path) -> None:
    """From now on this process keeps what it renders in ``folder``."""
    from rsbench.renderers import backend, render

    rendered = render.render
    folder.mkdir(exist_ok=True)

    def keep(scene: Any, camera: Any, poses: Any, options: Any, **more: Any) -> Any:
        frame = rendered(scene, camera, poses, options, **more)
        np.savez(_path(folder, camera, poses, options), **vars(frame))
        (folder / "variant").write_text(backend.start_backend().variant)
        return frame

    setattr(render, "render", keep)  # noqa: B010  an assignment has the wrong type


def show_frames(folder: Path) -> None:
    """From now on this process renders nothing: it takes what ``keep_frames`` left.

    A frame that was not kept raises ``FileNotFoundError``.
    """
    from rsbench.renderers import backend, render, scene, visibility

    def show(_: Any, camera: Any, poses: Any, options: Any, **more: Any) -> Any:
        with np.load(_path(folder, camera, poses, options)) as kept:
            return render.Frame(**kept)

    started = backend.Backend(variant=(folder / "variant").read_text())
    backend.start_backend = lambda *_, **__: started
    visibility.obstacle = lambda *_, **__: ""  # it was looked for when the frames were rendered
    scene.MitsubaScene = lambda built, *_: SimpleNamespace(glossy=built.glossy)  # pyrefly: ignore[bad-assignment]
    setattr(render, "render", show)  # noqa: B010  an assignment has the wrong type


def _path(folder: Path, camera: Any, poses: Any, options: Any) -> Path:
    digest = hashlib.sha256(f"{camera} {options}".encode())
    for values in (poses.R, poses.t):
        digest.update(np.ascontiguousarray(values, dtype=np.float64).tobytes())
    return folder / f"{digest.hexdigest()}.npz"
