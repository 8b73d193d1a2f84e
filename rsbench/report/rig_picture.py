"""A picture of a rig: both cameras with what they see, from above and from behind."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rsbench.core.rig import SIDES, StereoRig

_COLOURS = {"left": "#3b82f6", "right": "#ea580c"}


def draw_rig(rig: StereoRig, path: Path) -> None:
    """Write the picture; its suffix, .svg, .png or .pdf, is its format. Lengths are metres in the body's axes."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 4.2), layout="constrained")
    views = (("from above: x right, z ahead", 0, 2), ("from behind: x right, y down", 0, 1))
    for axes, (title, across, up) in zip(figure.subplots(1, 2), views, strict=True):
        for side in SIDES:
            place = -rig.offset(side)
            own = rig.own(side).R
            camera = rig.sensor(side)
            w, h = camera.width - 0.5, camera.height - 0.5
            corners = camera.unproject([(-0.5, -0.5), (w, -0.5), (w, h), (-0.5, h), (-0.5, -0.5)])
            far = place + 0.6 * rig.baseline * corners @ own
            for corner in far[:4]:
                axes.plot(*np.stack([place, corner])[:, [across, up]].T, color=_COLOURS[side], lw=0.8)
            axes.fill(*far[:, [across, up]].T, color=_COLOURS[side], alpha=0.15)
            axes.plot(*far[:, [across, up]].T, color=_COLOURS[side], lw=1.2)
            axes.plot(*far[:2, [across, up]].T, color=_COLOURS[side], lw=3.0)  # the image's first row
            axis = np.stack([place, place + rig.baseline * own[2]])[:, [across, up]]
            axes.plot(*axis.T, color=_COLOURS[side], lw=0.8, ls=":")
            axes.annotate(
                side, place[[across, up]], color=_COLOURS[side], xytext=(4, -12), textcoords="offset points"
            )
        axes.set_title(title, fontsize=10)
        axes.set_aspect("equal", "datalim")
        axes.grid(alpha=0.2)
        axes.set_xlabel("m")
        if up == 1:
            axes.invert_yaxis()
    figure.suptitle(
        f"baseline {1e3 * rig.baseline:.1f} mm; thick lines: the first rows of the images", fontsize=10
    )
    figure.savefig(path, dpi=120)
