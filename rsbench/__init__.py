"""Rolling-shutter stereo: rendered ground truth, solvers, correction and scores."""

__version__ = "0.1.0"
