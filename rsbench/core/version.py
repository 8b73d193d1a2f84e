"""The version of rsbench, which every stored result names: the next release after ``RELEASE`` of ``RELEASED``."""

__version__ = "1.1.0"
RELEASE, RELEASED = "1.0.0", "2026-11-25"
