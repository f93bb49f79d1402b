"""Quaternion maths against SciPy, and gradients where naive code has none."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from motionfit import rotation

EXACT = 1e-12  # algebra in double precision


@given(st.integers(0, 2**31))
def test_group_operations_agree_with_scipy(seed):
    rng = np.random.default_rng(seed)
    a, b = (Rotation.random(5, random_state=rng) for _ in range(2))  # pyright: ignore[reportCallIssue]: the name before SciPy 1.15
    qa, qb, v = a.as_quat(scalar_first=True), b.as_quat(scalar_first=True), rng.normal(size=(5, 3))
    np.testing.assert_allclose(rotation.rotate(qa, v), a.apply(v), atol=EXACT)
    product = Rotation.from_quat(np.asarray(rotation.multiply(qa, qb)), scalar_first=True)
    assert (product.inv() * (a * b)).magnitude().max() < 1e-7
    np.testing.assert_allclose(rotation.to_matrix(qa), a.as_matrix(), atol=EXACT)
    np.testing.assert_allclose(rotation.log(qa), a.as_rotvec(), atol=1e-9)
    np.testing.assert_allclose(rotation.angle_between(qa, qb), (a.inv() * b).magnitude(), atol=1e-7)


@pytest.mark.parametrize("size", [0.0, 1e-12, 1e-7, 1e-4, 1e-3, 0.1, 1.0, 3.1])
def test_exp_and_log_are_inverse_near_and_far(size):
    vector = jnp.array([0.6, -0.8, 0.0]) * size
    np.testing.assert_allclose(rotation.log(rotation.exp(vector)), vector, atol=1e-9)
    np.testing.assert_allclose(jnp.linalg.norm(rotation.exp(vector)), 1.0, atol=EXACT)
    jacobian = jax.jacobian(lambda x: rotation.log(rotation.exp(x)))(vector)
    np.testing.assert_allclose(jacobian, jnp.eye(3), atol=1e-6)


def test_exp_of_zero_is_the_identity_to_the_bit():
    assert np.array_equal(rotation.exp(jnp.zeros(3)), [1.0, 0.0, 0.0, 0.0])


def test_safe_norm_has_a_zero_gradient_at_zero():
    assert np.array_equal(jax.grad(rotation.safe_norm)(jnp.zeros(3)), jnp.zeros(3))
    np.testing.assert_allclose(jax.grad(rotation.safe_norm)(jnp.array([3.0, 4.0])), [0.6, 0.8], atol=EXACT)


@given(st.integers(0, 2**31))
def test_between_takes_one_direction_to_the_other(seed):
    a, b = np.random.default_rng(seed).normal(size=(2, 3))
    turned = rotation.rotate(rotation.between(a, b), a / np.linalg.norm(a))
    np.testing.assert_allclose(turned, b / np.linalg.norm(b), atol=1e-9)


def test_between_opposite_directions_is_half_a_turn():
    a = jnp.array([0.0, 1.0, 0.0])
    np.testing.assert_allclose(rotation.rotate(rotation.between(a, -a), a), -a, atol=1e-9)
