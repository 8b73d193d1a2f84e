"""Makes the release's sample: the ten sequences of cards/datasets/sample.toml in one archive; prints its hash.

python benchmarks/release_sample.py build/rsbench-sample.zip
"""

from __future__ import annotations

import argparse
import hashlib
import io
import sys
import tempfile
import zipfile
from pathlib import Path

from rsbench.core.errors import RsbenchError
from rsbench.dataset.card import load_dataset_card
from rsbench.dataset.generation import generate_dataset
from rsbench.storage.files import write_bytes
from rsbench.storage.work_folder import HIDDEN, files_below

CARD = "sample"
MOST_BYTES = 20_000_000


def packed(data: Path, name: str) -> bytes:
    """A dataset as a zip archive, of one folder.

    Frames and depth are compressed already, and zlib differs between systems: nothing is compressed again. Times,
    owners and order are fixed, so the same dataset gives the same archive.

    Args:
        data: folder of the dataset.
        name: of the folder in the archive.

    Raises:
        RsbenchError: the archive would be too large for a release's sample.
    """
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_STORED) as archive:
        for path in files_below(data):
            if not path.startswith(f"{HIDDEN}/"):
                entry = zipfile.ZipInfo(f"{name}/{path}")  # of 1980
                entry.create_system, entry.external_attr = 3, 0o644 << 16  # whatever the system
                archive.writestr(entry, (data / path).read_bytes())
    if stream.tell() > MOST_BYTES:
        raise RsbenchError(f"{data}: takes {stream.tell()} bytes packed, of {MOST_BYTES}: make its frames smaller")
    return stream.getvalue()


def make(card: str, out: Path) -> str:
    """Render the dataset of a card, pack it, and return the archive's SHA-256."""
    with tempfile.TemporaryDirectory(prefix="rsbench-") as folder:
        _ = generate_dataset(load_dataset_card(card), Path(folder))
        content = packed(Path(folder), out.stem)
    out.parent.mkdir(parents=True, exist_ok=True)
    write_bytes(out, content)
    return hashlib.sha256(content).hexdigest()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, metavar="OUT.zip")
    out = parser.parse_args().out
    digest = make(CARD, out)
    sys.stdout.write(f"{digest}  {out}: {out.stat().st_size} bytes\n")
