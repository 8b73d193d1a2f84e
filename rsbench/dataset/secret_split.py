"""Secret datasets: variants of a card whose scenes, motions, noise, order and names follow from a secret text.

The same text always gives the same dataset. Each random value is a hash of the text prefixed by the value's
purpose, so that it reveals nothing about other values or the text. The public commitment to a text is such a hash
too, one that is not used as a seed.
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
"""Smallest number of characters of a secret; shorter ones could be guessed by exhaustive search."""
_LEAST = 0.7
"""Smallest secret factor of the card's rotation, translation and readout ratio, as the card itself is public."""
_BITS = 62
"""Number of bits of a seed: TOML and others store signed 64-bit integers."""
_SEED = re.compile(r"^seed *=.*\n", re.MULTILINE)


@dataclass(frozen=True)
class Secret:
    """A secret text from which random values are derived."""

    text: str = field(repr=False)

    def digest(self, *words: object) -> bytes:
        """Return 32 pseudorandom bytes for a purpose."""
        purpose = "/".join(("rsbench", *map(str, words)))
        return hashlib.sha256(f"{purpose}\n{self.text}".encode()).digest()

    def number(self, *words: object) -> int:
        """Return a seed for a purpose."""
        return int.from_bytes(self.digest("number", *words), "big") >> (256 - _BITS)

    def share(self, *words: object) -> float:
        """Return a pseudorandom number in [0, 1) for a purpose."""
        return int.from_bytes(self.digest("share", *words)[:6], "big") / 2**48

    @property
    def commitment(self) -> str:
        """Public commitment to the text that does not reveal it: a SHA-256 in hex digits."""
        return self.digest("commitment").hex()


def read_secret(path: Path) -> Secret:
    """Read a secret from a text file, without surrounding white space.

    Raises:
        RsbenchError: the file cannot be read, or its text is shorter than ``SHORTEST``.
    """
    text = read_text(path, 4096).strip()
    if len(text) < SHORTEST:
        raise RsbenchError(
            f"{path}: holds {len(text)} characters: a secret seed needs {SHORTEST}, drawn at random"
        )
    return Secret(text)


def open_split(name_or_path: str, word: str) -> Secret:
    """Return the non-secret text of a public split; it depends only on the names of card and split."""
    return Secret(f"open split {word} of {card_path('datasets', name_or_path).stem}")


def secret_card(
    name_or_path: str, secret: Secret, scenes: Path | None = None, *, split: str = "test", count: int | None = None
) -> DatasetCard:
    """Return a card in which every sequence has its own secret motion and noise, and an anonymous name.

    It has each combination of the card's sequences, grid and seeds, in a secret order. Unlike in the card,
    sequences do not share motions; rotation, translation and readout ratio are 0.7 to 1 times the card's.

    Args:
        name_or_path: name or path of a card with random motions.
        secret: source of all random values.
        scenes: folder with the scenes from ``write_scenes``; without it, the card keeps its own, public scenes, so
            that only the motions are secret.
        split: suffix of the name of the card.
        count: number of sequences, by default that of the card; further ones repeat the card with new random
            values and new scenes.

    Raises:
        RsbenchError: the card cannot be read, or it fixes something that a split must keep secret.
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
    """Write the scene cards of a dataset card into a folder, with secret seeds of textures and details.

    ``count`` is the number of sequences, as for ``secret_card``.

    Raises:
        RsbenchError: a card cannot be read, or its scene does not depend on the seed.
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
    """Return how often a card must be drawn for ``count`` sequences."""
    return 1 if count is None else -(-count // len(card.expanded().sequence))


def _again(number: int) -> tuple[int, ...]:
    """Return the key of draw ``number`` of a card; it is empty for the first draw, as without repeated draws."""
    return (number,) if number else ()


def _place(folder: Path, scene: Path, number: int) -> Path:
    return folder / ("-".join((scene.stem, *map(str, _again(number)))) + ".toml")


def _scene(name: str) -> Path:
    return card_path("scenes", name)


def _single(card: DatasetCard, secret: Secret, again: int) -> Iterator[DatasetCard]:
    """Yield cards with one sequence, grid value and secret seed each; ``again`` is the number of the draw."""
    for sequence, number in product(card.sequence, range(max(len(card.seeds), 1))):
        for values in product(*(axis.items() for axis in card.grid.values())):
            labels = (label for label, _ in values)
            seed = secret.number("sequence", sequence.name, *labels, number, *_again(again))
            grid: dict[str, dict[str, Variation]] = {
                name: {label: value} for name, (label, value) in zip(card.grid, values, strict=True)
            }
            yield replace(card, sequence=(replace(sequence, seed=None),), grid=grid, seeds=(seed,))


def _motion(single: DatasetCard) -> MotionCard | None:
    """Return the motion that a card with one sequence states for it."""
    (sequence,) = single.sequence
    own = [value.motion for axis in single.grid.values() for value in axis.values() if value.motion is not None]
    return own[-1] if own else sequence.motion or single.motion


def _drawn(single: DatasetCard, secret: Secret, again: tuple[int, ...]) -> SequenceCard:
    """Draw the only sequence of a card, with secret magnitudes; raise ValueError if its motion is not random."""
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
