"""Laws of marbles: a repulsion and a drag that begin at the surface, and the projectors that terms
have."""

import jax
import numpy as np
import pytest

import dpdjax as dpd


def test_repulsion_is_that_of_the_source():
    law = dpd.term(dpd.laws.shifted_repulsion, epsilon=2.0, sigma=0.9, r_0=2.0)
    function, reach = law.between(R_i=3.0, R_j=0.0)
    np.testing.assert_allclose(reach, 2.0 + 2 ** (1 / 6) * 0.9 - 3.0)
    x = np.linspace(0.5, 1.1, 7) * 0.9
    np.testing.assert_allclose(
        function(x + 2.0 - 3.0), 8.0 * ((0.9 / x) ** 12 - (0.9 / x) ** 6 + 0.25), rtol=1e-12
    )
    np.testing.assert_allclose(function(reach), 0.0, atol=1e-12)
    np.testing.assert_allclose(jax.grad(function)(reach), 0.0, atol=1e-12)


def test_repulsion_pushes_out_what_is_inside():
    function, _ = dpd.term(dpd.laws.shifted_repulsion, epsilon=1.0, sigma=1.0, r_0=2.0).between(
        R_i=0.0, R_j=3.0
    )
    edge = -0.5
    np.testing.assert_allclose(function(edge - 1e-9), function(edge + 1e-9), rtol=1e-6)
    np.testing.assert_allclose(
        jax.grad(function)(edge - 1e-9), jax.grad(function)(edge + 1e-9), rtol=1e-6
    )
    assert jax.grad(function)(-2.9) == jax.grad(function)(edge - 1e-6) < 0


def test_surface_drag_is_the_same_inside_and_out():
    term = dpd.term(dpd.laws.surface_drag, gamma_cs=5.0, r_c=1.0)
    function, reach = term.between()
    h = np.array([0.0, 0.25, 0.5, 1.0])
    np.testing.assert_allclose(function(h), 5.0 * (1 - h) ** 2)
    np.testing.assert_allclose(function(-h), function(h))
    assert reach == 1.0 and term.projector == "full" and function(-1.5) == 0


def test_projectors_are_declared_or_given():
    assert dpd.term(dpd.central_drag, gamma=1.0, r_c=1.0).projector == "central"
    assert dpd.term(dpd.laws.transverse_drag, gamma_t=1.0, r_c=1.0).projector == "transverse"
    assert (
        dpd.term(dpd.laws.surface_drag, gamma_cs=1.0, r_c=1.0, projector="central").projector
        == "central"
    )
    with pytest.raises(
        ValueError, match="projector is 'sideways'; it is one of central, transverse, full"
    ):
        dpd.term(dpd.central_drag, gamma=1.0, r_c=1.0, projector="sideways")
    with pytest.raises(ValueError, match="projector is 'up'"):
        dpd.laws.projected("up")
    with pytest.raises(
        ValueError, match="soft_repulsion is full, and the force of a potential is central"
    ):
        dpd.fluid([dpd.term(dpd.soft_repulsion, a=1.0, r_c=1.0, projector="full")], kT=1.0)
