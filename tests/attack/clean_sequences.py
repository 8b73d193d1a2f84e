"""Sound sequences of random cards, in which verify must find nothing.

Cameras and their lenses, rigs, scans, delays, sensors, channels, motions of every model, renderers, scenes and
viewpoints are drawn; motions go to 20 degrees and a metre per frame, and one scene has hardly any texture. What
``generate`` refuses, such as a way through a wall or into the sky, is drawn again. Small, so that there can be
many. Glossy surfaces are those of the street, and of the castle after rain.
"""

from __future__ import annotations

import contextlib
import re
import shutil
from collections.abc import Iterator
from collections.abc import Sequence as SequenceOf
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any, get_args

import numpy as np
from kept_scenes import kept_scenes
from small_scenes import write_box_scene

from attack.wet_castle import WET_CASTLE
from rsbench.components.cards import card_path, list_cards, parse_card
from rsbench.components.rig_tables import RigTables, tables_of
from rsbench.core import so3
from rsbench.core.camera import Lens, PinholeCamera
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import SIDES, StereoRig
from rsbench.core.shutter import Scan, Scanning
from rsbench.dataset import generation
from rsbench.dataset.card import CameraCard, DatasetCard, MotionCard, SequenceCard
from rsbench.dataset.channels import CHANNELS, Channel, check_channels
from rsbench.dataset.motion_cards import TAKEN, MovingCard
from rsbench.renderers.image import Mosaic, Sensor
from rsbench.scenes.load import load_scene, read_scene_card
from rsbench.scenes.model import Scene
from rsbench.verification import verify_dataset

MODELS = ("linear", "twist", "accelerated", "spline")
PER_DATASET = 3
"""Sequences of one viewpoint, camera, shutter and renderer."""
MOST_DRAWS = 50
"""Motions of one sequence, of which ``generate`` must take one."""
RENDERERS = {
    "one": 'integrator = "sunsky"\nsamples = 1\n',
    "four": 'integrator = "sunsky"\nsamples = 4\n',
    "hidden": 'integrator = "sunsky"\nsamples = 4\nsky_rays = 2\n',
    "sixteen": 'integrator = "sunsky"\nsamples = 16\nexposure = 1.6\n',
    "traced": 'integrator = "path"\nsamples = 4\nmax_depth = 3\n',
}

DIRECT = [name for name in RENDERERS if name != "traced"]


def random_cards(count: int, folder: Path, seed: int, chosen: SequenceOf[str] = ()) -> Iterator[DatasetCard]:
    """Cards of ``count`` sequences in all, of all scenes or those chosen.

    Those of one scene follow each other, as it is built once.
    """
    rng = np.random.default_rng(seed)
    for name, text in RENDERERS.items():
        (folder / f"{name}.toml").write_text(f'description = "{name}"\n{text}')
    plain = str(write_box_scene(folder, "plain", (2, 2)))
    every = [plain, *(name for name in list_cards("scenes") if name != "mesh"), str(WET_CASTLE)]
    scenes = [name for name in every if not chosen or Path(name).stem in chosen]
    datasets = -(-count // PER_DATASET)
    for number in range(datasets):
        scene = scenes[number * len(scenes) // datasets]
        yield _card(rng, number, scene, folder, min(PER_DATASET, count - number * PER_DATASET))


def _card(rng: np.random.Generator, number: int, scene: str, folder: Path, sequences: int) -> DatasetCard:
    path = Path(scene) if scene.endswith(".toml") else list_cards("scenes")[scene]
    viewpoint = str(rng.choice(list(read_scene_card(path)[0].viewpoints)))
    camera, scanning, period = _camera(rng), _scanning(rng), float(rng.uniform(0.01, 0.2))
    card = DatasetCard(
        name=f"random-{number}",
        camera=camera,
        baseline=float(rng.uniform(0.05, 0.6)),
        readout_ratio=float(rng.choice([0.0, 1.0, rng.uniform(0, 1)])),
        frame_period_s=period,
        scan=scanning.scan,
        right_scan=scanning.right_scan,
        right_delay=scanning.right_delay,
        sensor=_sensor(rng, period),
        channels=_channels(rng, camera.lens is not None, scanning),
        twins=("middle", "last") if rng.random() < 0.3 and _in_one_direction(scanning) else (),
        motion=_motion(rng),
        renderer=str(folder / f"{'traced' if number % 2 else rng.choice(DIRECT)}.toml"),
        seed=int(rng.integers(1000)),
        sequence=tuple(
            SequenceCard(name=f"s{k}", scene=scene, viewpoint=viewpoint, motion=_motion(rng))
            for k in range(sequences)
        ),
    )
    return _with_rig(_with_moving(card, number), number).expanded()


def _with_rig(card: DatasetCard, number: int) -> DatasetCard:
    """Every third card with two cameras that differ and look in different directions; drawn by themselves."""
    if number % 3 != 1:
        return card
    rng = np.random.default_rng([card.seed, number, 1])
    while True:
        left, right = (_pinhole(rng) for _ in SIDES)
        place = card.baseline * np.array([-1.0, *rng.uniform(-0.3, 0.3, 2)])
        place = place[[1, 0, 2]] if rng.random() < 0.3 else place  # one above the other
        with contextlib.suppress(ValueError):
            rig = StereoRig.of_cameras(left, right, so3.exp(rng.uniform(-0.15, 0.15, 3)), place)
            break
    own = replace(
        card,
        camera=None,  # pyrefly: ignore[bad-argument-type]
        baseline=None,  # pyrefly: ignore[bad-argument-type]
        rig=parse_card(RigTables, tables_of(rig), "rig"),
        right_readout_ratio=[None, 0.0, float(rng.uniform(0, 1))][rng.integers(3)],
        twins=(),
        channels=(),
    )
    channels = _channels(np.random.default_rng(card.seed), True, own)
    known = TAKEN if card.sequence[0].moving else channels
    return replace(own, channels=tuple(each for each in channels if each in known))


def _pinhole(rng: np.random.Generator) -> PinholeCamera:
    """A camera whose centre is not quite in the middle, of any lens model."""
    width, height = (int(size) for size in rng.integers(48, 97, 2))
    fx, fy = width * rng.uniform(0.7, 1.6) * rng.uniform(0.95, 1.05, 2)
    cx, cy = (np.array([width, height]) - 1) / 2 + rng.uniform(-4, 4, 2)
    while True:
        lens = _lens(rng)
        if rng.random() < 0.2:
            k = rng.uniform(-0.2, 0.2, 4)
            lens = Lens(model="rational", k1=k[0], k2=k[1], k4=k[2], k5=0.2 * k[3])
        elif rng.random() < 0.2:
            lens = Lens(model="double-sphere", xi=rng.uniform(-0.3, 0.3), alpha=rng.uniform(0.4, 0.7))
        with contextlib.suppress(ValueError):
            return PinholeCamera(width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy, lens=lens)


def _with_moving(card: DatasetCard, number: int) -> DatasetCard:
    """Every fourth card with one to three boxes that move, before the rig; drawn by themselves.

    Half of these are of three frames.
    """
    if number % 4 != 2:
        return card
    rng = np.random.default_rng([card.seed, number])
    sequences = tuple(replace(each, moving=_boxes(rng)) for each in card.sequence)
    renderer = card.renderer.replace("hidden.toml", "four.toml")  # whose rays to the sky know nothing of them
    return replace(
        card,
        renderer=renderer,
        frames=3 if number % 8 == 6 else 2,
        sequence=sequences,
        channels=tuple(each for each in card.channels if each in TAKEN),
    )


def _boxes(rng: np.random.Generator) -> tuple[MovingCard, ...]:
    return tuple(
        MovingCard(
            box=tuple(rng.uniform(0.1, 0.8, 3).tolist()),
            position=tuple((rng.uniform(-0.4, 0.4, 3) * (1, 1, 0) * depth + (0, 0, depth)).tolist()),
            attitude_deg=tuple(rng.uniform(-90, 90, 3).tolist()),
            texture_seed=int(rng.integers(1000)),
            motion=_motion(rng),
        )
        for depth in rng.uniform(1.5, 5.0, rng.integers(1, 4))
    )


def _camera(rng: np.random.Generator) -> CameraCard:
    """Half of them with a lens; one that folds inside the image is drawn again."""
    width, height = (int(size) for size in rng.integers(48, 97, 2))
    focal = float(width * rng.uniform(0.6, 2.0))
    while True:
        camera = CameraCard(width=width, height=height, focal=focal, lens=_lens(rng))
        with contextlib.suppress(ValueError):
            replace(PinholeCamera.centred(width, height, focal), lens=camera.lens)
            return camera


def _lens(rng: np.random.Generator) -> Lens | None:
    k = rng.uniform(-1, 1, 4)
    kind = rng.choice(["none", "none", "brown-conrady", "kannala-brandt"])
    if kind == "none":
        return None
    if kind == "brown-conrady":
        p1, p2 = 0.005 * rng.uniform(-1, 1, 2)
        return Lens(model="brown-conrady", k1=0.3 * k[0], k2=0.1 * k[1], p1=p1, p2=p2, k3=0.02 * k[2])
    return Lens(model="kannala-brandt", k1=0.08 * k[0], k2=0.03 * k[1], k3=0.01 * k[2], k4=0.003 * k[3])


def _scanning(rng: np.random.Generator) -> Scanning:
    """Half of them from the top at once."""
    if rng.random() < 0.5:
        return Scanning()
    scan, right = (get_args(Scan)[k] for k in rng.integers(len(get_args(Scan)), size=2))
    delay = float(rng.choice([0.0, rng.uniform(-0.5, 0.5)]))
    return Scanning(scan=scan, right_scan=right if rng.integers(2) else None, right_delay=delay)


def _in_one_direction(scanning: Scanning) -> bool:
    """Whether both cameras read rows, or both columns."""
    return len({scan in ("top", "bottom") for scan in (scanning.scan, scanning.right_scan or scanning.scan)}) == 1


def _sensor(rng: np.random.Generator, period: float) -> Sensor | None:
    """Half of them ideal; of the others some blur, some are noisy, some both."""
    if rng.random() < 0.5:
        return None
    noisy = bool(rng.random() < 0.7)
    return Sensor(
        exposure_s=float(rng.choice([0.0, rng.uniform(0, 0.5), rng.uniform(0, 0.5)])) * period,
        full_well=float(rng.uniform(2000, 30000)),
        gain=float(2.0 ** rng.integers(4)),
        photon_noise=noisy,
        read_noise=float(rng.uniform(0, 5)) if noisy else 0.0,
        dark_current=float(rng.uniform(0, 50)) if noisy else 0.0,
        bit_depth=int(rng.choice([0, 8, 10, 12])),
        vignetting=float(rng.choice([0.0, rng.uniform(0, 0.5)])),
        **_processing(rng),
    )


def _processing(rng: np.random.Generator) -> dict[str, Any]:
    """A third each: what all sensors had once, both cameras alike, and unlike."""
    own: dict[str, Any] = {}
    for side in ("", "right_")[: int(rng.integers(3))]:
        own[f"{side}mosaic"] = get_args(Mosaic)[rng.integers(len(get_args(Mosaic)))]
        own[f"{side}jpeg_quality"] = int(rng.choice([0, *rng.integers([1, 50], [50, 101])]))
    return own


def _channels(rng: np.random.Generator, bent: bool, scanning: Scanning) -> tuple[Channel, ...]:
    """Some of those that cameras with lenses, or not rectified, or others can have."""
    chosen: list[Channel] = []
    for channel in CHANNELS:
        with contextlib.suppress(ValueError):
            check_channels((*chosen, channel), bent, scanning.plain)
            chosen += [channel] if rng.random() < 0.5 else []
    return tuple(chosen)


def _motion(rng: np.random.Generator) -> MotionCard:
    return MotionCard(
        model=str(rng.choice(MODELS)),
        rotation_deg=float(rng.choice([0.0, rng.uniform(0, 2), rng.uniform(2, 20)])),
        rotation_axis="random",
        translation=float(rng.choice([0.0, rng.uniform(0, 0.2), rng.uniform(0.2, 1)])),
        translation_axis="random",
    )


def _generated(card: DatasetCard, out: Path) -> int:
    """Make a dataset, with other motions where ``generate`` refuses one; returns how many it did."""
    rng = np.random.default_rng(card.seed)
    for draws in range(MOST_DRAWS * len(card.sequence)):
        try:
            generation.generate_dataset(card, out)
        except RsbenchError as error:
            blocked = re.match(
                r"sequence (\S+): (the \S+ camera (goes through a surface|and moving)|\S+ shows no surface)",
                str(error),
            )
            if not blocked:
                raise
            others = (
                replace(each, motion=_motion(rng)) if each.name == blocked[1] else each for each in card.sequence
            )
            card = replace(card, sequence=tuple(others)).expanded()
        else:
            return draws
    raise RuntimeError(f"{card.name}: every motion is refused")


def _words(card: DatasetCard) -> str:
    """What is special about a card."""
    words = [Path(card.sequence[0].scene).stem, Path(card.renderer).stem]
    rig = card.rig_of(card.sequence[0])
    lenses = [rig.sensor(side).lens for side in (SIDES[:1] if rig.aligned else SIDES)]
    words += ["rig"] * (not rig.aligned) + [lens.model for lens in lenses if lens]
    words += [] if card.plain else [f"{card.scan}/{card.right_scan}/{card.right_delay:.2f}"]
    words += [f"exposure {card.sensor.exposure_s:.3f}"] if card.sensor else []
    words += ["twins"] if card.twins else []
    words += ["moving"] if card.sequence[0].moving else []
    return ", ".join([*words, *card.channels])


def false_alarms(
    count: int, folder: Path, seed: int = 0, chosen: SequenceOf[str] = ()
) -> Iterator[tuple[str, int, int, list[str]]]:
    """Of each dataset its name, how many sequences it has, motions that were refused, and what verify found."""
    built = lru_cache(maxsize=1)(load_scene)

    def loaded(name: str | Path) -> Scene:
        return built(card_path("scenes", name))

    with kept_scenes(loaded):
        for card in random_cards(count, folder, seed, chosen):
            out = folder / card.name
            refused = _generated(card, out)
            reports = verify_dataset(out, rerender="auto", scenes=[folder / "plain.toml", WET_CASTLE])
            found = [f"{report.name}: {fault}" for report in reports for fault in report.faults]
            yield f"{card.name} ({_words(card)})", len(card.sequence), refused, found
            if not found:
                shutil.rmtree(out)
