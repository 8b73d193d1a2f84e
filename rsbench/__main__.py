"""``python -m rsbench``."""

from rsbench.cli.main import run

run()
