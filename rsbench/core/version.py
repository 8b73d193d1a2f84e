"""The version of rsbench, which every stored result names, and when it was released."""

__version__ = "1.0.0"
RELEASED = "2026-11-25"
