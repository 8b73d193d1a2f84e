"""Pictures of reports as 8-bit RGB arrays: overlays, depth and error maps, matches; JPEG; drawing of a rig."""

from __future__ import annotations

import base64
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from rsbench.core.rig import SIDES, StereoRig
from rsbench.core.so3 import FloatArray

Image = NDArray[np.uint8]

INLIER, OUTLIER, INVALID = (70, 160, 255), (255, 150, 0), (60, 60, 66)
"""Blue, orange and dark grey: colour-blind readers distinguish them too."""


def overlay(first: Image, second: Image, mask: NDArray[np.bool_] | None = None) -> Image:
    """Overlay two images, ``first`` in red and ``second`` in cyan: agreement is grey, shifts are coloured.

    Pixels outside ``mask`` are dark.
    """
    a, b = (cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in (first, second))
    out = np.stack([a, b, b], axis=-1)
    if mask is not None:
        out[~mask] = INVALID
    return out


def masked(image: Image, mask: NDArray[np.bool_]) -> Image:
    """Return the image with pixels outside ``mask`` set to dark grey."""
    return np.where(mask[..., None], image, np.array(INVALID, dtype=np.uint8))


_MAPS = {"viridis": cv2.COLORMAP_VIRIDIS, "inferno": cv2.COLORMAP_INFERNO}


def colour_map(values: ArrayLike, low: float, high: float, name: str = "viridis") -> Image:
    """Colour values (H, W) by a colour map from ``low`` to ``high``, clipped; non-finite values are dark grey."""
    v = (np.asarray(values, dtype=np.float64) - low) / max(high - low, 1e-12)
    known = np.isfinite(v)
    levels = np.where(known, np.clip(256.0 * v, 0.0, 255.0), 0.0).astype(np.uint8)
    coloured = cv2.cvtColor(cv2.applyColorMap(levels, _MAPS[name]), cv2.COLOR_BGR2RGB)
    coloured[~known] = INVALID
    return coloured


def draw_matches(image: Image, matches: FloatArray, inliers: NDArray[np.bool_]) -> Image:
    """Draw at most 400 matches (n, 4) to frame 1 as arrows on frame 0; inliers are blue, outliers orange."""
    grey = cv2.cvtColor(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), cv2.COLOR_GRAY2RGB) // 2 + 64
    out = np.ascontiguousarray(grey.astype(np.uint8))
    chosen = np.linspace(0, len(matches) - 1, min(400, len(matches))).astype(int)
    for k in chosen:
        start, end = np.round(matches[k, :2]).astype(int), np.round(matches[k, 2:]).astype(int)
        colour = INLIER if inliers[k] else OUTLIER
        cv2.arrowedLine(out, start.tolist(), end.tolist(), colour, 2, cv2.LINE_AA, tipLength=0.25)
    return out


def label(image: Image, text: str) -> Image:
    """Write a short text into the upper left corner, light on a dark bar."""
    out, font = np.ascontiguousarray(image), cv2.FONT_HERSHEY_SIMPLEX
    (width, height), below = cv2.getTextSize(text, font, 0.45, 1)
    out[: height + below + 8, : width + 12] = INVALID
    cv2.putText(out, text, (6, height + 5), font, 0.45, (255, 255, 255), 1, cv2.LINE_AA)
    return out


def shrink(image: Image, longest: int) -> Image:
    """Shrink an image to at most ``longest`` pixels per side, by area averaging."""
    scale = longest / max(image.shape[:2])
    if scale >= 1.0:
        return image
    size = (round(image.shape[1] * scale), round(image.shape[0] * scale))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def encode_jpeg(image: Image, quality: int = 88) -> bytes:
    ok, data = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not ok:
        raise ValueError(f"cannot encode an image of shape {image.shape}")
    return data.tobytes()


def jpeg_uri(data: bytes) -> str:
    """Return a JPEG file as a data URI."""
    return f"data:image/jpeg;base64,{base64.b64encode(data).decode()}"


_COLOURS = {"left": "#3b82f6", "right": "#ea580c"}


def draw_rig(rig: StereoRig, path: Path) -> None:
    """Draw a rig, in metres in the body's axes, to a file; the suffix (.svg, .png or .pdf) gives the format."""
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
