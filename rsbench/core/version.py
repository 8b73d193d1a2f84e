"""The version of rsbench, which every stored result names."""

__version__ = "0.1.0"
