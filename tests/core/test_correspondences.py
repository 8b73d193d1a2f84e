"""What solvers are given: shapes, copies, and messages that name the bad match."""

from __future__ import annotations

import numpy as np
import pytest

from rsbench.core.correspondences import Correspondences

COLUMNS = {"left": 4, "right": 4, "stereo_0": 4, "stereo_1": 4, "tracks": 8, "lines": 16}


def test_absent_sets_are_empty_with_their_columns() -> None:
    nothing = Correspondences()
    assert {name: getattr(nothing, name).shape for name in COLUMNS} == {n: (0, c) for n, c in COLUMNS.items()}


@pytest.mark.parametrize(("name", "columns"), COLUMNS.items())
def test_lists_become_float64_rows(name: str, columns: int) -> None:
    rows = getattr(Correspondences(**{name: [list(range(columns))] * 3}), name)  # pyrefly: ignore[bad-argument-type]
    assert (rows.shape, rows.dtype) == ((3, columns), np.float64)


@pytest.mark.parametrize("name", COLUMNS)
def test_an_empty_list_is_an_empty_set(name: str) -> None:
    assert getattr(Correspondences(**{name: []}), name).shape == (0, COLUMNS[name])  # pyrefly: ignore[bad-argument-type]


@pytest.mark.parametrize(("name", "columns"), COLUMNS.items())
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_number_that_is_not_finite_is_named_by_set_and_match(name: str, columns: int, bad: float) -> None:
    rows = np.ones((5, columns))
    rows[3, 1] = bad
    with pytest.raises(ValueError, match=rf"{name}\[3\] must be finite numbers, got .*{bad}"):
        Correspondences(**{name: rows})


@pytest.mark.parametrize("shape", [(3, 5), (4,), (2, 2, 4)])
def test_wrong_shapes_are_refused_with_the_right_one(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="left must have 4 numbers per match"):
        Correspondences(left=np.ones(shape))


def test_input_is_copied_and_the_copy_is_read_only() -> None:
    given = np.ones((2, 4))
    matches = Correspondences(left=given)
    given[0, 0] = 7.0
    assert matches.left[0, 0] == 1.0
    with pytest.raises(ValueError, match="read-only"):
        matches.left[0, 0] = 2.0


def test_gravity_without_a_direction_is_refused_by_its_row() -> None:
    with pytest.raises(ValueError, match=r"gravity\[1\] has no direction: gx, gy, gz are 0"):
        Correspondences(gravity=np.array([[0.0, 0.0, 9.8, 0.0], [1.0, 0.0, 0.0, 0.0]]))
