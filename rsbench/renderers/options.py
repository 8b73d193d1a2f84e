"""Options of a renderer, the keys of a renderer card."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any, Literal, get_args

from rsbench.core.errors import RsbenchError

Method = Literal["single-pass", "stitched"]
Integrator = Literal["sunsky", "path"]
_MOST_SAMPLES, _LONGEST_PATH, _MOST_SKY_RAYS = 1 << 16, 1 << 10, 64


@dataclass(frozen=True, kw_only=True)
class RendererOptions:
    """Options for rendering images; depth does not depend on them.

    Raises:
        RsbenchError: a value is out of its range.
    """

    description: str = ""
    """One line for ``rsbench list renderers``."""
    method: Method = "single-pass"
    """``single-pass``: every ray takes its row's pose; ``stitched``: one global-shutter image per row."""
    integrator: Integrator = "sunsky"
    """``sunsky``: sun with shadows and a hemisphere sky, free of noise; ``path``: global illumination."""
    samples: int = 16
    """Samples per pixel, a perfect square: they lie on a stratified grid inside the pixel."""
    max_depth: int = 4
    """Longest light path of ``path``, 2 = direct light only."""
    exposure: float = 0.8
    """Multiplies the linear image before it becomes 8-bit sRGB; the same for every frame."""
    seed: int = 0
    """Seed of the random numbers that ``path`` draws."""
    sky_rays: int = 0
    """Number of rays by which ``sunsky`` tests the occlusion of the sky at each surface point; 0: no occlusion."""
    full_frames: bool = False
    """Whether ``stitched`` renders every row of every global-shutter image, and not only the kept one."""

    def __post_init__(self) -> None:
        _one_of("method", self.method, get_args(Method))
        _one_of("integrator", self.integrator, get_args(Integrator))
        if not 1 <= self.samples <= _MOST_SAMPLES or math.isqrt(self.samples) ** 2 != self.samples:
            raise RsbenchError(
                f"renderer samples = {self.samples}: a perfect square is needed (1, 4, 9, ..., {_MOST_SAMPLES})"
            )
        if not 1 <= self.max_depth <= _LONGEST_PATH:
            raise RsbenchError(f"renderer max_depth = {self.max_depth}: allowed are 1 to {_LONGEST_PATH}")
        if not 0 <= self.sky_rays <= _MOST_SKY_RAYS:
            raise RsbenchError(f"renderer sky_rays = {self.sky_rays}: allowed are 0 to {_MOST_SKY_RAYS}")
        if not (math.isfinite(self.exposure) and self.exposure > 0):
            raise RsbenchError(f"renderer exposure = {self.exposure}: a positive number is needed")
        if not 0 <= self.seed < 2**32:
            raise RsbenchError(f"renderer seed = {self.seed}: allowed is 0 to 4294967295")

    @property
    def record(self) -> dict[str, Any]:
        """Return the values for JSON, without keys added in later versions that have their defaults."""
        return {name: value for name, value in asdict(self).items() if name != "sky_rays" or value}


def _one_of(field: str, value: str, allowed: tuple[str, ...]) -> None:
    if value not in allowed:
        raise RsbenchError(f"renderer {field} = {value!r}: allowed are {', '.join(allowed)}")
