"""Train a small network on rolling-shutter frames of rsbench; score it before and after on frames it never saw.

pip install rsbench[torch]
python examples/learn_flow.py --out out/learn                                # renders, trains, scores
python examples/learn_flow.py --out out/learn --public DeepUnrollNet/demo    # the twelve published pairs too
python examples/learn_flow.py --out out/learn --predict inputs               # an entry of the leaderboard

The network sees two frames of one camera and says the flow from the second one to the first; the times of the
rows scale it to the flow to any row's time, the middle one's among them. Untrained, it says 0, and the frame stays
as it was read. It learns from the dataset card ``learn`` (outdoors) where each pixel goes, by rsbench's depth and
poses, and is scored on ``learn-test`` (indoors), beside DIS of OpenCV, which never learned: the corrector
``flow-scaled``. The same command goes on where it was stopped.
"""

from __future__ import annotations

import argparse
import csv
import itertools
import json
import math
import sys
import time
from collections.abc import Sequence as Series
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from rsbench.benchmark.statistics import FEW, average_interval, median_interval
from rsbench.core.camera import PinholeCamera
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import SIDES, Side, StereoRig
from rsbench.core.se3 import compose, inverse
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.dataset.card import load_dataset_card
from rsbench.dataset.generation import generate_dataset, steps_of
from rsbench.dataset.sequence import Sequence, read_dataset
from rsbench.pipeline.footage import read_frame
from rsbench.storage.files import read_json, write_png
from rsbench.vision.images import grey_u8
from rsbench.vision.mono_fusion import Flows, MonoFusion, OwnMotion, find_flows
from rsbench.vision.quality import psnr_deepunroll

try:
    import torch
    from torch import nn
except ImportError:
    sys.stderr.write("learn_flow.py: torch is not installed: pip install rsbench[torch]\n")
    sys.exit(2)

SEED, BATCH, RATE, KEEP_EVERY, REACH = 1, 6, 1.5e-3, 50, 2
WIDTH, WIDEST = 128, 384
"""Columns that are learned from at a time (of rows all, for their times differ), and that are seen at most."""
HEAD = "| frames | untrained | trained | DIS | gain of training | better | px off: untrained | trained | DIS |"
F32 = NDArray[np.float32]
MIRROR = np.array([1, -1], dtype=np.float32)


class Pair(NamedTuple):
    """Two successive frames of one camera, (H, W, 3) uint8, whose rows are read from the top."""

    first: NDArray[np.uint8]
    second: NDArray[np.uint8]


def turned(pair: Pair) -> Pair:
    """The same while time runs backwards, upside down: rows are again read from the top, the first frame last."""
    return Pair(np.ascontiguousarray(pair.second[::-1]), np.ascontiguousarray(pair.first[::-1]))


def true_shift(sequence: Sequence, side: Side, frame: int, row: float) -> F32:
    """(H, W, 2) px from each pixel of a frame to where the camera sees its point at the time of ``row``.

    Hidden there or not; sky by its direction alone.
    """
    rig = sequence.rig
    target = rig.cam_from_world(sequence.motion, sequence.shutter.row_time(row, frame), side)
    R, t = compose(target, inverse(sequence.poses(side, frame)[1]))
    depth = sequence.depth("rs", side, frame).astype(np.float64)
    near = np.divide(1.0, depth, out=np.zeros_like(depth), where=depth > 0)[..., None]
    pixels = rig.camera.pixel_grid()
    moved = (R[:, None] @ rig.camera.unproject(pixels)[..., None])[..., 0] + near * t[:, None]
    return (rig.camera.project(moved) - pixels).astype(np.float32)


class FlowNet(nn.Module):
    """Two grey frames (n, 2, H, W) to the flow from the second one to the first, at three sizes, the finest last.

    Each (n, 2, H, W), px; untrained, 0. From coarse to fine: the first frame's features are moved by the flow so
    far and compared with the second one's up to ``REACH`` px around, which tells what is missing.
    """

    def __init__(self, widths: Series[int] = (12, 24, 32, 48)) -> None:
        super().__init__()
        ways = zip((4, *widths), widths, (1, 2, 2, 2), strict=False)
        self.encode = nn.ModuleList(_convolutions(*way) for way in ways)
        seen = [(2 * REACH + 1) ** 2 + width + 3 for width in widths[:0:-1]]
        self.decode = nn.ModuleList(_convolutions(inputs, 40) for inputs in seen)
        self.heads = nn.ModuleList(nn.Conv2d(40, 2, 3, padding=1) for _ in seen)
        for each in (part for head in self.heads for part in head.parameters()):
            nn.init.zeros_(each)

    def forward(self, frames: Any) -> list[Any]:
        height, width = frames.shape[-2:]
        whole = nn.functional.pad(frames, (0, -width % 16, 0, -height % 16), mode="replicate")
        known = nn.functional.pixel_unshuffle(whole.flatten(0, 1)[:, None], 2)
        levels = []
        for step in self.encode:
            known = step(known)
            levels.append(nn.functional.normalize(known.unflatten(0, (-1, 2)), dim=2).unbind(1))
        flow, found = torch.zeros_like(levels[-1][0][:, :2]), list[Any]()
        for (first, second), decode, head in zip(levels[:0:-1], self.decode, self.heads, strict=True):
            size = second.shape[-2:]
            flow = nn.functional.interpolate(flow, size=size, mode="bilinear") * (size[0] / flow.shape[-2])
            row = torch.linspace(-1, 1, size[0])[:, None].expand(len(flow), 1, *size)
            met = compared(second, moved(first, flow))
            flow = flow + head(decode(torch.cat([met, second, flow, row], dim=1)))
            full = nn.functional.interpolate(flow, size=whole.shape[-2:], mode="bilinear")
            found.append(full[..., :height, :width] * (whole.shape[-2] / size[0]))
        return found


def moved(features: Any, flow: Any) -> Any:
    """Features (n, C, H, W) where the flow (n, 2, H, W), px, leads; beyond the border those of the border."""
    height, width = flow.shape[-2:]
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    places = torch.stack([(x + flow[:, 0] + 0.5) * (2 / width) - 1, (y + flow[:, 1] + 0.5) * (2 / height) - 1], -1)
    return nn.functional.grid_sample(features, places, padding_mode="border", align_corners=False)


def compared(second: Any, first: Any) -> Any:
    """(n, (2 REACH + 1)^2, H, W) cosines of each place of the second frame and its surroundings in the first."""
    (height, width), reach = second.shape[-2:], range(2 * REACH + 1)
    around = nn.functional.pad(first, (REACH,) * 4)
    parts = (around[..., v : v + height, u : u + width] for v in reach for u in reach)
    return torch.stack([(second * part).sum(1) for part in parts], dim=1)


def _convolutions(inputs: int, outputs: int, stride: int = 1) -> Any:
    first = nn.Conv2d(inputs, outputs, 3, stride, padding=1)
    return nn.Sequential(first, nn.LeakyReLU(0.1), nn.Conv2d(outputs, outputs, 3, padding=1), nn.LeakyReLU(0.1))


class Samples(NamedTuple):
    """What is learned from: (n, 2, H, W) grey, uint8; (n,) readout time over frame period; (n, 3, 2, H, W)
    px, float16, to where each pixel's point is at the times of the first, the middle and the last row."""

    frames: Any
    ratio: Any
    shift: Any


def read_samples(sequences: Series[Sequence]) -> Samples:
    """Both frames of both cameras: the second one, and the first one as ``turned`` shows it."""
    found: list[tuple[Any, ...]] = []
    for number, sequence in enumerate(sequences):
        height, ratio = sequence.rig.camera.height, sequence.shutter.readout_ratio
        rows = (0, height // 2, height - 1)
        for side in SIDES:
            pair = Pair(sequence.image("rs", side, 0), sequence.image("rs", side, 1))
            later = [true_shift(sequence, side, 1, row) for row in rows]
            sooner = [true_shift(sequence, side, 0, height - 1 - row)[::-1] * MIRROR for row in rows]
            for each, shifts in ((pair, later), (turned(pair), sooner)):
                shift = np.moveaxis(np.stack(shifts), -1, 1).astype(np.float16)
                found.append((np.stack([grey_u8(image) for image in each]), np.float32(ratio), shift))
        progress("reading", number + 1, len(sequences))
    return Samples(*(torch.from_numpy(np.stack(part)) for part in zip(*found, strict=True)))


def loss_of(flow: Any, ratio: Any, shift: Any) -> Any:
    """Mean distance, px, between where flow (n, 2, H, W), scaled by the times of rows, and the truth lead.

    A flow that ends dy rows farther down has taken ``ratio dy / H - 1`` frame periods. The rest as in ``Samples``.
    """
    height = flow.shape[-2]
    rows = torch.tensor((0.0, height // 2, height - 1))[:, None] - torch.arange(height)
    ahead = (ratio[:, None, None] * rows / height)[:, :, None, :, None]
    passed = (ratio[:, None, None] * flow[:, 1] / height - 1).clamp(max=-0.1)[:, None, None]
    off = ahead / passed * flow[:, None] - shift
    return (off.square().sum(2) + 1e-4).sqrt().mean()


def drawn(samples: Samples, step: int) -> Samples:
    """A batch of step ``step``, cut and some of it mirrored, whatever was drawn before; frames as ``scaled``."""
    rng = np.random.default_rng([SEED, step])
    chosen = torch.from_numpy(rng.choice(len(samples.ratio), min(BATCH, len(samples.ratio)), replace=False))
    left = int(rng.integers(0, max(samples.frames.shape[-1] - WIDTH, 0) + 1))
    frames = samples.frames[chosen][..., left : left + WIDTH]
    shift = samples.shift[chosen][..., left : left + WIDTH].float()
    for index in np.flatnonzero(rng.random(len(chosen)) < 0.5):
        frames[index], shift[index] = frames[index].flip(-1), shift[index].flip(-1)
        shift[index, :, 0] *= -1
    return Samples(scaled(frames), samples.ratio[chosen], shift)


def scaled(frames: Any) -> Any:
    """Grey levels (n, 2, H, W) around 0, about 1 apart."""
    return (frames.float() - frames.float().mean((1, 2, 3), keepdim=True)) / 64


def train(net: FlowNet, samples: Samples, steps: int, kept: Path) -> None:
    """``steps`` steps of AdamW; ``kept`` holds all of the state, and from there it goes on."""
    optimiser = torch.optim.AdamW(net.parameters(), lr=RATE)
    start, losses = restored(net, optimiser, steps, kept), list[float]()
    for step in range(start, steps):
        rate = RATE * min(1.0, (step + 1) / 50) * 0.5 * (1 + math.cos(math.pi * step / steps))
        optimiser.param_groups[0]["lr"] = rate
        batch = drawn(samples, step)
        each = [loss_of(flow, batch.ratio, batch.shift) for flow in net(batch.frames)]
        loss = each[-1] + 0.5 * sum(each[:-1])
        optimiser.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(net.parameters(), 1.0)
        optimiser.step()
        losses.append(each[-1].item())
        if (step + 1) % KEEP_EVERY == 0 or step + 1 == steps:
            state = {"net": net.state_dict(), "optimiser": optimiser.state_dict(), "steps": (step + 1, steps)}
            torch.save(state, kept.with_suffix(".part"))
            kept.with_suffix(".part").replace(kept)
        progress(f"training, {np.mean(losses[-KEEP_EVERY:]):.3f} px off,", step + 1, steps)


def restored(net: FlowNet, optimiser: Any, steps: int, kept: Path) -> int:
    """The step to go on from; 0 where there is no state of a training of so many steps."""
    try:
        state = torch.load(kept, weights_only=True) if kept.is_file() else {"steps": (0, 0)}
        done, of = state["steps"]
        if of != steps:
            return 0
        net.load_state_dict(state["net"])
        if optimiser is not None:
            optimiser.load_state_dict(state["optimiser"])
    except Exception as error:  # of torch, whatever is wrong
        raise RsbenchError(f"{kept}: is no state of this program: delete it") from error
    return int(done)


def learned_flows(net: FlowNet, pair: Pair) -> Flows:
    """Both ways; what it leads back to is not looked at."""
    flows = (_flow(net, turned(pair))[::-1] * MIRROR, _flow(net, pair))
    return Flows(flows, (np.zeros_like(flows[0][..., 0]), np.zeros_like(flows[1][..., 0])))


def _flow(net: FlowNet, pair: Pair) -> F32:
    """(H, W, 2) px from the second frame to the first; frames wider than ``WIDEST`` are made smaller for it."""
    height, width = pair.second.shape[:2]
    factor = -(-width // WIDEST)
    size = (width // factor, height // factor)
    grey = np.stack([cv2.resize(grey_u8(image), size, interpolation=cv2.INTER_AREA) for image in pair])
    with torch.no_grad():
        flow = net(scaled(torch.from_numpy(grey)[None]))[-1][0].numpy()
    larger = np.array([width / size[0], height / size[1]], dtype=np.float32)
    return np.stack([cv2.resize(part, (width, height)) for part in flow], axis=-1) * larger


def fusion(pair: Pair, flows: Flows, ratio: float) -> MonoFusion:
    """Ready to correct the pair by flows alone, as the corrector ``flow-scaled`` does; its camera is not used."""
    height, width = pair.second.shape[:2]
    rig = StereoRig(camera=PinholeCamera.centred(width, height, float(width)), baseline=1.0)
    shutter = RollingShutter(height=height, readout_ratio=ratio)
    still = OwnMotion(rig=rig, shutter=shutter, side="left", motion=None)
    return MonoFusion(list(pair), still, flows)


def score_pair(net: FlowNet, pair: Pair, ratio: float, truth: NDArray[Any], shift: F32 | float) -> FloatArray:
    """(6,) at the middle row's time: PSNR of all pixels untrained, trained and of DIS; px off the true shift."""
    height = len(truth)
    grid = PinholeCamera.centred(truth.shape[1], height, 1.0).pixel_grid()
    tau = 1.0 + ratio * (height // 2) / height
    figures, off = list[float](), list[float]()
    for flows in (learned_flows(FlowNet(), pair), learned_flows(net, pair), find_flows(list(pair))):
        made = fusion(pair, flows, ratio)
        figures.append(psnr_deepunroll(made.corrected(1, tau).image, truth))
        off.append(float(np.mean(np.linalg.norm(made.places(1, tau)[..., :2] - grid - shift, axis=-1))))
    return np.array(figures + off)


def score_sequence(net: FlowNet, sequence: Sequence) -> FloatArray:
    """The mean of both cameras."""
    row, scores = sequence.rig.camera.height // 2, list[FloatArray]()
    for side in SIDES:
        pair = Pair(sequence.image("rs", side, 0), sequence.image("rs", side, 1))
        truth, shift = sequence.image("gs", side, 1, row), true_shift(sequence, side, 1, row)
        scores.append(score_pair(net, pair, sequence.shutter.readout_ratio, truth, shift))
    return np.mean(scores, axis=0)


def score_public(net: FlowNet, folder: Path) -> list[FloatArray]:
    """Of pairs of frames and the truth at the middle row, as DeepUnrollNet has them: ``seq_01/rs_0.png``."""
    scores = []
    for place in sorted(each for each in folder.iterdir() if each.is_dir()):
        first, second, truth = (read_frame(place / f"{name}.png")[..., :3] for name in ("rs_0", "rs_1", "gs_1"))
        scores.append(score_pair(net, Pair(first, second), 1.0, truth, np.nan))
    return scores


def line_of(name: str, scores: Series[FloatArray]) -> str:
    """A row of the table: means; the gain with its interval of 95 % over sequences, of few the median's."""
    table = np.array(scores)
    gains = table[:, 1] - table[:, 0]
    few, mean = len(gains) < FEW, table.mean(axis=0)
    low, high = median_interval(gains) if few else average_interval(gains, SEED)
    off = " | ".join("-" if np.isnan(value) else f"{value:.2f}" for value in mean[3:])
    figures = " | ".join(f"{value:.2f}" for value in mean[:3])
    gain = f"{np.median(gains) if few else gains.mean():+.2f} [{low:+.2f}, {high:+.2f}]"
    return f"| {name} | {figures} | {gain} | {np.sum(gains > 0)} of {len(gains)} | {off} |"


def predict(net: FlowNet, inputs: Path, out: Path, method: str) -> None:
    """An entry of the track correction-mono for what ``rsbench leaderboard export`` wrote."""
    split = read_json(inputs / "split.json")
    problems = [json.loads(line) for line in (inputs / "problems.jsonl").read_text("utf-8").splitlines()]
    with (inputs / "pictures.csv").open(encoding="utf-8", newline="") as file:
        asked = list(csv.DictReader(file))
    head = {"protocol": split["protocol"], "split": split["split"], "method": method, "tuned_on": "learn"}
    about = {"uses": ["readout", "images", "time"], "description": "a small network that learned from rsbench"}
    answers: list[dict[str, Any]] = [head | about]
    for number, problem in enumerate(problems):
        name, start = problem["name"], time.perf_counter()
        first, second = (read_frame(inputs / "frames" / name / f"left_{frame}.png") for frame in (0, 1))
        pair = Pair(first, second)
        made = fusion(pair, learned_flows(net, pair), problem["readout_ratio"])
        (out / "pictures" / name).mkdir(parents=True, exist_ok=True)
        for each in (each for each in asked if each["name"] == name):
            file = out / "pictures" / name / f"{each['picture']}.png"
            write_png(file, made.corrected(1, float(each["time"])).image)
        answers.append({"name": name, "seconds": round(time.perf_counter() - start, 3)})
        progress("correcting", number + 1, len(problems))
    text = "\n".join(map(json.dumps, answers)) + "\n"
    (out / "predictions.jsonl").write_text(text, encoding="utf-8", newline="\n")


def progress(what: str, done: int, of: int) -> None:
    if 100 * done // of > 100 * (done - 1) // of:  # another percent
        sys.stderr.write(f"\r{what} {done} of {of}" + ("\n" if done == of else ""))
        sys.stderr.flush()


def rendered(name: str, out: Path, workers: int) -> list[Sequence]:
    """The sequences of a dataset card; those that ``out`` holds are kept."""
    card, done, told = load_dataset_card(name), itertools.count(1), f"rendering {name}, step"
    steps = len(card.sequence) * steps_of(card)
    generate_dataset(card, out, workers=workers, progress=lambda _: progress(told, next(done), steps))
    return read_dataset(out)


def print_table(net: FlowNet, chosen: argparse.Namespace) -> None:
    held = [score_sequence(net, each) for each in rendered("learn-test", chosen.out / "test", chosen.workers)]
    lines = [HEAD, "|---" * 9 + "|", line_of(f"`learn-test`, {len(held)} sequences", held)]
    for name in ("Carla", "Fastec") if chosen.public else ():
        scores = score_public(net, chosen.public / name)
        lines.append(line_of(f"{name}-RS, {len(scores)} pairs", scores))
    sys.stdout.write("\n".join(lines) + "\n")


def count(word: str) -> int:
    if not word.isdecimal() or int(word) < 1:
        raise argparse.ArgumentTypeError(f"{word!r} must be a whole number, 1 at least")
    return int(word)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder of data and network")
    parser.add_argument("--steps", type=count, default=1800, help="of training; others start anew (%(default)s)")
    parser.add_argument("--workers", type=count, default=2, help="processes that render (default: %(default)s)")
    parser.add_argument("--public", type=Path, metavar="DIR", help="folder with Carla/seq_01 and Fastec/seq_01")
    parser.add_argument("--predict", type=Path, metavar="DIR", help="of leaderboard export: write OUT/entry alone")
    parser.add_argument("--method", default="learned-flow", help="its name on a board (default: %(default)s)")
    chosen = parser.parse_args()
    try:
        run(chosen)
    except (RsbenchError, OSError) as error:
        parser.exit(2, f"learn_flow.py: {error}\n")


def run(chosen: argparse.Namespace) -> None:
    """Raises RsbenchError and OSError on files that are missing or wrong."""
    if chosen.public and not (chosen.public / "Carla").is_dir():
        raise RsbenchError(f"--public {chosen.public}: has no folder Carla; give demo/ of DeepUnrollNet")
    chosen.out.mkdir(parents=True, exist_ok=True)
    torch.manual_seed(SEED)
    torch.set_num_threads(1)  # the same sums on every machine, and no waiting for cores that others use
    net, kept = FlowNet(), chosen.out / "net.pt"
    trained = restored(net, None, chosen.steps, kept) == chosen.steps
    if chosen.predict:
        if not trained:
            raise RsbenchError(f"{kept}: no network of {chosen.steps} steps: run without --predict first")
        return predict(net, chosen.predict, chosen.out / "entry", chosen.method)
    if not trained:
        train(net, read_samples(rendered("learn", chosen.out / "learn", chosen.workers)), chosen.steps, kept)
    print_table(net, chosen)


if __name__ == "__main__":
    main()
