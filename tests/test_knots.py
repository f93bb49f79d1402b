"""Bases on knots of one's own, and where knots are placed."""

import numpy as np
import pytest

import motionfit as mf
from motionfit.splines import bspline_basis, knots_at_extrema, knots_basis, refined_knots


def test_even_knots_give_the_even_basis():
    even, own = bspline_basis(31, 1 / 60, 0.1), knots_basis(np.arange(0.0, 31.0, 6.0), 31)
    np.testing.assert_array_equal(even.first, own.first)
    np.testing.assert_allclose(even.values, own.values, atol=1e-12)
    assert even.count == own.count


@pytest.mark.parametrize("knots", [[0.0, 3.0, 20.0, 22.0, 39.0], [0.0, 39.0]])
def test_any_basis_sums_to_one_and_keeps_to_four_points(knots):
    basis = knots_basis(np.array(knots), 40)
    np.testing.assert_allclose(np.asarray(basis.values).sum(axis=1), 1.0, atol=1e-12)
    assert (np.diff(basis.first) >= 0).all() and basis.first.max() + 4 <= basis.count
    np.testing.assert_allclose(basis(np.full(basis.count, 0.7)), 0.7, atol=1e-12)


def test_knots_must_span_the_clip():
    for knots in ([0.0, 10.0], [0.0, 5.0, 5.0, 40.0], [3.0, 40.0]):
        with pytest.raises(mf.InputError, match="span the frames 0 to 39"):
            knots_basis(np.array(knots), 40)


def test_knots_lie_at_the_extrema_of_a_demand():
    frames = np.arange(200.0)
    demand = np.exp(-(((frames - 60) / 10) ** 2)) + 0.5 * np.exp(-(((frames - 140) / 8) ** 2))
    knots = knots_at_extrema(demand, 4.0, threshold=0.01)
    assert knots[0] == 0 and knots[-1] == 199
    for peak in (60, 140):
        assert np.abs(knots - peak).min() <= 2
    assert np.diff(knots).min() >= 4 and np.diff(knots).max() <= 60
    # where nothing is asked for there is little to hold
    assert len(knots_at_extrema(np.zeros(200), 4.0)) <= 5 < len(knots)


def test_refining_adds_knots_only_where_something_is_left():
    residual = np.zeros(101)
    residual[52] = 0.03
    knots = np.arange(0.0, 101.0, 20.0)
    finer = refined_knots(knots, residual, 0.01)
    added = np.setdiff1d(finer, knots)
    assert set(added) == {30.0, 50.0, 70.0}
    assert np.array_equal(refined_knots(knots, residual, 0.05), knots)
