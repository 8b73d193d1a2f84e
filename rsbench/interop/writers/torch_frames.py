"""A dataset for PyTorch: the extra ``rsbench[torch]``; nothing else imports torch."""

from __future__ import annotations

from typing import Any

import numpy as np
from torch import Tensor, from_numpy
from torch.utils.data import Dataset

from rsbench.interop.writers.frame_samples import FrameSamples

_IMAGES = ("rs", "gs")


class RollingShutterFrames(FrameSamples, Dataset[dict[str, Any]]):
    """The samples of ``FrameSamples`` as tensors, for ``torch.utils.data.DataLoader`` with any number of workers.

    Images are (frames, 3, H, W) float32 from 0 to 1, sRGB; all else as there. Items share no file, so an epoch
    reads each file once, in whichever worker.
    """

    def __getitem__(self, index: int) -> dict[str, Any]:
        sample = super().__getitem__(index)
        return {name: _tensor(name, value) for name, value in sample.items()}


def _tensor(name: str, value: Any) -> Any:
    if not isinstance(value, np.ndarray):
        return value
    tensor: Tensor = from_numpy(value)
    return tensor.movedim(-1, 1).float() / 255.0 if name.rpartition("_")[2] in _IMAGES else tensor
