"""What reads files that somebody else may have written, each with valid files of its kind."""

from __future__ import annotations

import copy
import io
import json
import math
import re
import shutil
import struct
import tomllib
import zipfile
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from hypothesis import strategies as st

from attack.tiny import ROOT, to_toml

Rng = np.random.Generator
_NUMBERS = (
    b"0 -1 1 2 3 255 65535 65536 2147483647 4294967295 99999999999999999999 "
    b"1e308 -1e308 1e-320 5e-324 1e-170 1e200 nan inf"
).split()
_WORDS = (*_NUMBERS, *b"-inf NaN null true \"x\" '' [] {} 1e999 0x10 1_0 \xff".split())
_INTEGERS = (0, 1, 0x7F, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0xFFFFFFFF, 0x80000000, 100_000_000)
_NUMBER = re.compile(rb"-?\d+(\.\d+)?([eE][-+]?\d+)?")


def mutated(data: bytes, others: tuple[bytes, ...], rng: Rng) -> bytes:
    """``data`` with one to four changes; ``others`` are valid inputs to take pieces from."""
    for _ in range(int(rng.integers(1, 5))):
        change: Callable[[bytes, tuple[bytes, ...], Rng], bytes] = _CHANGES[int(rng.integers(len(_CHANGES)))]
        data = change(data, others, rng)
    return data[:10_000_000]


def _flip(data: bytes, others: tuple[bytes, ...], rng: Rng) -> bytes:
    out = bytearray(data)
    for _ in range(int(rng.integers(1, 9)) if out else 0):
        out[int(rng.integers(len(out)))] ^= 1 << int(rng.integers(8))
    return bytes(out)


def _cut(data: bytes, others: tuple[bytes, ...], rng: Rng) -> bytes:
    return data[: int(rng.integers(len(data) + 1))]


def _insert(data: bytes, others: tuple[bytes, ...], rng: Rng) -> bytes:
    place, source = int(rng.integers(len(data) + 1)), others[int(rng.integers(len(others)))]
    first = int(rng.integers(len(source) + 1))
    piece = source[first : first + int(rng.integers(1, 200))]
    if rng.random() < 0.3:
        piece = rng.bytes(int(rng.integers(1, 64)))
    return data[:place] + piece + data[place:]


def _remove(data: bytes, others: tuple[bytes, ...], rng: Rng) -> bytes:
    first = int(rng.integers(len(data) + 1))
    return data[:first] + data[first + int(rng.integers(1, 64)) :]


def _word(data: bytes, others: tuple[bytes, ...], rng: Rng) -> bytes:
    """Another number, in text; at random places where there is none."""
    word, found = _WORDS[int(rng.integers(len(_WORDS)))], list(_NUMBER.finditer(data[:100_000]))
    if not found:
        return _integer(data, others, rng)
    place = found[int(rng.integers(len(found)))]
    return data[: place.start()] + word + data[place.end() :]


def _integer(data: bytes, others: tuple[bytes, ...], rng: Rng) -> bytes:
    """Another number, in binary; more often near the beginning, where headers are."""
    value = _INTEGERS[int(rng.integers(len(_INTEGERS)))]
    piece = struct.pack("<>"[int(rng.integers(2))] + "I", value)
    end = min(len(data), 400) if rng.random() < 0.7 else len(data)
    place = int(rng.integers(end + 1))
    return data[:place] + piece + data[place + 4 :]


def _nest(data: bytes, others: tuple[bytes, ...], rng: Rng) -> bytes:
    depth, place = int(10 ** rng.uniform(1, 5)), int(rng.integers(len(data) + 1))
    left, right = (b"[", b"]") if rng.random() < 0.5 else (b'{"a":', b"}")
    middle = b"1" if rng.random() < 0.5 else b""
    found = list(_NUMBER.finditer(data[:100_000]))
    if found and rng.random() < 0.7:
        value = found[int(rng.integers(len(found)))]
        return data[: value.start()] + left * depth + b"1" + right * depth + data[value.end() :]
    return data[:place] + left * depth + middle + right * depth + data[place:]


_CHANGES = (_flip, _flip, _cut, _insert, _remove, _word, _word, _integer, _integer, _nest)


def mutated_png(data: bytes, others: tuple[bytes, ...], rng: Rng) -> bytes:
    """A PNG whose header says something else, with a checksum that fits; or any change of its bytes."""
    if rng.random() < 0.6 or len(data) < 33:
        return mutated(data, others, rng)
    header = bytearray(data[16:29])
    place = int(rng.integers(4))
    if place < 2:
        header[4 * place : 4 * place + 4] = struct.pack(">I", int(2 ** rng.uniform(0, 32)) & 0xFFFFFFFF)
    else:
        header[int(rng.integers(8, 13))] = int(rng.integers(256))
    return data[:16] + bytes(header) + struct.pack(">I", zlib.crc32(b"IHDR" + bytes(header))) + data[33:]


def mutated_npz(data: bytes, others: tuple[bytes, ...], rng: Rng) -> bytes:
    """An archive with one array changed, and whole otherwise; or any change of its bytes."""
    if rng.random() < 0.4:
        return mutated(data, others, rng)
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name = list(members)[int(rng.integers(len(members)))]
    choice = rng.random()
    if choice < 0.15:
        del members[name]
    elif choice < 0.5:
        array = _array(rng)
        buffer = io.BytesIO()
        np.lib.format.write_array(buffer, array, allow_pickle=False)
        members[name] = buffer.getvalue()
    else:
        members[name] = mutated(members[name], others, rng)
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for member, content in members.items():
            archive.writestr(member, content)
    return buffer.getvalue()


def _array(rng: Rng) -> Any:
    """A plain array of another kind or shape."""
    shape = tuple(int(n) for n in rng.integers(0, 5, int(rng.integers(0, 4))))
    kind = ("f8", "f4", "i8", "u1", "?", "c16", "U5", "S3", "M8[s]")[int(rng.integers(9))]
    values = np.zeros(shape, dtype=kind)
    if kind in ("f8", "f4") and rng.random() < 0.5:
        values = values + np.float64((np.nan, np.inf, 1e308, -1.0)[int(rng.integers(4))])
    return values


# Trees, as cards and JSON files are

JUNK: st.SearchStrategy[Any] = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.sampled_from((0, -1, 10**30, 2**63, 1e308, -0.0, 5e-324, 1e-170, 1e200))
    | st.floats()
    | st.text(max_size=8)
    | st.sampled_from(("..", "/", "../../other", "a\nb", "\x00", "..:x", "os:system", "nan", "a" * 5000)),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=6,
)


@st.composite
def broken(draw: st.DrawFn, tree: Any) -> Any:
    """The tree with one to three of its parts replaced, removed, doubled or added to."""
    tree = copy.deepcopy(tree)
    for _ in range(draw(st.integers(1, 3))):
        places = _places(tree)
        if not places:
            return tree
        parent, key = draw(st.sampled_from(places))
        what = draw(st.sampled_from(("replace", "replace", "replace", "remove", "exchange", "add")))
        if what == "remove":
            del parent[key]
        elif what == "exchange":
            other, name = draw(st.sampled_from(places))
            parent[key], other[name] = copy.deepcopy(other[name]), copy.deepcopy(parent[key])
        elif what == "add" and isinstance(parent, dict):
            parent[draw(st.text(max_size=6))] = draw(JUNK)
        else:
            parent[key] = draw(JUNK)
    return tree


def _places(tree: Any) -> list[tuple[Any, Any]]:
    """Every part of a tree, as what holds it and its key there."""
    found: list[tuple[Any, Any]] = []
    for key in list(tree) if isinstance(tree, dict) else range(len(tree)) if isinstance(tree, list) else ():
        found += [(tree, key), *_places(tree[key])]
    return found


VERIFIED = (
    "dataset.json",
    "one/sequence.json",
    "one/poses/left_0.csv",
    "one/rs/left_0.png",
    "one/rs_depth/left_0.exr",
)
"""Files of a dataset that are changed before all of it is verified."""
NAMES = 20_000
MOST_FAULTS = 2500
"""Of a dataset of two sequences."""


@dataclass(frozen=True, kw_only=True)
class Loader:
    """A reader of one kind of file, with valid files to change."""

    name: str
    path: Path
    """Where a changed file is put: what it needs lies around it."""
    seeds: tuple[bytes, ...]
    load: Callable[[Path], object]
    change: Callable[..., bytes] = mutated
    trees: tuple[Any, ...] = ()
    """The seeds as trees, where they are."""
    write: Callable[[Any], str] = json.dumps
    """Makes a file of a tree."""
    huge: tuple[bytes, ...] = ()
    """Valid text of its kind with more than anybody needs; each is tried once."""
    slow: bool = False
    """Whether it works for a tenth of a second or more, and gets a tenth of the inputs of others."""


def loaders(inputs: Path, results: dict[str, Path], folder: Path) -> list[Loader]:
    """All loaders; ``results`` holds a folder that each command made, ``folder`` is theirs to write in.

    Those of results are left out where there are none.
    """
    found = [
        *_cards(inputs, folder),
        *_datasets(inputs, folder),
        *_meshes(inputs, folder),
        *_problems(folder),
        _answers(folder),
        _arguments(folder),
    ]
    return [*found, *_results(inputs, results, folder)] if "evaluate" in results else found


def _cards(inputs: Path, folder: Path) -> Iterator[Loader]:
    from rsbench.benchmark.scoring import load_metrics
    from rsbench.benchmark.simulated.sweep_card import load_sweep
    from rsbench.components.cards import load_card
    from rsbench.dataset.card import load_dataset_card
    from rsbench.pipeline.footage import read_rig_card
    from rsbench.renderers.options import RendererOptions
    from rsbench.scenes.load import read_scene_card
    from rsbench.solvers.engine.base import load_solver_entry
    from rsbench.vision.corrector import load_corrector
    from rsbench.vision.feature_matcher import load_features
    from rsbench.vision.stereo_matcher import load_matcher

    readers: dict[str, Callable[[Path], object]] = {
        "scenes": read_scene_card,
        "renderers": lambda path: load_card(RendererOptions, "renderers", path),
        "solvers": load_solver_entry,
        "datasets": lambda path: load_dataset_card(str(path)),
        "sweeps": lambda path: load_sweep(str(path)),
        "matchers": load_matcher,
        "features": load_features,
        "correctors": load_corrector,
        "metrics": lambda path: load_metrics([path]),
    }
    for kind, load in readers.items():
        cards = ROOT / kind if (ROOT / kind).is_dir() else ROOT / "cards" / kind
        seeds = [path.read_bytes() for path in sorted(cards.glob("*.toml"))]
        own = {"scenes": "box.toml", "datasets": "tiny.toml", "sweeps": "sweep.toml"}
        seeds += [(inputs / own[kind]).read_bytes()] if kind in own else []
        yield _toml(f"{kind} card", _place(folder, kind) / "card.toml", seeds, load)
    rig = (inputs / "rig.toml").read_bytes()
    yield _toml("rig card", _place(folder, "rig") / "rig.toml", [rig], read_rig_card)


def _toml(name: str, path: Path, seeds: list[bytes], load: Callable[[Path], object]) -> Loader:
    trees = tuple(tomllib.loads(seed.decode()) for seed in seeds)
    return Loader(name=name, path=path, seeds=tuple(seeds), load=load, trees=trees, write=to_toml)


def _file(name: str, path: Path, load: Callable[[Path], object], **more: Any) -> Loader:
    """One whose valid file lies at its path."""
    return Loader(name=name, path=path, seeds=(path.read_bytes(),), load=load, **more)


def _json(name: str, path: Path, load: Callable[[Path], object], **more: Any) -> Loader:
    return _file(name, path, load, trees=(json.loads(path.read_bytes()),), **more)


def _place(folder: Path, name: str) -> Path:
    path = folder / name
    path.mkdir(parents=True)
    return path


def _datasets(inputs: Path, folder: Path) -> Iterator[Loader]:
    from rsbench.dataset.sequence import read_dataset, read_sequence
    from rsbench.pipeline.footage import read_frame
    from rsbench.scenes.load import read_environment
    from rsbench.storage.files import load_arrays, load_matches, read_depth, read_png, read_poses

    data = folder / "data"
    shutil.copytree(inputs / "data", data)
    huge = _many_names(json.loads((data / "dataset.json").read_bytes()))

    def read(path: Path) -> None:
        _inside(read_dataset(path.parent), path.parent)

    yield _json("dataset.json", data / "dataset.json", read, huge=huge)
    for number, name in enumerate(VERIFIED):
        path = folder / f"verified-{number}" / name
        shutil.copytree(inputs / "data", folder / f"verified-{number}")
        verify, many = partial(_verify, folder / f"verified-{number}"), huge if name == "dataset.json" else ()
        yield _file(f"verify {name}", path, verify, huge=many, slow=True)
    data = folder / "sequence"
    shutil.copytree(inputs / "data" / "one", data)
    yield _json("sequence.json", data / "sequence.json", lambda path: read_sequence(path.parent))
    files = _place(folder, "files")
    one = inputs / "data" / "one"
    poses = tuple((one / "poses" / f"left_{frame}.csv").read_bytes() for frame in (0, 1))
    yield Loader(name="poses", path=files / "poses.csv", seeds=poses, load=read_poses)
    pngs = tuple((one / "rs" / f"left_{frame}.png").read_bytes() for frame in (0, 1))
    yield Loader(name="PNG", path=files / "image.png", seeds=pngs, load=read_png, change=mutated_png)
    yield Loader(name="frame", path=files / "frame.png", seeds=pngs, load=read_frame, change=mutated_png)
    depths = tuple((one / f"{kind}_depth" / "left_0.exr").read_bytes() for kind in ("rs", "gs"))
    yield Loader(name="EXR", path=files / "depth.exr", seeds=depths, load=read_depth)
    for suffix in (".hdr", ".exr"):
        path = files / f"sky{suffix}"
        yield Loader(name=f"environment {suffix}", path=path, seeds=(_sky(path),), load=read_environment)
    for name, load in (("matches", load_matches), ("arrays", load_arrays)):
        _write_matches(files / f"{name}.npz")
        yield _file(name, files / f"{name}.npz", load, change=mutated_npz)


def _verify(data: Path, path: Path) -> None:
    """A fault for every file or so, and not for every name."""
    from rsbench.verification import verify_dataset

    faults = sum(len(report.faults) for report in verify_dataset(data))
    if faults > MOST_FAULTS:
        raise AssertionError(f"{faults} faults")


def _many_names(manifest: dict[str, Any]) -> tuple[bytes, ...]:
    """A dataset.json of very many names: of nothing, of folders elsewhere, of one folder, no names."""
    name = manifest["sequences"][0]
    lists: tuple[list[object], ...] = (
        [*manifest["sequences"], *(f"s{number}" for number in range(NAMES))],
        [f"../{number}" for number in range(NAMES)],
        [name] * NAMES,
        [[name]] * NAMES,
    )
    files = manifest["files"] | {f"{name}/{number}.png": "0" * 64 for number in range(NAMES)}
    changes = [*({"sequences": each} for each in lists), {"files": files}]
    return tuple(json.dumps(manifest | change).encode() for change in changes)


def _sky(path: Path) -> bytes:
    """A small environment map."""
    from rsbench.storage.files import write_exr

    light = np.random.default_rng(2).random((8, 16, 3), dtype=np.float32)
    if path.suffix == ".exr":
        write_exr(path, {name: light[..., k].copy() for k, name in enumerate("RGB")})
        return path.read_bytes()
    return bytes(cv2.imencode(".hdr", light)[1])


def _inside(sequences: list[Any], folder: Path) -> None:
    """Sequences lie in the dataset, in the folders of their names."""
    for sequence in sequences:
        if sequence.folder.resolve() != (folder / sequence.name).resolve() or sequence.folder.parent != folder:
            raise AssertionError(f"sequence {sequence.name!r} lies in {sequence.folder}")


def _write_matches(path: Path) -> None:
    sets: dict[str, Any] = {name: np.ones((3, 4)) for name in ("left", "right", "stereo_0", "stereo_1")}
    np.savez_compressed(path, **sets, tracks=np.ones((2, 8)))


def _meshes(inputs: Path, folder: Path) -> Iterator[Loader]:
    import trimesh

    from rsbench.scenes import load
    from rsbench.scenes.mesh import MeshBuilder

    place, box = _place(folder, "meshes"), trimesh.creation.box((1.0, 2.0, 3.0))

    def build(shading: Any, path: Path) -> None:
        meshes = MeshBuilder(file=path.name, shading=shading).build(0, path.parent)
        load._check_meshes(meshes, str(path))

    seeds = {
        "glb": ((inputs / "box.glb").read_bytes(), box.export(file_type="glb")),
        "obj": (box.export(file_type="obj").encode(),),
        "ply": (box.export(file_type="ply"), box.export(file_type="ply", encoding="ascii")),
    }
    for kind, shading in (("glb", "flat"), ("obj", "smooth"), ("ply", "flat"), ("ply", "smooth")):
        path = place / f"{shading}.{kind}"
        yield Loader(name=f"{kind.upper()} {shading}", path=path, seeds=seeds[kind], load=partial(build, shading))


def _problems(folder: Path) -> Iterator[Loader]:
    from rsbench.core.errors import RsbenchError
    from rsbench.pipeline.problem import read_problems

    def read(path: Path) -> None:
        for problem in read_problems(path, io.StringIO()):
            if isinstance(problem, RsbenchError):
                raise problem

    place = _place(folder, "problems")
    (place / "problem.json").write_bytes((ROOT / "examples" / "problem.json").read_bytes())
    yield _json("problem", place / "problem.json", read)
    tree = json.loads((place / "problem.json").read_bytes())
    line = json.dumps(tree)
    yield Loader(
        name="problem lines",
        path=place / "problems.jsonl",
        seeds=(f"{line}\n{line}\n".encode(),),
        load=read,
        trees=(tree,),
        write=lambda content: f"{json.dumps(content)}\n{line}\n",
    )
    camera = tree.pop("camera")
    arrays: dict[str, Any] = {key: np.array(value) for key, value in tree.items() if not isinstance(value, dict)}
    arrays["camera"] = np.array([camera[key] for key in ("width", "height", "fx", "fy", "cx", "cy")])
    np.savez(place / "problem.npz", **arrays)
    yield _file("problem npz", place / "problem.npz", read, change=mutated_npz)


def _answers(folder: Path) -> Loader:
    """Submitted answers; a direction that is read is 0 or has a length that can be scored."""
    from rsbench.benchmark.leaderboard.track import LEAST_D, Answer
    from rsbench.components.cards import parse_card
    from rsbench.storage.files import read_json

    def read(path: Path) -> None:
        answer = parse_card(Answer, read_json(path), str(path))
        if answer.d is not None and any(answer.d) and not math.hypot(*answer.d) >= LEAST_D:
            raise AssertionError(f"d = {answer.d} was read")

    path = _place(folder, "answers") / "answer.json"
    trees = tuple(
        {"name": "a", "w": [0.0, 0.01, 0.0], "d": [length, 0.0, 0.0], "metric": True}
        for length in (0.1, 5e-324, 1e-170, 1e200)
    )
    seeds = tuple(json.dumps(tree).encode() for tree in trees)
    return Loader(name="answer", path=path, seeds=seeds, load=read, trees=trees)


def _arguments(folder: Path) -> Loader:
    """Arguments of a rig as scalars of NumPy; what is made holds Python's numbers, and its depths are finite."""
    import rsbench
    from rsbench.core.errors import RsbenchError
    from rsbench.storage.files import read_json

    kinds: dict[object, Any] = {
        kind.__name__: kind for kind in (np.float16, np.float32, np.longdouble, np.int8, np.uint16, np.int64)
    }
    kinds |= {
        "timedelta64": lambda value: np.timedelta64(int(value), "s"),
        "bool": np.bool_,
        "complex64": np.complex64,
    }

    def make(path: Path) -> None:
        content = read_json(path)
        kind = content.get("kind")

        def scalar(name: str) -> Any:
            value = content.get(name)
            try:
                return kinds[kind](value) if isinstance(kind, str) and kind in kinds else value
            except (ValueError, TypeError, OverflowError):  # which that kind cannot hold
                return value

        try:
            camera = rsbench.PinholeCamera(
                width=content.get("width"), height=content.get("height"),  # pyrefly: ignore[bad-argument-type]
                fx=scalar("focal"), fy=scalar("focal"), cx=scalar("centre"), cy=scalar("centre"),
            )  # fmt: skip
            rig = rsbench.StereoRig(camera=camera, baseline=scalar("baseline"))
            shutter = rsbench.RollingShutter(height=scalar("height"), readout_ratio=scalar("ratio"))
        except ValueError as error:
            raise RsbenchError(f"{path}: {error}") from error
        numbers = camera.fx, camera.cx, rig.baseline, shutter.readout_ratio
        if not {type(number) for number in numbers} <= {float, int} or type(shutter.height) is not int:
            raise AssertionError(f"stored as given: {rig}, {shutter}")
        if not np.isfinite(rig.depth(1.0)):
            raise AssertionError(f"depth of {rig} is {rig.depth(1.0)}")

    path = _place(folder, "arguments") / "arguments.json"
    rig = {"width": 100, "height": 90, "focal": 100, "centre": 50, "baseline": 100, "ratio": 1}
    trees = tuple({"kind": kind, **rig, "focal": focal} for kind in kinds for focal in (100, 60000))
    seeds = tuple(json.dumps(tree).encode() for tree in trees)
    return Loader(name="arguments", path=path, seeds=seeds, load=make, trees=trees)


def _results(inputs: Path, results: dict[str, Path], folder: Path) -> Iterator[Loader]:
    from rsbench.benchmark.images.evaluation import read_headings, read_scores
    from rsbench.benchmark.simulated.run_sweep import read_card, summarise_sweep
    from rsbench.dataset.corrected_frames import fresh_folder
    from rsbench.report.evaluation_page import write_report

    sweep, tables = folder / "sweep", folder / "scores"
    for source, target in (("simulate", sweep), ("simulate", folder / "trials"), ("evaluate", tables)):
        shutil.copytree(results[source], target)
    yield _json("sweep.json", sweep / "sweep.json", lambda path: read_card(path.parent))
    trials = next((folder / "trials" / "trials").glob("*.npz"))
    yield _file("trials", trials, lambda path: summarise_sweep(path.parents[1]), change=mutated_npz, slow=True)
    yield _file("scores", tables / "scores" / "pose.csv", lambda p: read_scores(p.parents[1], "pose"))
    yield _json("columns.json", tables / "scores" / "columns.json", lambda p: read_headings(p.parents[1], "pose"))
    evaluated = folder / "evaluated"
    shutil.copytree(results["evaluate"], evaluated)
    record = evaluated / "provenance.json"
    yield _json("provenance", record, lambda path: write_report(inputs / "data", path.parent), slow=True)
    yield from _predictions(inputs, results["evaluate"], folder)
    corrected = folder / "corrected"
    shutil.copytree(results["correct"], corrected)
    marker = corrected / "motion.json"

    def correct_again(path: Path) -> None:
        with fresh_folder(path.parent) as fresh:
            (fresh / path.name).write_bytes(marker_content)

    marker_content = marker.read_bytes()
    yield _json("motion.json", marker, correct_again)


def _predictions(inputs: Path, evaluation: Path, folder: Path) -> Iterator[Loader]:
    """Stored predictions, as they are found when they are scored."""
    from rsbench.benchmark.images.evaluation import open_evaluation
    from rsbench.benchmark.images.plan import EvaluationOptions, Places
    from rsbench.benchmark.images.score import Scorer

    stored = folder / "predictions"
    shutil.copytree(evaluation, stored)
    opened = open_evaluation(inputs / "data", stored, EvaluationOptions(solvers=("gs-8pt",)))
    places = Places(opened.sequences[0], stored / "predictions" / "one", opened.plan.chain)

    def score(path: Path) -> None:
        Scorer(Places(places.sequence, places.folder, places.chain), opened.plan).score()

    below = places.folder
    yield _json("motion record", below / "motion" / "gs-8pt.json", score, slow=True)
    yield _json("seconds", below / "seconds.json", score, slow=True)
    for name, part in (("correction record", "corrected"), ("depth record", "depth")):
        yield _json(name, min((below / part).glob("*.json")), score, slow=True)
    disparity = min((below / "depth").glob("*.npz"))
    yield _file("disparity", disparity, score, change=mutated_npz, slow=True)
