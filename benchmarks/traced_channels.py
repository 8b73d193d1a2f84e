"""How much of the channels is right, by rays that share nothing with the renderer.

Renders one sequence with all channels that pair pictures, draws pixels from each of its four frames, traces them
to their surfaces, finds the row that sees each by bisection, and traces back from there. Prints, of each channel,
the share of the visible pixels whose value is within 0.01 px and the share of all pixels with the right class.

    python benchmarks/traced_channels.py --dataset paper --scene castle --pixels 100000
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numba
import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from traced_truth import World, truth

from rsbench.core.rig import VIEWS
from rsbench.dataset.card import load_dataset_card
from rsbench.dataset.channels import PAIR_CHANNELS, pair_layers
from rsbench.dataset.generation import build_scene, generate_dataset
from rsbench.dataset.sequence import read_dataset
from rsbench.dataset.views import PixelClass

Array = NDArray[np.float64]
NEAR_PX, ENOUGH = 0.01, 0.999
_LEAF = 6


@dataclass(frozen=True)
class Tree:
    """Boxes around triangles, halved along their longest side at the middle one."""

    bounds: Array
    """(m, 6) lowest and highest corner."""
    below: NDArray[np.int64]
    """(m, 2) the two boxes in a box; or the first of its triangles and minus their number."""
    triangles: Array
    """(n, 3, 3)"""

    @classmethod
    def of(cls, triangles: Array) -> Tree:
        centres, order = triangles.mean(axis=1), np.arange(len(triangles))
        below: list[tuple[int, int]] = [(0, 0)]
        bounds: list[Array] = [np.zeros(6)]
        todo = [(0, 0, len(triangles))]
        while todo:
            box, first, last = todo.pop()
            inside = triangles[order[first:last]].reshape(-1, 3)
            bounds[box] = np.concatenate([inside.min(axis=0), inside.max(axis=0)])
            if last - first <= _LEAF:
                below[box] = (first, first - last)
                continue
            mine = centres[order[first:last]]
            axis = int(np.argmax(mine.max(axis=0) - mine.min(axis=0)))
            middle = (last - first) // 2
            order[first:last] = order[first:last][np.argpartition(mine[:, axis], middle)]
            below[box] = (len(below), len(below) + 1)
            todo += [(len(below), first, first + middle), (len(below) + 1, first + middle, last)]
            below += [(0, 0), (0, 0)]
            bounds += [np.zeros(6), np.zeros(6)]
        return cls(np.array(bounds), np.array(below), np.ascontiguousarray(triangles[order]))


def first_hit(tree: Tree, origins: Array, ways: Array) -> Array:
    """See ``traced_truth.FirstHit``."""
    found = np.full(len(origins), np.inf)
    _trace(tree.bounds, tree.below, tree.triangles, origins, ways, found)
    return found


@numba.njit
def _trace(
    bounds: Array, below: NDArray[np.int64], triangles: Array, origins: Array, ways: Array, found: Array
) -> None:
    stack = np.zeros(128, dtype=np.int64)
    for ray in range(len(origins)):
        o, d, nearest = origins[ray], ways[ray], np.inf
        stack[0], height = 0, 1
        while height > 0:
            height -= 1
            box = stack[height]
            if not _enters(bounds[box], o, d, nearest):
                continue
            one, other = below[box]
            if other > 0:
                stack[height], stack[height + 1] = one, other
                height += 2
                continue
            for k in range(one, one - other):
                t = _triangle(triangles[k], o, d)
                if 1e-9 < t < nearest:
                    nearest = t
        found[ray] = nearest


@numba.njit
def _enters(box: Array, o: Array, d: Array, nearest: float) -> bool:
    low, high = 0.0, nearest
    for k in range(3):
        if d[k] == 0.0:
            if o[k] < box[k] or o[k] > box[3 + k]:
                return False
            continue
        a, b = (box[k] - o[k]) / d[k], (box[3 + k] - o[k]) / d[k]
        low, high = max(low, min(a, b)), min(high, max(a, b))
    return low <= high * (1.0 + 1e-12)


@numba.njit
def _triangle(corners: Array, o: Array, d: Array) -> float:
    """Parameter of the hit (Moeller and Trumbore); -1 for none."""
    e, f, s = corners[1] - corners[0], corners[2] - corners[0], o - corners[0]
    p = np.cross(d, f)
    det = np.dot(e, p)
    if det == 0.0:
        return -1.0
    u, q = np.dot(s, p) / det, np.cross(s, e)
    v = np.dot(d, q) / det
    return np.dot(f, q) / det if u >= 0.0 and v >= 0.0 and u + v <= 1.0 else -1.0


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--dataset", default="paper", help="whose camera and motion (default paper)")
    parser.add_argument("--scene", default="castle", help="sequence of it (default castle)")
    parser.add_argument("--pixels", type=int, default=100_000, help="of each frame (default 100000)")
    parser.add_argument("--seed", type=int, default=0, help="of the draw (default 0)")
    given = parser.parse_args(arguments)
    card = load_dataset_card(given.dataset).only([given.scene])
    # No channel depends on the light: the renderer of quick looks will do.
    card = replace(card, channels=PAIR_CHANNELS, twins=("middle", "last"), renderer="preview", sensor=None)
    scene = build_scene(card.sequence[0].scene).scene
    seen = scene.seen_from(scene.viewpoints[card.sequence[0].viewpoint], card.sequence[0].start)
    tree = Tree.of(np.concatenate([mesh.vertices[mesh.faces] for mesh in seen.meshes]).astype(np.float64))
    rng = np.random.default_rng(given.seed)
    enough = True
    with tempfile.TemporaryDirectory() as folder:
        generate_dataset(card, Path(folder) / "data")
        (sequence,) = read_dataset(Path(folder) / "data")
        size = sequence.rig.camera.width * sequence.rig.camera.height
        count = min(given.pixels, size)
        of = f"{count} of {size} pixels of 4 frames"
        sys.stdout.write(f"{given.dataset}, {given.scene}: {len(tree.triangles)} triangles, {of}\n")
        for layer in pair_layers(sequence.channels, sequence.twins):
            near, right = [], []
            for side, frame in VIEWS:
                chosen = np.sort(rng.choice(size, count, replace=False))
                world = World(partial(first_hit, tree))
                offset, classes, _ = truth(sequence, world, layer.channel, side, frame, layer.row, chosen=chosen)
                if layer.channel == "disparity":
                    offset = offset[:, :1] * (1 if side == "right" else -1)
                view = layer.channel, side, frame, layer.row
                stored = sequence.offsets(*view).reshape(size, -1)[chosen]
                kinds = sequence.classes(*view).ravel()[chosen]
                off = np.max(np.abs(stored - offset), axis=1)[classes == PixelClass.VISIBLE]
                near.append(off <= NEAR_PX)
                right.append(kinds == classes)
            shares = [float(np.mean(np.concatenate(each))) for each in (near, right)]
            enough = enough and min(shares) >= ENOUGH
            name = layer.channel + (f" to row {layer.row}" if layer.row else "")
            sys.stdout.write(
                f"{name:20} {100 * shares[0]:8.3f} % of {len(np.concatenate(near))} visible pixels within "
                f"{NEAR_PX} px {100 * shares[1]:8.3f} % of the classes\n"
            )
            sys.stdout.flush()
    return 0 if enough else 1


if __name__ == "__main__":
    sys.exit(main())
