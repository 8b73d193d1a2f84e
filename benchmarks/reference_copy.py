"""Makes cards/references/CARD.json: renders what the left camera of each sequence of a card sees at time 0.

python benchmarks/reference_copy.py standard
"""

from __future__ import annotations

import json
import sys
import tempfile
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

from rsbench.components.cards import load_card
from rsbench.core.version import __version__
from rsbench.dataset.card import DatasetCard, load_dataset_card
from rsbench.dataset.generation import PosedScenes, build_scene, render_camera, scene_name
from rsbench.renderers.backend import start_backend
from rsbench.renderers.llvm import cpu_features
from rsbench.renderers.options import RendererOptions
from rsbench.storage.files import background_writer, sha256, write_bytes
from rsbench.storage.work_folder import files_below
from rsbench.verification.digests import FRAME, SIDE, record_of

ROOT = Path(__file__).parents[1]


def reference_of(card: DatasetCard) -> dict[str, Any]:
    """What the file of the reference copy of a card holds."""
    options = load_card(RendererOptions, "renderers", card.renderer)
    backend, stage = start_backend(), PosedScenes(lru_cache(maxsize=1)(build_scene))
    records = dict[str, Any]()
    for sequence in sorted(card.sequence, key=scene_name):
        scene, _ = stage.set_for(sequence)
        with tempfile.TemporaryDirectory(prefix="rsbench-") as temporary:
            folder = Path(temporary)
            for name in ("rs", "rs_clean", "rs_depth", "rs_gloss", "poses"):
                (folder / name).mkdir()
            with background_writer() as later:
                rendered = render_camera(
                    card, sequence, options, scene, SIDE, FRAME, folder, later, rolling_alone=True
                )
                _ = list(rendered)
            records[sequence.name] = record_of(
                folder, {name: sha256(folder / name) for name in files_below(folder)}
            )
        sys.stderr.write(f"{sequence.name}\n")
    packages = {name: version(name) for name in ("mitsuba", "drjit", "numpy")}
    made_by = {"rsbench": __version__, **packages, "variant": backend.variant, "processor": cpu_features()}
    ordered = {sequence.name: records[sequence.name] for sequence in card.sequence}
    return {"name": card.name, "made_by": made_by, "sequences": ordered}


def text_of(content: dict[str, Any]) -> str:
    """JSON with a line for each sequence."""
    lines = [f"  {json.dumps(name)}: {json.dumps(each)}" for name, each in content["sequences"].items()]
    head = json.dumps({key: value for key, value in content.items() if key != "sequences"}, indent=1)
    return head.removesuffix("\n}") + ',\n "sequences": {\n' + ",\n".join(lines) + "\n }\n}\n"


if __name__ == "__main__":
    for given in sys.argv[1:]:
        text = text_of(reference_of(load_dataset_card(given)))
        write_bytes(ROOT / "cards/references" / f"{given}.json", text.encode())
