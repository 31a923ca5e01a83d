"""Contacts and bonds of spheres: configurations known by hand, and every pair followed by force."""

import numpy as np
import pytest
from clouds import (
    SIDES,
    STRAINS,
    gaps_by_force,
    mixed_radii,
    nearest_by_force,
    one_frame,
    recorded,
    thrown,
)

import dpdjax as dpd
from dpdjax.measure.contact_bonds import bonded_pairs, contact_bonds
from dpdjax.measure.contacts import contact_number
from dpdjax.measure.spheres import Spheres


def apart(*gaps):
    """Pairs of spheres of diameter 1 along x with these gaps, one frame to each, (frames, 2, 3)."""
    position = np.ones((len(gaps), 2, 3))
    position[:, 1, 0] += 1.0 + np.array(gaps)
    return position


# Contacts.


def test_contacts_of_a_dimer_and_a_monomer():
    position = np.concatenate([apart(0.1)[0], [[1.0, 4.0, 4.0]]])
    contacts = contact_number(one_frame(position), gap=0.2)
    assert contacts.z.tolist() == [0, 1] and np.allclose(contacts.share, [1 / 3, 2 / 3])
    assert contacts.mean.value == pytest.approx(2 / 3) and np.isnan(contacts.mean.error)
    assert contact_number(one_frame(position), gap=0.05).mean.value == 0


@pytest.mark.parametrize("shift, contacts", [(1.5, 1), (0.0, 0), (-1.5, 0)])
def test_contacts_across_a_tilted_face(shift, contacts):
    """The image above the lower sphere stands ``shift`` off along x: over the upper sphere, or
    not."""
    position = np.array([[1.0, 0.4, 1.0], [2.5, 6.4, 1.0]])
    assert contact_number(one_frame(position, strain=shift / 7), gap=0.01).mean.value == contacts


@pytest.mark.parametrize("strain", STRAINS)
def test_contacts_are_those_of_all_images(strain):
    position, radius = thrown(6, 50), mixed_radii(50)
    contacts = contact_number(Spheres(position, radius, SIDES, strain), gap=0.5)
    by_force = np.array(
        [2 * np.sum(nearest_by_force(x, radius, strain) < 0.5) / 50 for x in position]
    )
    assert np.allclose(contacts.series, by_force[None])
    assert contacts.share.sum() == pytest.approx(1)
    assert np.sum(contacts.z * contacts.share) == pytest.approx(contacts.mean.value)
    assert contacts.mean.error > 0 and np.all(contacts.error >= 0)


def test_the_gap_of_a_fluid_with_a_range():
    """That of the attraction between the spheres, up to its reach; a Yukawa ``kappa`` is none."""
    run = lambda **numbers: recorded(
        apart(0.1, 0.3), fluid=dpd.colloid_fluid(radius=0.5, **numbers)
    )
    assert contact_number(run(kappa=15.0)).gap == pytest.approx(0.2)
    assert contact_number(run(kappa=15.0, r0=0.05)).gap == pytest.approx(0.25)
    assert contact_number(run(kappa=2.0)).gap == pytest.approx(1.0), "cut off at r_c"
    assert contact_number(run(kappa=15.0)).series.tolist() == [[1, 0]]
    assert contact_number(run(kappa=15.0), gap=0.5).series.tolist() == [[1, 1]]
    depletion = dpd.term(dpd.laws.asakura_oosawa, phi_p=0.2, r_g=0.1)
    assert contact_number(run(attraction=depletion)).gap == pytest.approx(0.2 * (1 - 0.1**0.5))
    charged = dpd.term(dpd.laws.yukawa, epsilon=1.0, kappa=15.0)
    scan = dpd.colloid_fluid(radius=0.5).set(kappa=np.array([15.0, 20.0]))
    for what in (run(attraction=charged), one_frame(apart(0.1))):
        with pytest.raises(ValueError, match="no gap is given.*give gap"):
            contact_number(what)
    with pytest.raises(ValueError, match="differ in kappa"):
        contact_number(recorded(apart(0.1), fluid=scan))


# Bonds.


def test_a_bond_in_and_out_of_the_band():
    """Gap 1: forms below 0.8, lives on in the band up to 1, breaks above, does not form in the
    band."""
    tracked = contact_bonds(one_frame(apart(0.9, 0.7, 0.9, 1.0, 0.95, 1.1, 0.9, 0.5)), gap=1.0)
    assert tracked.number.tolist() == [[0, 1, 1, 1, 1, 0, 0, 1]]
    assert tracked.formed.tolist() == [[0, 1, 0, 0, 0, 0, 0, 1]]
    assert tracked.broken.tolist() == [[0, 0, 0, 0, 0, 1, 0, 0]]
    assert tracked.per_colloid.value == pytest.approx(5 / 8)


def test_bonds_without_a_band_are_contacts():
    gas = Spheres(thrown(2, 10, 40), mixed_radii(40), SIDES, 0.2)
    tracked, contacts = contact_bonds(gas, gap=0.5, forms=1.0), contact_number(gas, gap=0.5)
    assert np.allclose(2 * tracked.number / 40, contacts.series)
    assert tracked.per_colloid.value == pytest.approx(contacts.mean.value)
    assert tracked.per_colloid.error == pytest.approx(contacts.mean.error)


def wandering(frames=24, batch=2, n=40, seed=3):
    """Spheres that wander so that bonds come and go."""
    steps = 0.15 * np.random.default_rng(seed).normal(size=(batch, frames, n, 3))
    steps[:, 0] = thrown(batch, n, seed=seed)
    return Spheres(
        np.cumsum(steps, axis=1),
        mixed_radii(n),
        SIDES,
        0.1 * np.arange(frames),
        0.5 * np.arange(frames),
    )


def test_bonds_by_force():
    """Every pair of every frame followed on its own."""
    gas = wandering()
    tracked, pairs = contact_bonds(gas, gap=0.4, t_max=2.0), bonded_pairs(gas, gap=0.4)
    there = np.zeros((2, 24, 40, 40), bool)
    for b, t in np.ndindex(2, 24):
        h = gaps_by_force(gas.position[b, t], gas.radius[b], gas.strain[b, t])[0].min(axis=-1)
        before = there[b, t - 1] if t else np.zeros((40, 40), bool)
        there[b, t] = np.triu((h < 0.32) | (before & (h <= 0.4)), 1)
        assert np.array_equal(pairs[b][t], np.argwhere(there[b, t]))
    assert np.array_equal(tracked.number, there.sum((2, 3)))
    assert np.array_equal(tracked.formed[:, 1:], (there[:, 1:] & ~there[:, :-1]).sum((2, 3)))
    assert np.array_equal(tracked.broken[:, 1:], (there[:, :-1] & ~there[:, 1:]).sum((2, 3)))
    # Longest lag 4 frames: three stretches of 8 frames to a member, 4 origins each.
    origins = [8 * k + o for k in range(3) for o in range(4)]
    survive = np.array(
        [[np.all(there[:, o : o + lag + 1], axis=1).sum() for lag in range(5)] for o in origins]
    )
    assert np.allclose(tracked.lag, 0.5 * np.arange(5))
    assert np.allclose(tracked.survival, survive.sum(0) / survive.sum(0)[0])
    assert np.all(tracked.error[1:] > 0) and tracked.error[0] == 0


def test_survival_of_bonds_that_all_break():
    """Ten dimers, those of gap below the frame's number over ten broken: one more each frame."""
    frames, pairs = 11, 10
    position = np.ones((frames, 2 * pairs, 3))
    position[:, :, 2] = np.repeat(1.2 * np.arange(pairs), 2)
    held = np.arange(pairs)[None, :] >= np.arange(frames)[:, None]
    position[:, 1::2, 0] += np.where(held, 1.01, 1.5)
    tracked = contact_bonds(Spheres(position, 0.5, [6.0, 6.0, 12.0]), gap=0.1, t_max=10.0)
    assert np.allclose(tracked.survival, 1 - np.arange(frames) / 10)
    assert tracked.broken.tolist() == [[0] + 10 * [1]]
    assert np.all(np.isnan(tracked.error))


def test_bonds_of_nothing():
    tracked = contact_bonds(one_frame(apart(2.0, 2.0, 2.0)), gap=0.5)
    assert tracked.number.tolist() == [[0, 0, 0]] and np.all(np.isnan(tracked.survival))
    assert bonded_pairs(one_frame(apart(2.0)), gap=0.5)[0][0].shape == (0, 2)
    assert contact_bonds(one_frame(apart(0.1)), gap=0.5).survival.tolist() == [1.0]
