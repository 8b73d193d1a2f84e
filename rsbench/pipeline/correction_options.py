"""What decides the correction of four frames, apart from the frames and the rig."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field, fields, replace
from typing import Any

from rsbench.components.imports import component_key
from rsbench.components.plugins import Entry
from rsbench.core.errors import RsbenchError
from rsbench.solvers.engine.base import SolverEntry, load_solver_entry
from rsbench.solvers.engine.robust_motion import RobustOptions
from rsbench.vision.corrector import CorrectorEntry, load_corrector
from rsbench.vision.feature_matcher import FeatureEntry, load_features
from rsbench.vision.features import SiftMatcher
from rsbench.vision.stereo_depth import SgmMatcher
from rsbench.vision.stereo_matcher import MatcherEntry, load_matcher


@dataclass(frozen=True, kw_only=True)
class CorrectionOptions:
    """The four components of the chain, each of which may be anybody's, and what happens between them."""

    features: FeatureEntry = field(default_factory=lambda: load_features("sift-refined"))
    """Finds the matches that the motion is solved from."""
    solver: SolverEntry = field(default_factory=lambda: load_solver_entry("rs-stereo-refined"))
    """Any solver that gives the length of d."""
    matcher: MatcherEntry = field(default_factory=lambda: load_matcher("sgm"))
    """Finds depth."""
    corrector: CorrectorEntry = field(default_factory=lambda: load_corrector("fusion"))
    robust: RobustOptions = field(default_factory=RobustOptions)
    motion_model: str | None = None
    """``auto`` or a model to use instead of the solver's, see ``rsbench.capture.model_choice``."""
    target_row: float = 0.0
    """The time of this row of the frame is the time of its corrected image."""
    depth_from_motion: bool = True
    """Where the other camera gives no depth, take it from the flow to the other frame and the motion."""
    find_sky: bool = True
    inpaint: bool = False
    """Invent pixels that no frame shows; they stay marked."""
    seed: int = 0

    def faster(self) -> CorrectionOptions:
        """The same sooner: matches and depth at half the size, and no depth from the motion.

        Raises:
            RsbenchError: features or matcher are not ours, which know no other size.
        """
        entries: dict[str, Any] = {"features": self.features, "matcher": self.matcher}
        for option, kind in (("features", SiftMatcher), ("matcher", SgmMatcher)):
            entry = entries[option]
            if not isinstance(entry.component, kind):
                raise RsbenchError(f"--fast: {option} {entry.name!r} cannot work at half the size; leave one out")
            component = replace(entry.component, half=True)
            entries[option] = replace(entry, component=component, key=component_key(component, {}))
        return replace(self, depth_from_motion=False, **entries)

    @property
    def components(self) -> dict[str, Entry[Any, Any]]:
        """The four components by the name of their option."""
        values = {option.name: getattr(self, option.name) for option in fields(self)}
        return {name: value for name, value in values.items() if isinstance(value, Entry)}

    @property
    def key(self) -> str:
        """Hash of all that decides a result: options of equal keys give equal frames."""
        values = {name: getattr(self, name) for name in sorted(option.name for option in fields(self))}
        parts = [f"{name}={value.key if isinstance(value, Entry) else value!r}" for name, value in values.items()]
        return hashlib.sha256("\n".join(parts).encode()).hexdigest()
