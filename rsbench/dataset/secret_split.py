"""Secret datasets: of a card, with scenes, motions, noise, order and names from a secret text.

Whoever has the text draws the same card again. What is drawn for one purpose reveals nothing of what is drawn for
another, nor of the text: all are hashes of it, each with a word of its own before it. A text is announced by such
a hash too, which is not the seed of anything.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path

from rsbench.components.cards import card_path
from rsbench.core.errors import RsbenchError, naming
from rsbench.dataset.card import DatasetCard, MotionCard, SequenceCard, Variation, read_dataset_card
from rsbench.scenes.load import read_scene_card
from rsbench.storage.untrusted_files import read_text

SHORTEST = 16
"""Characters of a secret: shorter ones could be tried."""
_LEAST = 0.7
"""Smallest secret share of the card's rotation, translation and readout ratio: the card itself is public."""
_BITS = 62
"""Bits of a seed, which TOML and others store in 64 bits with a sign."""
_SEED = re.compile(r"^seed *=.*\n", re.MULTILINE)


@dataclass(frozen=True)
class Secret:
    """A text that nobody can guess."""

    text: str = field(repr=False)

    def digest(self, *words: object) -> bytes:
        """32 bytes for a purpose."""
        purpose = "/".join(("rsbench", *map(str, words)))
        return hashlib.sha256(f"{purpose}\n{self.text}".encode()).digest()

    def number(self, *words: object) -> int:
        """A seed for a purpose."""
        return int.from_bytes(self.digest("number", *words), "big") >> (256 - _BITS)

    def share(self, *words: object) -> float:
        """A number in [0, 1) for a purpose."""
        return int.from_bytes(self.digest("share", *words)[:6], "big") / 2**48

    @property
    def commitment(self) -> str:
        """Announces the text without telling it: SHA-256 in hex digits."""
        return self.digest("commitment").hex()


def read_secret(path: Path) -> Secret:
    """The text of a file, without white space around it.

    Raises:
        RsbenchError: the file cannot be read, or its text is too short to be a secret.
    """
    text = read_text(path, 4096).strip()
    if len(text) < SHORTEST:
        raise RsbenchError(
            f"{path}: holds {len(text)} characters: a secret seed needs {SHORTEST}, drawn at random"
        )
    return Secret(text)


def open_split(name_or_path: str, word: str) -> Secret:
    """What a split of a name that all know is drawn from: the same for whoever names the same card and split."""
    return Secret(f"open split {word} of {card_path('datasets', name_or_path).stem}")


def secret_card(
    name_or_path: str, secret: Secret, scenes: Path | None = None, *, split: str = "test", count: int | None = None
) -> DatasetCard:
    """A card of which every sequence has a motion and noise of its own, and a name without meaning.

    Each combination of the card's sequences, grid and seeds is there, in a secret order. Sequences do not share a
    motion, as they do in the card; rotation, translation and readout ratio are 0.7 to 1 times the card's.

    Args:
        name_or_path: of a card whose motions are random.
        secret: from which all is drawn.
        scenes: folder of the scenes that ``write_scenes`` wrote; without it the card keeps the names of its own,
            and is good for its motions alone.
        split: what stands behind the name of the card.
        count: sequences, in place of as many as the card has; beyond these the card is drawn again, with scenes of
            its own.

    Raises:
        RsbenchError: the card cannot be read, or something that a split must hide is fixed in it.
    """
    path = card_path("datasets", name_or_path)
    card = read_dataset_card(path)
    if card.trajectory is not None:
        raise RsbenchError(f"{path}: trajectory: everybody who has the file knows the motion; take random axes")
    made = list[SequenceCard]()
    with naming(path):
        for number in range(_rounds(card, count)):
            drawn = [_drawn(each, secret, _again(number)) for each in _single(card, secret, number)]
            drawn.sort(key=lambda sequence: secret.digest("order", sequence.name, *_again(number)))
            if scenes is not None:
                drawn = [replace(each, scene=str(_place(scenes, _scene(each.scene), number))) for each in drawn]
            made += drawn
    made = made[:count]
    digits = len(str(len(made) - 1))
    named = tuple(replace(each, name=f"s{number:0{digits}d}") for number, each in enumerate(made))
    return replace(card, name=f"{card.name}-{split}", sequence=named, grid={}, seeds=(), readout_range=None)


def write_scenes(name_or_path: str, secret: Secret, folder: Path, count: int | None = None) -> list[Path]:
    """Write the scene cards of a dataset card with secret seeds into a folder: other textures and other details.

    ``count``: of sequences, as of ``secret_card``.

    Raises:
        RsbenchError: a card cannot be read, or its scene is the same with any seed.
    """
    dataset = read_dataset_card(card_path("datasets", name_or_path))
    cards, rounds = {_scene(each.scene) for each in dataset.sequence}, range(_rounds(dataset, count))
    written = []
    for path in sorted(cards, key=lambda card: card.stem):
        if not read_scene_card(path)[1].closed:
            raise RsbenchError(
                f"scene {path.stem}: is not built from a seed, so it cannot be hidden; take another"
            )
        text = _SEED.sub("", read_text(path), count=1)
        folder.mkdir(parents=True, exist_ok=True)
        for number in rounds:
            written.append(_place(folder, path, number))
            seed = secret.number("scene", path.stem, *_again(number))
            written[-1].write_text(f"seed = {seed}\n{text}", encoding="utf-8", newline="\n")
    return written


def _rounds(card: DatasetCard, count: int | None) -> int:
    """How often a card is drawn for so many sequences."""
    return 1 if count is None else -(-count // len(card.expanded().sequence))


def _again(number: int) -> tuple[int, ...]:
    """The key of a repeated draw of a card; the first draw has none, as if there were no others."""
    return (number,) if number else ()


def _place(folder: Path, scene: Path, number: int) -> Path:
    return folder / ("-".join((scene.stem, *map(str, _again(number)))) + ".toml")


def _scene(name: str) -> Path:
    return card_path("scenes", name)


def _single(card: DatasetCard, secret: Secret, again: int) -> Iterator[DatasetCard]:
    """The card with one sequence, combination of the grid and secret seed each; it was drawn ``again`` times."""
    for sequence, number in product(card.sequence, range(max(len(card.seeds), 1))):
        for values in product(*(axis.items() for axis in card.grid.values())):
            labels = (label for label, _ in values)
            seed = secret.number("sequence", sequence.name, *labels, number, *_again(again))
            grid: dict[str, dict[str, Variation]] = {
                name: {label: value} for name, (label, value) in zip(card.grid, values, strict=True)
            }
            yield replace(card, sequence=(replace(sequence, seed=None),), grid=grid, seeds=(seed,))


def _motion(single: DatasetCard) -> MotionCard | None:
    """What the card says of the motion of its one sequence."""
    (sequence,) = single.sequence
    own = [value.motion for axis in single.grid.values() for value in axis.values() if value.motion is not None]
    return own[-1] if own else sequence.motion or single.motion


def _drawn(single: DatasetCard, secret: Secret, again: tuple[int, ...]) -> SequenceCard:
    """The one sequence of a card, drawn, of secret size; ValueError for what is not random."""
    stated = _motion(single)
    (sequence,) = single.expanded().sequence
    if stated is None or (stated.rotation_axis, stated.translation_axis) != ("random", "random"):
        raise ValueError(f'{single.sequence[0].name}: motion: a secret split needs both axes to be "random"')
    if sequence.moving:
        name = single.sequence[0].name
        raise ValueError(f"{name}: moving: the card states where its objects are; use sequences without `moving`")
    motion = sequence.motion or stated
    assert motion.rotation_deg is not None and motion.translation is not None
    ratio = single.readout_ratio if sequence.readout_ratio is None else sequence.readout_ratio

    def less(name: str, value: float) -> float:
        return value * (_LEAST + (1.0 - _LEAST) * secret.share(name, sequence.name, *again))

    rotation, translation = less("rotation", motion.rotation_deg), less("translation", motion.translation)
    drawn = None
    if single.readout_range is not None:
        low, high = single.readout_range
        drawn = low + (high - low) * secret.share("readout", sequence.name, *again)
    return replace(
        sequence,
        motion=replace(motion, rotation_deg=rotation, translation=translation),
        readout_ratio=less("readout", ratio) if drawn is None else drawn,
    )
