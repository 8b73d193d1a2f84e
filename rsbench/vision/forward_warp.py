"""The compiled loops of z-buffered forward warping: a mesh of pixel centres drawn at the target camera.

Every source pixel centre is moved by its line's map, ``h = M_y (x, y, 1) + rho b_y`` with ``rho = 1 / depth``, to
the target pixel ``h_xy / h_z`` with inverse depth ``rho / h_z``; lines are rows, or columns where those are read.
With a lens (x, y) is the ideal pixel of the centre, and the target pixel where the lens shows ``h_xy / h_z``. Four
neighbouring centres make two triangles;
source coordinates and inverse depth are interpolated affinely over each triangle at the target pixel centres it
covers. Inverse depth is affine in the image of a plane, so that is exact; source coordinates are not (the map is
projective and curved by the shutter), but over one pixel the deviation is an eighth of the map's second
derivative, well below 1e-3 px.

Neighbours on different surfaces are not joined (``connect``); there each pixel draws its own cell, half a pixel to
every side along the surface it belongs to, so that a tear leaves no gap where the camera saw both surfaces.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rsbench.components.compiled import compiled
from rsbench.vision.compiled_camera import LineMaps, line_of, look, see

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]

RIGHT, BELOW = 1, 2
"""Bits of ``connect``: joined to the neighbour on the right, below."""
_SLACK = 1e-7  # px and barycentric; a centre on a shared edge must fall into one triangle at least
_DEGENERATE = 1e9  # inverse area, px^-2, of a triangle seen edge-on
_MAX_STRETCH = 16.0  # px that one source pixel may span at the target: wider ones show nothing and cost their area
_SAME_SURFACE = 1.001  # a cell yields to the mesh unless it is nearer by this factor of inverse depth


@compiled(error_model="numpy")
def _continues(step: float, before: float, after: float, limit: float) -> bool:
    """Whether a step between neighbours is small or continues the surface on one side of it.

    ``before`` and ``after`` are the steps on its two sides, NaN where there is none. On a plane all three are
    equal, at a crease the step equals one of them, at a jump neither. NaN fails every comparison.
    """
    return abs(step) <= limit or abs(step - before) <= limit or abs(step - after) <= limit


@compiled(error_model="numpy")
def connect(rho: F32, limit: F64) -> U8:
    """(H, W) bits RIGHT and BELOW: the neighbours that lie on the same surface.

    ``rho`` (H, W) is inverse depth, NaN where unknown; ``limit`` (H, W) the largest unexplained step of inverse
    depth between a pixel and its neighbours.
    """
    height, width = rho.shape
    joined = np.zeros((height, width), dtype=np.uint8)
    for y in range(height):
        for x in range(width - 1):
            step = rho[y, x + 1] - rho[y, x]
            before = rho[y, x] - rho[y, x - 1] if x > 0 else np.nan
            after = rho[y, x + 2] - rho[y, x + 1] if x + 2 < width else np.nan
            if _continues(step, before, after, min(limit[y, x], limit[y, x + 1])):
                joined[y, x] = RIGHT
    for y in range(height - 1):
        for x in range(width):
            step = rho[y + 1, x] - rho[y, x]
            before = rho[y, x] - rho[y - 1, x] if y > 0 else np.nan
            after = rho[y + 2, x] - rho[y + 1, x] if y + 2 < height else np.nan
            if _continues(step, before, after, min(limit[y, x], limit[y + 1, x])):
                joined[y, x] |= BELOW
    return joined


@compiled(error_model="numpy", inline="always")
def move(maps: LineMaps, columns: bool, x: int, y: int, rho: float) -> tuple[float, float, float]:
    """Target pixel and inverse depth of a source pixel; NaN behind the target camera or where rho is NaN."""
    M, b, line = maps.M, maps.b, line_of(columns, x, y)
    gx, gy = look(maps.ideal, x, y)
    z = M[line, 2, 0] * gx + M[line, 2, 1] * gy + M[line, 2, 2] + rho * b[line, 2]
    s = 1.0 / z if z > 0.0 else np.nan
    u = M[line, 0, 0] * gx + M[line, 0, 1] * gy + M[line, 0, 2] + rho * b[line, 0]
    v = M[line, 1, 0] * gx + M[line, 1, 1] * gy + M[line, 1, 2] + rho * b[line, 1]
    px, py = see(maps.lens, u * s, v * s)
    return px, py, rho * s


@compiled(error_model="numpy")
def move_pixels(rho: F32, maps: LineMaps, moved: F64) -> None:
    """Fill ``moved`` (3, H, W) with target x, y and inverse depth of every source pixel centre."""
    height, width = rho.shape
    for y in range(height):
        for x in range(width):
            moved[0, y, x], moved[1, y, x], moved[2, y, x] = move(maps, maps.columns, x, y, rho[y, x])


@compiled(error_model="numpy", inline="always")
def _move_row(maps: LineMaps, y: int, rho: F32, out: F64) -> None:
    """``move`` of a row of pixels into ``out`` (W, 3)."""
    if maps.columns:
        for x in range(rho.shape[1]):
            out[x, 0], out[x, 1], out[x, 2] = move(maps, True, x, y, rho[y, x])
    else:  # apart, so that the row's map is loaded once
        for x in range(rho.shape[1]):
            out[x, 0], out[x, 1], out[x, 2] = move(maps, False, x, y, rho[y, x])


@compiled(error_model="numpy")
def draw_mesh(rho: F32, joined: U8, maps: LineMaps, source_map: F32, buffer: F32) -> None:
    """Draw the triangles of all joined neighbours into ``source_map`` (H, W, 2) and ``buffer`` (H, W).

    ``buffer`` holds inverse depth at the target, -1 where nothing is drawn yet; the larger one wins.
    """
    height, width = rho.shape
    rows = np.zeros((2, width, 3))
    for y in range(height):
        upper, lower = rows[(y + 1) & 1], rows[y & 1]
        _move_row(maps, y, rho, lower)
        if y == 0:
            continue
        for x in range(width - 1):
            top, bottom = joined[y - 1, x] & RIGHT != 0, joined[y, x] & RIGHT != 0
            left, right = joined[y - 1, x] & BELOW != 0, joined[y - 1, x + 1] & BELOW != 0
            whole = top and bottom and left and right
            if (top and left) or (bottom and right):
                # Both triangles of a whole quad; of a torn one those whose two sides are whole.
                first, second = whole or (top and left), whole or (bottom and right)
                _quad(upper, lower, x, x + 1, y - 1, first, second, source_map, buffer)
            if not whole and ((top and right) or (bottom and left)):
                # The other diagonal may still join three corners: the same quad, mirrored.
                _quad(upper, lower, x + 1, x, y - 1, top and right, bottom and left, source_map, buffer)


@compiled(error_model="numpy", inline="always")
def _covered(a: float, b: float, c: float, d: float, size: int) -> tuple[int, int]:
    """First and last pixel between the corners' coordinates; none when one is NaN or they are too far apart."""
    low, high = min(min(a, b), min(c, d)), max(max(a, b), max(c, d))
    if not high - low <= _MAX_STRETCH:
        return 1, 0
    return int(max(0.0, np.ceil(low - _SLACK))), int(min(size - 1.0, np.floor(high + _SLACK)))


@compiled(error_model="numpy", inline="always")
def _quad(
    upper: F64,
    lower: F64,
    near: int,
    far: int,
    y: int,
    first: bool,
    second: bool,
    source_map: F32,
    buffer: F32,
) -> None:
    """Draw two triangles of the quad of source columns ``near`` and ``far``, rows y and y + 1.

    ``first`` has its right angle at (near, y), ``second`` at (far, y + 1). ``upper`` and ``lower`` (W, 3) hold
    (target x, y, inverse depth) of the two rows.
    """
    # Scalars, because numba counts the references of every view it makes.
    ax, ay, az = upper[near, 0], upper[near, 1], upper[near, 2]
    bx, by, bz = upper[far, 0], upper[far, 1], upper[far, 2]
    cx, cy, cz = lower[near, 0], lower[near, 1], lower[near, 2]
    dx, dy, dz = lower[far, 0], lower[far, 1], lower[far, 2]
    height, width = buffer.shape
    start, stop = _covered(ax, bx, cx, dx, width)
    top, bottom = _covered(ay, by, cy, dy, height)
    if not (start <= stop and top <= bottom):
        return
    ux, uy, vx, vy = bx - ax, by - ay, cx - ax, cy - ay
    wx, wy, zx, zy = cx - dx, cy - dy, bx - dx, by - dy
    scale, scale_2 = 1.0 / (ux * vy - uy * vx), 1.0 / (wx * zy - wy * zx)
    # Also false for NaN, a corner behind the target camera.
    first = first and abs(scale) < _DEGENERATE
    second = second and abs(scale_2) < _DEGENERATE
    for row in range(top, bottom + 1):
        for column in range(start, stop + 1):
            px, py = column - ax, row - ay
            s, t = (px * vy - py * vx) * scale, (ux * py - uy * px) * scale
            z = az + s * (bz - az) + t * (cz - az)
            if not (first and s >= -_SLACK and t >= -_SLACK and s + t <= 1.0 + _SLACK):
                px, py = column - dx, row - dy
                s, t = (px * zy - py * zx) * scale_2, (wx * py - wy * px) * scale_2
                if not (second and s >= -_SLACK and t >= -_SLACK and s + t <= 1.0 + _SLACK):
                    continue
                z = dz + s * (cz - dz) + t * (bz - dz)
                s, t = 1.0 - s, 1.0 - t
            nearness = np.float32(z)
            if nearness > buffer[row, column]:
                buffer[row, column] = nearness
                source_map[row, column, 0] = near + (far - near) * s
                source_map[row, column, 1] = y + t


@compiled(error_model="numpy")
def draw_cells(rho: F32, joined: U8, maps: LineMaps, source_map: F32, buffer: F32) -> None:
    """Draw the cells of pixels that are not joined to four neighbours, behind ``draw_mesh``'s result.

    A cell reaches half a pixel beyond the centre along its own surface: the boundary between two surfaces is
    taken to lie halfway between the two pixel centres, and the frame to end half a pixel beyond its outermost
    ones, so that a warp by almost nothing loses no row or column.
    """
    height, width = rho.shape
    for y in range(height):
        for x in range(width):
            if not rho[y, x] >= 0.0:
                continue
            right, left = joined[y, x] & RIGHT, x > 0 and joined[y, x - 1] & RIGHT
            below, above = joined[y, x] & BELOW, y > 0 and joined[y - 1, x] & BELOW
            if right and left and below and above:
                continue
            # Steps of inverse depth along the surface, 0 where nothing is known of its slope.
            ahead = x + 1 if right else x
            behind = x - 1 if left else x
            along_x = (rho[y, ahead] - rho[y, behind]) / max(ahead - behind, 1)
            ahead = y + 1 if below else y
            behind = y - 1 if above else y
            along_y = (rho[ahead, x] - rho[behind, x]) / max(ahead - behind, 1)
            _cell(rho, x, y, (along_x, along_y), maps, source_map, buffer)


@compiled(error_model="numpy")
def _cell(
    rho: F32, x: int, y: int, along: tuple[float, float], maps: LineMaps, source_map: F32, buffer: F32
) -> None:
    """Draw the parallelogram that the square of half a pixel around source pixel (x, y) becomes.

    ``along`` are the steps of inverse depth to the next column and row.
    """
    height, width = buffer.shape
    columns = maps.columns
    ax, ay, az = move(maps, columns, x, y, rho[y, x])
    # The next line has another pose, also at the last one, whose next neighbour does not exist. A row's goes on.
    right = -1 if x + 1 == width and (columns or maps.lens is not None) else 1
    bx, by, bz = move(maps, columns, x + right, y, rho[y, x] + right * along[0])
    step = 1 if y + 1 < height else -1
    cx, cy, cz = move(maps, columns, x, y + step, rho[y, x] + step * along[1])
    ux, uy, uz = right * (bx - ax), right * (by - ay), right * (bz - az)
    vx, vy, vz = step * (cx - ax), step * (cy - ay), step * (cz - az)
    scale = 1.0 / (ux * vy - uy * vx)
    if not abs(scale) < _DEGENERATE:
        return
    reach_x, reach_y = 0.5 * (abs(ux) + abs(vx)) + _SLACK, 0.5 * (abs(uy) + abs(vy)) + _SLACK
    if not (2.0 * reach_x <= _MAX_STRETCH and 2.0 * reach_y <= _MAX_STRETCH):
        return
    top, bottom = max(0.0, np.ceil(ay - reach_y)), min(height - 1.0, np.floor(ay + reach_y))
    left, right = max(0.0, np.ceil(ax - reach_x)), min(width - 1.0, np.floor(ax + reach_x))
    if not (top <= bottom and left <= right):
        return
    half = 0.5 + _SLACK
    for row in range(int(top), int(bottom) + 1):
        for column in range(int(left), int(right) + 1):
            px, py = column - ax, row - ay
            s = (px * vy - py * vx) * scale
            t = (ux * py - uy * px) * scale
            if abs(s) <= half and abs(t) <= half:
                z = np.float32(max(az + s * uz + t * vz, 0.0))
                if z > buffer[row, column] * _SAME_SURFACE or buffer[row, column] < 0.0:
                    buffer[row, column] = z
                    source_map[row, column, 0] = x + s
                    source_map[row, column, 1] = y + t


@compiled(error_model="numpy")
def draw_moved(moved: F64, joined: U8, source_map: F32, buffer: F32) -> None:
    """``draw_mesh`` of pixel centres that are moved already: ``moved`` (H, W, 3) target x, y and inverse depth.

    Whatever moved them; NaN is not drawn.
    """
    height, width = joined.shape
    for y in range(1, height):
        upper, lower = moved[y - 1], moved[y]
        for x in range(width - 1):
            top, bottom = joined[y - 1, x] & RIGHT != 0, joined[y, x] & RIGHT != 0
            left, right = joined[y - 1, x] & BELOW != 0, joined[y - 1, x + 1] & BELOW != 0
            whole = top and bottom and left and right
            if (top and left) or (bottom and right):
                first, second = whole or (top and left), whole or (bottom and right)
                _quad(upper, lower, x, x + 1, y - 1, first, second, source_map, buffer)
            if not whole and ((top and right) or (bottom and left)):
                _quad(upper, lower, x + 1, x, y - 1, top and right, bottom and left, source_map, buffer)


def draw_within(moved: F64, stretch: float) -> tuple[F32, F32]:
    """Source pixel (H, W, 2) and inverse depth (H, W), -1 for none, of the mesh of ``moved`` (H, W, 3).

    Without what joins neighbours that are more than ``stretch`` px apart.
    """
    joined = np.zeros(moved.shape[:2], dtype=np.uint8)
    _join(moved, stretch, joined)
    source_map = np.full((*joined.shape, 2), np.nan, dtype=np.float32)
    buffer = np.full(joined.shape, -1.0, dtype=np.float32)
    draw_moved(moved, joined, source_map, buffer)
    return source_map, buffer


@compiled(error_model="numpy")
def _join(moved: F64, stretch: float, joined: U8) -> None:
    """Fill ``joined`` (H, W) with the bits of ``connect``."""
    height, width = joined.shape
    for y in range(height):
        for x in range(width):
            if x + 1 < width:
                along = np.hypot(moved[y, x + 1, 0] - moved[y, x, 0], moved[y, x + 1, 1] - moved[y, x, 1])
                joined[y, x] = RIGHT if along <= stretch else 0
            if y + 1 < height:
                along = np.hypot(moved[y + 1, x, 0] - moved[y, x, 0], moved[y + 1, x, 1] - moved[y, x, 1])
                joined[y, x] |= BELOW if along <= stretch else 0
