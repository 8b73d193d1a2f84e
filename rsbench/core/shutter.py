"""The rolling-shutter model, which alone converts pixels to times."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields, replace
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from rsbench.core import arguments
from rsbench.core.so3 import FloatArray

Scan = Literal["top", "bottom", "left", "right"]
"""Side at which the readout begins; ``top`` and ``bottom`` read rows, ``left`` and ``right`` columns."""
_LONGEST_DELAY = 1.0


@dataclass(frozen=True, kw_only=True)
class Scanning:
    """How cameras read their lines, as in cards and files; each key may be left out."""

    scan: Scan = "top"
    """Side of the image at which the readout of both cameras begins; ``left`` and ``right`` read columns."""
    right_scan: Scan | None = None
    """Side at which the readout of the right camera begins. Absent: as the left camera's."""
    right_delay: float = 0.0
    """Frame periods by which the right camera reads later than the left one, from -1 to 1."""
    right_readout_ratio: float | None = None
    """Readout time over frame period of the right camera, 0 to 1. Absent: as the left camera's."""

    @property
    def record(self) -> dict[str, Any]:
        """Fields for JSON; ``right_readout_ratio``, which older files lack, only if it is set."""
        return {
            name: value
            for name, value in asdict(self).items()
            if name != "right_readout_ratio" or value is not None
        }

    @property
    def plain(self) -> bool:
        """Whether both cameras read rows from the top at the same times."""
        return self.scan == "top" and self.right_scan in (None, "top") and self._at_once

    @property
    def rows_together(self) -> bool:
        """Whether both cameras read each row at one time, from the top or from the bottom."""
        return self.scan in ("top", "bottom") and self.right_scan in (None, self.scan) and self._at_once

    @property
    def _at_once(self) -> bool:
        return self.right_delay == 0.0 and self.right_readout_ratio is None

    def shutter_of(
        self, width: int, height: int, readout_ratio: float, right_size: tuple[int, int] | None = None
    ) -> RollingShutter:
        """Return the shutter for images of this size; ``right_size`` (width, height) if the right camera's
        differs.

        Raises:
            ValueError: a value is out of its range.
        """
        columns = {self.scan, self.right_scan} & {"left", "right"}
        ratio = None if self.right_readout_ratio == readout_ratio else self.right_readout_ratio
        return RollingShutter(
            height=height,
            readout_ratio=readout_ratio,
            scan=self.scan,
            right_scan=self.right_scan,
            right_delay=self.right_delay,
            width=width if columns else None,
            right_readout_ratio=ratio,
            right_size=None if right_size == (width, height) else right_size,
        )


@dataclass(frozen=True, kw_only=True)
class StatedShutter(Scanning):
    """Shutter parameters given by the user; missing ones are estimated from the frames or matches."""

    scan: Scan | None = None  # pyrefly: ignore[bad-override]
    """Side of the image at which the readout of both cameras begins. Absent: estimated with the readout ratio, or
    ``top`` if that is given."""
    readout_ratio: float | None = None
    """Readout time over frame period, 0 to 1. Absent: estimated from the frames."""

    @property
    def scanning(self) -> Scanning | None:
        """How the cameras read their lines; None if this is estimated together with the readout ratio."""
        values = (self.readout_ratio, self.scan, self.right_scan, self.right_readout_ratio)
        if all(value is None for value in values) and self.right_delay == 0.0:
            return None
        return Scanning(
            scan=self.scan or "top",
            right_scan=self.right_scan,
            right_delay=self.right_delay,
            right_readout_ratio=self.right_readout_ratio,
        )


@dataclass(frozen=True, kw_only=True)
class RollingShutter(Scanning):
    """Rolling shutter that reads lines at constant speed within ``readout_ratio`` of a frame period.

    A line is a row of the image, or a column if a camera reads from the left or the right. Times depend on pixels
    of the sensor, before any correction of lens distortion.
    """

    height: int
    """Number of rows."""
    readout_ratio: float
    """phi = T_a / (T_a + T_b) in [0, 1]; 0 is a global shutter (paper, section 2.2)."""
    width: int | None = None
    """Number of columns; needed where columns are read."""
    right_size: tuple[int, int] | None = None
    """Columns and rows of the right camera; None: as the left camera's."""

    def __post_init__(self) -> None:
        arguments.check_whole("shutter height", self.height, 1, arguments.LARGEST_SIZE)
        arguments.check_number("readout_ratio", self.readout_ratio, 0.0, 1.0)
        arguments.check_one_of("scan", self.scan, get_args(Scan))
        if self.right_scan is not None:
            arguments.check_one_of("right_scan", self.right_scan, get_args(Scan))
        arguments.check_number("right_delay", self.right_delay, -_LONGEST_DELAY, _LONGEST_DELAY)
        if self.width is not None:
            arguments.check_whole("shutter width", self.width, 1, arguments.LARGEST_SIZE)
        if self.right_readout_ratio is not None:
            arguments.check_number("right_readout_ratio", self.right_readout_ratio, 0.0, 1.0)
        for size in self.right_size or ():
            arguments.check_whole("shutter right_size", size, 1, arguments.LARGEST_SIZE)
        if self.width is None and not {self.scan, self.scan_of("right")} <= {"top", "bottom"}:
            raise ValueError("shutter width must be given where columns are read")
        arguments.keep_plain(self)

    @property
    def plain(self) -> bool:
        """Whether both cameras read rows from the top at the same times, so that ``row_time`` applies."""
        return super().plain and self.right_size is None

    @property
    def rows_together(self) -> bool:
        """Whether both cameras read each row at one time, from the top or from the bottom."""
        return super().rows_together and self.right_size is None

    @property
    def h(self) -> float:
        """Time per row in frame periods (the paper's h = phi / N)."""
        return self.readout_ratio / self.height

    def at_once(self) -> RollingShutter:
        """Return a global shutter of the same height: every pixel is read at the start of the frame."""
        return RollingShutter(height=self.height, readout_ratio=0.0)

    def with_ratio(self, readout_ratio: float) -> RollingShutter:
        """Return the same shutter with another readout ratio."""
        return replace(self, readout_ratio=readout_ratio)

    @property
    def scanning(self) -> Scanning:
        """The fields of ``Scanning`` alone."""
        return Scanning(**{each.name: getattr(self, each.name) for each in fields(Scanning)})

    @property
    def still(self) -> bool:
        """Whether both shutters are global."""
        return self.readout_ratio == 0.0 and self.right_readout_ratio in (None, 0.0)

    def ratio_of(self, side: str) -> float:
        """Readout ratio of one camera."""
        right = self.right_readout_ratio
        return self.readout_ratio if side == "left" or right is None else right

    def scan_of(self, side: str) -> Scan:
        """Side of the image at which a camera's readout begins."""
        return self.right_scan if side == "right" and self.right_scan is not None else self.scan

    def axis(self, side: str) -> int:
        """Return the index of the pixel coordinate across lines: 1 (y) for rows, 0 (x) for columns."""
        return 1 if self.scan_of(side) in ("top", "bottom") else 0

    def lines(self, side: str) -> int:
        """Number of lines."""
        size = (self.width, self.height)
        if side == "right" and self.right_size is not None:
            size = self.right_size
        return int(size[self.axis(side)] or 0)

    def rate(self, side: str) -> FloatArray:
        """Return the derivative (2,) of the time by the pixel, frame periods per px."""
        sign = 1.0 if self.scan_of(side) in ("top", "left") else -1.0
        out = np.zeros(2)
        out[self.axis(side)] = sign * self.ratio_of(side) / self.lines(side)
        return out

    def first_line(self, side: str) -> int:
        """Return the index of the line that is read first."""
        return 0 if self.scan_of(side) in ("top", "left") else self.lines(side) - 1

    def line_after(self, count: int, side: str) -> int:
        """Return the index of the line that is read after ``count`` other lines."""
        return abs(self.first_line(side) - count)

    def start(self, frame: ArrayLike, side: str) -> FloatArray:
        """Return the time (...) at which a camera reads the first line of frame ``frame`` (...)."""
        late = self.right_delay if side == "right" else 0.0
        return np.asarray(frame, dtype=np.float64) + late

    def time_after(self, lines: ArrayLike, frame: ArrayLike, side: str) -> FloatArray:
        """Return the time (...) at which a camera has read this number of lines (...) of a frame."""
        return self.start(frame, side) + self.ratio_of(side) / self.lines(side) * np.asarray(
            lines, dtype=np.float64
        )

    def line_time(self, line: ArrayLike, frame: ArrayLike, side: str) -> FloatArray:
        """Return the time tau, in frame periods, at which a camera reads line ``line``, from the top or the left.

        ``line`` is continuous: keypoints use fractional values, rendered lines whole numbers.
        """
        read = np.asarray(line, dtype=np.float64)
        if self.scan_of(side) in ("bottom", "right"):
            read = self.lines(side) - 1 - read
        return self.time_after(read, frame, side)

    def line_times(self, frame: int, side: str) -> FloatArray:
        """Return the times (lines,) of all lines, from the top or the left."""
        return self.line_time(np.arange(self.lines(side)), frame, side)

    def pixel_time(self, pixels: ArrayLike, frame: ArrayLike, side: str) -> FloatArray:
        """Return the times (...) at which a camera reads pixels (..., 2)."""
        return self.line_time(np.asarray(pixels, dtype=np.float64)[..., self.axis(side)], frame, side)

    def row_time(self, y: ArrayLike, frame: ArrayLike) -> FloatArray:
        """Return the time tau, in frame periods, at which both cameras read row ``y``, from the top, of ``frame``.

        ``y`` is continuous. Row 0 of frame k has tau = k exactly, so the true global-shutter image of a frame is
        the image at the pose of row 0.

        Raises:
            ValueError: the shutter is not ``plain``; use ``pixel_time`` instead.
        """
        if not self.plain:
            raise ValueError(
                f"scan = {self.scan!r}, right_scan = {self.right_scan!r}, right_delay = "
                f"{self.right_delay}: only rows from the top, read by both cameras at once, have one time"
            )
        return np.asarray(frame, dtype=np.float64) + self.h * np.asarray(y, dtype=np.float64)
