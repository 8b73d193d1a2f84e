"""Surfaces below a clear coat, for ``sunsky``: what ``path`` means by them, without its random numbers.

Light is mirrored by facets of the coat, or goes through it to the diffuse surface below and back. Both parts are
those of one Mitsuba BSDF (``roughplastic``), which ``path`` asks too.
"""

from __future__ import annotations

from functools import cache
from typing import Any

_BELOW_A_COAT = 0.95
"""Of the light that comes evenly from all sides the share that passes the coat, over that which passes it upright.
0.946 to 0.953 for the roughnesses that a material may have, by the sum of that BSDF over directions."""


def is_glossy(bsdf: Any, active: Any) -> Any:
    """Whether BSDFs have a coat."""
    import mitsuba as mi

    return mi.has_flag(bsdf.flags(), mi.BSDFFlags.GlossyReflection) & active


class Coat:
    """What glossy surfaces do where rays meet them."""

    def __init__(self, hit: Any, normal: Any, ray: Any) -> None:
        """
        Args:
            hit: Mitsuba's interaction, position and normals in the world.
            normal: unit shading normals towards the eye.
            ray: that met the surfaces.
        """
        import mitsuba as mi

        self._bsdf, self._frame = hit.bsdf(), mi.Frame3f(normal)
        self._hit = mi.SurfaceInteraction3f(hit)
        self._hit.sh_frame, self._hit.wi = self._frame, self._frame.to_local(-ray.d)

    def share_towards(self, direction: Any, active: Any) -> Any:
        """Radiance by an irradiance of 1 from unit directions, measured across them: of coat and surface below."""
        return self._bsdf.eval(_context("all"), self._hit, self._frame.to_local(direction), active)

    def below(self, active: Any) -> Any:
        """Radiance of the surface below by an even radiance of 1 from all sides: its albedo through the coat."""
        import drjit as dr
        import mitsuba as mi

        upright = self._bsdf.eval(_context("diffuse"), self._hit, mi.Vector3f(0, 0, 1), active)
        return upright * (dr.pi * _BELOW_A_COAT)

    def mirrored(self, facet: Any, active: Any) -> tuple[Any, Any]:
        """Rays by facets, drawn by points of the unit square, and the share of what they bring that is seen.

        The middle of the square is the mirror direction, or nearly; the mean over all of it is the coat's light.
        """
        import mitsuba as mi

        found, share = self._bsdf.sample(_context("coat"), self._hit, mi.Float(0.5), facet, active)
        return self._hit.spawn_ray(self._frame.to_world(found.wo)), share


@cache
def _context(part: str) -> Any:
    import mitsuba as mi

    context = mi.BSDFContext()
    if part != "all":
        context.type_mask = mi.BSDFFlags.Diffuse if part == "diffuse" else mi.BSDFFlags.Glossy
    return context
