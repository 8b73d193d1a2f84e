"""docs/explanation/solvers.md compares the solvers, docs/reference/solver-sheets.md has a section for each.

python benchmarks/solver_measurements.py    # the tables in results/solvers: half an hour of a processor
python benchmarks/solver_pages.py           # the pages: a second
"""

from __future__ import annotations

import json
import re
import sys
import textwrap
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from rsbench.benchmark.statistics import share_interval
from rsbench.components.cards import list_cards
from rsbench.solvers.engine.base import BESIDE, SolverEntry, load_solver_entry
from rsbench.storage.files import write_bytes

ROOT = Path(__file__).parents[1]
PAGE, SHEETS = ROOT / "docs/explanation/solvers.md", ROOT / "docs/reference/solver-sheets.md"
REPOSITORY = "https://github.com/rsbench/rsbench/blob/main"
HEAD = """# Solvers

A solver estimates the motion of the rig, rotation vector w and translation d over one frame period, from
matches. `rsbench list solvers` lists the solvers of this page; `--solver NAME` of `solve`, `correct`, `evaluate`
and `simulate` selects one. [One page has a section for each](../reference/solver-sheets.md), with its paper,
equations, needs and assumptions. See also [Add a solver](../how-to/add-a-solver.md) and
[Motion from one camera](monocular.md).

## Which solver to use

{uses}

## What is measured

The table comes from `python benchmarks/solver_pages.py`, from
[measurements]({repository}/results/solvers/solvers.csv) by `python benchmarks/solver_measurements.py` on
{date}, on one core of a busy {cores}-core machine ({processor}). The rig has two cameras of 900 x 900 px,
f = 810 px, baseline 0.6 m and readout ratio 0.8. It moves by 2 deg and 0.3 m per frame period in random
directions; points are 2 to 10 m away. The 95 % interval of a share of 1.00 in {trials} trials begins at
{least:.2f}.

- **Bias**: median error on 100 exact matches per camera that follow the motion model of the solver. Its order,
  in the sections, is the factor by which half the motion reduces it: about 2 is first order, 4 second. A solver
  that assumes a global shutter sees rolling-shutter matches here.
- **Noise**: root mean square error with {noise} px of noise over the Cramer-Rao bound for the solver's input;
  1 is best. The error includes the bias, and one failure, which counts as 180 deg, dominates it. The
  bound has six unknowns: velocities or an acceleration that a solver leaves free increase its factor. Gyroscope,
  gravity and affine frames are exact here; the bound includes the first two, but not the frames.
- **Success**: share of robust estimates within {e_R} deg and {e_T} deg, at 0, 30 and 50 % outliers and at most
  1000 samples; then at 50 % with at most {few} samples, and with as many as take about {ms:.0f} ms. "Own
  loop": the solver rejects outliers itself, with its own number of samples.
- **ms**: processor time of a robust estimate from 200 matches with 30 % outliers. All {solvers} solvers together
  take {all_s:.0f} s for one robust estimate each, from {many} matches per camera with 30 % outliers.

Solvers of the left camera are scored on that camera's own motion. Other settings:
[sweeps over noise, motion and scene]({repository}/results/sweeps/README.md).

"""
SHEETS_HEAD = """# Reference: solvers one by one

A section for each solver, made by `python benchmarks/solver_pages.py` from its card, its class and the
measurements that [Solvers](../explanation/solvers.md#what-is-measured) explains.

- **Equations**: x and y are the rays of a match in frames 0 and 1, s0 and s1 the times of its rows, h the
  readout time of a row, `[v]x u` = v x u. The source has the rest.
- **Noise** has a 95 % interval, and in brackets the median error over that of errors at the bound.
- **Time** is processor time of a minimal sample, and of a whole robust estimate.
- **Success**: at 0, 30 and 50 % outliers; then at 50 % in equal time and with equal numbers of samples.
- **Degenerate**: which of the 11 motions and scenes of
  [the suite]({repository}/cards/sweeps/degenerate.toml) are not always solved, without noise and with 0.3 px,
  as numbers of solved trials. A trial is solved if its errors are below {solved_R} deg and {solved_T} deg, or
  three times the bound if that is more; a direction that the matches do not determine is ignored. The other trials
  give a wrong motion or, if so stated, a failure.

"""
USES = (
    ("Two cameras, readout ratio known", "rs-stereo-refined", "rs-stereo-refined-pairs", "rs-stereo-tracks"),
    ("Two cameras on a screw-like path, such as a vehicle", "rs-stereo-refined-twist"),
    ("One camera, readout ratio known", "rs-mono-refined"),
    ("A calibrated gyroscope", "rs-gyro-stereo", "rs-gyro-5pt"),
    ("Global shutters", "gs-stereo-tracks", "gs-stereo-pnp", "gs-poselib-stereo", "gs-poselib"),
    ("Slow, even motion and little time", "gs-stereo-pnp-scaled", "gs-poselib-stereo-scaled", "gs-poselib-scaled"),
    ("To compare with Wang, Fan and Dai", "rs-stereo-linear", "gs-8pt"),
)
SETS = {
    "left": "matches over time of the left camera",
    "right": "of the right camera",
    "stereo": "left-right matches at both times",
    "tracks": "tracks through all four images",
    **BESIDE,
}
OUTLIERS = ("0%", "30%", "50%")


def pages(folder: Path) -> dict[Path, str]:
    """The documents, from the tables of a folder and the cards of the solvers."""
    made = json.loads((folder / "provenance.json").read_text("utf-8"))
    given, machine = made["inputs"], made["machine"]
    equations = tomllib.loads(Path(__file__).with_name("solver_equations.toml").read_text("utf-8"))
    table = pd.read_csv(folder / "solvers.csv")
    table = table[table["solver"].isin(list_cards("solvers"))]  # none under a former name
    (trials,) = table["trials"].unique().tolist()
    told = dict(
        uses="\n".join(_use(*row) for row in USES),
        repository=REPOSITORY,
        date=made["date"],
        cores=machine["cores"],
        processor=machine["processor"],
        trials=trials,
        least=share_interval(trials, trials).low,
        noise=given["noise_px"],
        e_R=given["good_deg"][0],
        e_T=given["good_deg"][1],
        few=given["few_samples"],
        ms=given["time_ms"],
        solved_R=given["solved_deg"][0],
        solved_T=given["solved_deg"][1],
        many=given["many"],
        solvers=len(table),
        all_s=1e-3 * table["robust_ms_many"].sum(),
    )
    rows = {str(row["solver"]): row for row in table.to_dict("records")}
    hard = pd.read_csv(folder / "degenerate.csv", keep_default_na=False)
    sections = [
        section(load_solver_entry(name), rows.get(name), hard[hard["solver"] == name], equations)
        for name in list_cards("solvers")
    ]
    return {
        PAGE: "\n".join([_wrapped(HEAD.format(**told)), *overview(rows)]),
        SHEETS: "\n".join([_wrapped(SHEETS_HEAD.format(**told)), *sections]),
    }


def _use(case: str, *solvers: str) -> str:
    return f"- {case}: {', '.join(f'[`{name}`](../reference/solver-sheets.md#{name})' for name in solvers)}."


def _wrapped(text: str) -> str:
    """Paragraphs and items at 100 columns; addresses stay whole."""
    return "\n\n".join("\n".join(map(_filled, re.split(r"\n(?=- )", block))) for block in text.split("\n\n"))


def _filled(text: str) -> str:
    indent = "  " if text.startswith("- ") else ""
    text = re.sub(r"\n +", " ", text)
    return textwrap.fill(text, 100, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False)


def overview(rows: Mapping[str, Mapping[Any, Any]]) -> list[str]:
    """The table of all solvers; what its columns are is said above it."""
    heads = ("solver", "bias e_R, e_T (deg)", "noise e_R, e_T (x bound)", "0 %", "30 %", "50 %")
    heads += ("50 %, few samples", "50 %, equal time", "ms")
    lines = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    for name, row in rows.items():
        cells = [
            f"[{name}](../reference/solver-sheets.md#{name})",
            ", ".join(_degrees(row[f"bias_{error}_deg"]) for error in ("e_R", "e_T")),
            ", ".join(_short_factor(row, error) for error in ("e_R", "e_T")),
            *(_share(row[f"success_{each}"]) for each in OUTLIERS),
            _share(row["success_few"]) if np.isfinite(row["sample_ms"]) else "own loop",
            _share(row["success_quick"]),
            _number(row["robust_ms_30%"]),
        ]
        lines.append(f"| {' | '.join(cells)} |")
    return [*lines, ""]


def section(
    entry: SolverEntry, row: Mapping[Any, Any] | None, hard: pd.DataFrame, equations: Mapping[str, str]
) -> str:
    """Of one solver; one that is new has no measurements yet."""
    spec, module = entry.solver.spec, type(entry.solver).__module__
    needs = "; ".join(f"{spec.minimum[name]} {SETS[name]}" for name in SETS if name in spec.needs)
    gives = f"w and {'d in metres' if spec.metric else 'the direction of d'}, of the "
    gives += "rig" if spec.reference_point == "body" else "left camera"
    source = f"{REPOSITORY}/{module.replace('.', '/')}.py"
    lines = [
        f"- Paper: {spec.reference}.",
        f"- Equations: `{equations[type(entry.solver).__name__]}` ([source]({source})).",
        f"- Needs at least {needs}. Gives {gives}.",
        f"- Assumes {spec.assumes}; motion model `{spec.motion_model}`.",
        *(measured(row) if row else ["- Bias, noise, time and success: not measured yet."]),
        *(degenerate(hard) if len(hard) else ["- Degenerate: not measured yet."]),
        f"- When to take it: {entry.options.use}",
    ]
    return _wrapped("\n".join([f"## {entry.name}\n", f"{entry.description}.\n", *lines])) + "\n"


def measured(row: Mapping[Any, Any]) -> list[str]:
    """Lines from a row of the table of numbers."""
    shares = ", ".join(_share(row[f"success_{each}"]) for each in OUTLIERS)
    return [
        f"- Measured with {row['information']}, {row['trials']} trials; sample: {row['sample']}.",
        f"- Bias {_angle(row['bias_e_R_deg'])}, {_angle(row['bias_e_T_deg'])} (e_R, e_T){_order(row)}.",
        f"- Noise: e_R {_factor(row, 'e_R')}, e_T {_factor(row, 'e_T')}{_failures(row)}.",
        f"- Time: {_sample(row['sample_ms'])}, {_number(row['robust_ms_30%'])} ms robust.",
        f"- Success {shares}; {_budgets(row)}.",
    ]


def degenerate(hard: pd.DataFrame) -> list[str]:
    """Lines from a solver's rows of the degenerate suite."""
    return [
        f"- Degenerate, {words}: {_unsolved(hard, noise)}." for noise, words in ((0.0, "exact"), (0.3, "0.3 px"))
    ]


def _order(row: Mapping[Any, Any]) -> str:
    """What halving the motion divides the errors by, where they are no rounding."""
    pairs = [(row[f"bias_{error}_deg"], row[f"bias_half_{error}_deg"]) for error in ("e_R", "e_T")]
    told = [f"{full / half:.1f}" if half > 1e-6 and full < 90.0 else "-" for full, half in pairs]
    return "" if set(told) == {"-"} else f", order {', '.join(told)}"


def _degrees(value: float) -> str:
    return "fails" if value >= 180.0 else "0" if value < 1e-7 else _number(value)


def _short_factor(row: Mapping[Any, Any], error: str) -> str:
    ratio = row[f"{error}_over_bound"]
    return _number(ratio) if np.isfinite(ratio) else "-"


def _angle(degrees: float) -> str:
    return "none (fails)" if degrees >= 180.0 else "0" if degrees < 1e-7 else f"{_number(degrees)} deg"


def _factor(row: Mapping[Any, Any], error: str) -> str:
    middle = row[f"{error}_median_over_bound"]
    if not np.isfinite(middle):
        return "what the gyroscope has"
    ratio, low, high = (row[f"{error}_over_bound{end}"] for end in ("", "_low", "_high"))
    return f"{_number(ratio)} [{_number(low)}, {_number(high)}] times the bound (median {_number(middle)})"


def _failures(row: Mapping[Any, Any]) -> str:
    count = int(row["noisy_failures"])
    return f"; {count} failed" if count else ""


def _sample(ms: float) -> str:
    return f"{_number(ms)} ms a sample" if np.isfinite(ms) else "own loop"


def _share(value: float) -> str:
    return f"{value:.2f}"


def _budgets(row: Mapping[Any, Any]) -> str:
    """Success at 50 % with equal times and equal numbers of samples; how many samples the time was good for."""
    told = f"in {_number(row['ms_quick'])} ms {_share(row['success_quick'])}"
    if np.isfinite(row["sample_ms"]):
        told = f"{told} (at most {row['most_quick']:.0f} samples), in few samples {_share(row['success_few'])}"
    return f"at 50 % {told}"


def _unsolved(hard: pd.DataFrame, noise: float) -> str:
    """Motions and scenes of the suite in which a trial in ten or more is not solved."""
    bad = hard[(hard["noise_px"] == noise) & (hard["solved"] < 0.9 * hard["trials"])]
    told = [
        f"{row['variant']} {row['solved']} of {row['trials']}"
        + (f" ({row['failed']} failed)" if row["failed"] else "")
        for row in bad.to_dict("records")
    ]
    return "; ".join(told) or "all solved"


def _number(value: float) -> str:
    return f"{value:.0f}" if value >= 100.0 else f"{value:.2g}"


def main() -> int:
    for path, text in pages(ROOT / "results/solvers").items():
        write_bytes(path, text.encode())
    return 0


if __name__ == "__main__":
    sys.exit(main())
