"""Numbers of a fluid: asked for without doubt, scaled as said, and told in kT."""

import warnings
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dpdjax as dpd
from dpdjax.host.cautions import deep_wells
from dpdjax.model.colloids import solvent_viscosity
from dpdjax.prepare.suspension import Suspension


@pytest.fixture(scope="module")
def colloids():
    return dpd.colloid_fluid(kT=0.1, D0=1.2)


def test_terms_that_disagree_are_not_decided_by_the_first(colloids):
    changed = colloids.set(gamma=9.0, between=(0, 1))
    with pytest.raises(
        ValueError,
        match=r"disagree on 'gamma': 4.5 of central_drag between .*; 9.0 of "
        r"balanced_drag.*between=",
    ):
        changed.value("gamma")
    assert (
        changed.value("gamma", between=(1, 0)) == 9.0
        and changed.value("gamma", between=(0, 0)) == 4.5
    )
    assert colloids.value("gamma") == 4.5 and "gamma" in colloids.coefficients
    with pytest.raises(TypeError, match="no term between .* has 'D0'"):
        colloids.value("D0", between=(0, 0))
    with pytest.raises(ValueError, match=r"no interaction between \(0, 2\)"):
        colloids.value("gamma", between=(0, 2))
    read = jax.jit(lambda fluid: fluid.value("gamma"))
    assert read(colloids) == 4.5 and np.isnan(read(changed)), (
        "traced, they cannot be told apart but inside"
    )


def test_a_viscosity_is_declared_and_one(colloids):
    @dpd.laws.of_viscosity("eta")
    def squeeze(h, *, eta):
        return eta / h

    assert solvent_viscosity(colloids) == pytest.approx(0.3)
    mine = dpd.fluid(
        interactions=[dpd.interaction((0, 0), drag=dpd.term(squeeze, eta=0.7, reach=1.0))],
        kT=1.0,
        radius=(1.0,),
    )
    assert float(dpd.theory.diffusion_time(mine)) == pytest.approx(6 * np.pi * 0.7)


def test_a_new_temperature_keeps_or_scales_energies_as_said(water, colloids):
    with pytest.warns(
        UserWarning, match='kT is now 0.1 and was 1, .*energies="keep".*energies="scale"'
    ) as seen:
        assert water.set(kT=0.1).value("a") == 25.0
    assert len(seen) == 1 and seen[0].filename == __file__
    cold = colloids.set(kT=0.2, energies="scale")
    for name in ("a", "strength", "f", "D0"):
        assert float(cold.value(name)) == pytest.approx(2 * float(colloids.value(name)))
    assert float(colloids.set(kT=0.2, D0=1.0, energies="scale").value("D0")) == 1.0, (
        "what is given counts"
    )
    traced = jax.jit(jax.vmap(lambda kT: water.set(kT=kT, energies="scale").value("a")))
    np.testing.assert_allclose(traced(jnp.array([1.0, 0.1])), [25.0, 2.5])
    depletion = dpd.colloid_fluid(attraction=dpd.term(dpd.laws.asakura_oosawa, phi_p=0.2, r_g=0.1))
    assert float(depletion.set(kT=0.2, energies="scale").value("phi_p")) == pytest.approx(0.2), (
        "its energy is kT's already"
    )


def test_no_warning_where_it_is_said_or_cannot_be_misread(water, ideal):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for numbers in (
            {"kT": 1.0},
            {"kT": 0.0},
            {"kT": 2.0, "a": 50.0},
            {"kT": jnp.array([1.0, 2.0])},
        ):
            water.set(**numbers)
        water.set(kT=2.0, energies="keep"), water.set(gamma=2.0, energies="keep"), ideal.set(kT=2.0)
        jax.jit(lambda kT: water.set(kT=kT).kT)(2.0)


def test_scaling_that_cannot_be():
    law = lambda h, *, k: k * h
    fluid = dpd.fluid([dpd.term(law, k=1.0, reach=1.0)], kT=1.0)
    with pytest.raises(
        ValueError, match="does not say which coefficient it is proportional to.*proportional_to"
    ):
        fluid.set(kT=2.0, energies="scale")
    with pytest.raises(ValueError, match="kT was 0"):
        fluid.set(kT=0.0).set(kT=2.0, energies="scale")
    with pytest.raises(ValueError, match="goes with a new kT"):
        fluid.set(k=2.0, energies="scale")
    with pytest.raises(ValueError, match="energies is 'both'"):
        fluid.set(kT=2.0, energies="both")


def test_energies_are_told_in_kT(water):
    deep = dpd.colloid_fluid(kT=0.1, D0=8.0)
    assert "morse, D0 8, kappa 30, r0 0, r_c 1: -80 kT at contact, 80 kT deep at h = 0" in str(deep)
    assert repr(water) == "Fluid(kT=1, 1 species, 0-0: soft_repulsion, central_drag)"
    assert "12.5 kT at contact" in str(water)
    told = []
    jax.eval_shape(lambda kT: told.append(str(water.set(kT=kT))), 1.0)
    assert "kT traced ()" in told[0] and "no energies in kT" in told[0]


def test_a_depth_meant_in_kT_is_cautioned_about():
    (said,) = deep_wells(dpd.colloid_fluid(kT=0.1, D0=8.0))
    assert said.startswith("morse is 80 kT deep") and "in which kT is 0.1" in said
    assert deep_wells(dpd.colloid_fluid(kT=0.1, D0=1.2)) == []
    assert deep_wells(dpd.colloid_fluid().set(D0=jnp.array([0.0, 8.0]))), "the deepest of a scan"


def test_a_suspension_tells_its_energies_in_kT():
    state = SimpleNamespace(
        box=SimpleNamespace(lengths=np.ones(3)),
        neighbours=(),
        species=np.array([0, 1]),
        size=np.ones(2),
        n=2,
    )
    made = Suspension(
        dpd.colloid_fluid(kT=0.1, D0=8.0), state, 0.1, 56.5, 1e-3, dpd.integrators.VelocityVerlet()
    )
    assert (
        "between colloids: contact 2.5 kT at contact; morse -80 kT at contact, 80 kT deep at h = 0"
        in str(made)
    )
