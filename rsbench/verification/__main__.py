"""Write the table of checks into a document: ``python -m rsbench.verification DOCUMENT``."""

import sys
from pathlib import Path

from rsbench.verification.checks import with_table

document = Path(sys.argv[1])
document.write_text(with_table(document.read_text("utf-8")), "utf-8", newline="\n")
