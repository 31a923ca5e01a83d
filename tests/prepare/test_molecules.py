"""Molecules from words: architecture, amounts, arrangements, and a start that runs."""

import jax
import numpy as np
import pytest

import dpdjax as dpd
from dpdjax.bonded.forces import measured
from dpdjax.engine.observables import temperature
from dpdjax.prepare.architecture import architecture

KEY = jax.random.key(5)
SPRING = dpd.term(dpd.laws.harmonic_bond, k=4.0)
LONG = dpd.term(dpd.laws.harmonic_bond, k=100.0, r0=3.0)
FENE = dpd.term(dpd.laws.fene_bond, k=30.0, r_max=1.5)


@pytest.mark.parametrize(
    "word, beads, parent",
    [
        ("A", "A", [-1]),
        ("A2B3", "AABBB", [-1, 0, 1, 2, 3]),
        ("H3(T2)2", "HHHTTTT", [-1, 0, 1, 2, 3, 2, 5]),
        ("H2(T2)H(T2)", "HHTTHTT", [-1, 0, 1, 2, 1, 4, 5]),
        ("A(B2)3", "ABBBBBB", [-1, 0, 1, 0, 3, 0, 5]),
        ("[AB]3C", "ABABABC", [-1, 0, 1, 2, 3, 4, 5]),
        ("A[B(C)]2D", "ABCBCD", [-1, 0, 1, 1, 3, 3]),
        ("cyclo-A4", "AAAA", [-1, 0, 1, 2]),
    ],
)
def test_words(word, beads, parent):
    made = architecture(word)
    assert "".join(made.beads) == beads and list(made.parent) == parent


def test_a_ring_has_as_many_bonds_and_angles_as_beads():
    ring = architecture("cyclo-A5")
    assert ring.runs(2).tolist() == [[0, 1], [1, 2], [2, 3], [3, 4], [4, 0]]
    assert sorted(map(sorted, ring.runs(3).tolist())) == sorted(
        sorted([k, (k + 1) % 5, (k + 2) % 5]) for k in range(5)
    )


def test_angles_go_along_the_chain_and_out_along_its_branches():
    """And not from one branch to another."""
    assert architecture("H2(T2)2").runs(3).tolist() == [[0, 1, 2], [1, 2, 3], [0, 1, 4], [1, 4, 5]]


@pytest.mark.parametrize(
    "word, told",
    [
        ("", "no bead"),
        ("a5", "where a bead or a bracket"),
        ("A5(", "does not close"),
        ("A5)", "not open"),
        ("(A)5", "branches off before"),
        ("A0", "leave it out"),
        ("A()", "empty brackets"),
        ("cyclo-A(B)2", "no ring"),
        ("cyclo-A2", "no ring"),
        ("A999999", "more than"),
    ],
)
def test_words_that_are_none(word, told):
    with pytest.raises(ValueError, match=told):
        architecture(word)


def of(amounts, box=5.0, **how):
    return dpd.molecules(KEY, amounts, box=box, report=None, **how)


@pytest.fixture(scope="module")
def mixed():
    """Branched molecules, rings and single beads in one box."""
    return of(
        {"H2(T2)2": 0.3, "cyclo-R4": 0.2, "W": 0.5},
        a={"*": 25.0, "TW": 80.0},
        mass={"*": 1.0, "W": 2.0},
        bonds={
            "HT": dpd.term(dpd.laws.harmonic_bond, k=50.0, r0=0.5),
            "*": dpd.term(dpd.laws.harmonic_bond, k=4.0),
        },
        angles={"HTT": dpd.term(dpd.laws.cosine_angle, k=5.0)},
    )


def test_bonds_join_the_species_they_are_named_for(mixed):
    letter = {k: name for name, k in mixed.species.items()}
    species = np.asarray(mixed.state.species)
    named = lambda rows: {
        "".join(sorted(letter[species[k]] for k in row)) for row in np.asarray(rows)
    }
    beads = mixed.state.topology.beads
    assert named(beads["HT"]) == {"HT"}
    assert named(beads["bond"]) == {"HH", "TT", "RR"}
    assert named(beads["HTT"]) == {"HTT"}
    lipids, rings = len(mixed.ids["H2(T2)2"]), len(mixed.ids["cyclo-R4"])
    assert mixed.state.topology.counts == {
        "HT": 2 * lipids,
        "bond": 3 * lipids + 4 * rings,
        "HTT": 2 * lipids,
    }


def test_every_bead_is_of_one_molecule_and_of_its_species(mixed):
    everything = np.concatenate([rows.ravel() for rows in mixed.ids.values()])
    np.testing.assert_array_equal(np.sort(everything), np.arange(mixed.state.n))
    for word, rows in mixed.ids.items():
        wanted = [mixed.species[letter] for letter in architecture(word).beads]
        np.testing.assert_array_equal(
            np.asarray(mixed.state.species)[rows], np.tile(wanted, (len(rows), 1))
        )
    assert mixed.state.n == 375
    assert np.asarray(mixed.fluid.mass).tolist() == [1.0, 1.0, 1.0, 2.0]


def test_molecules_start_whole_and_run(mixed):
    assert not any(np.any(np.asarray(s)) for s in mixed.state.topology.sides.values())
    run = dpd.run(mixed.fluid, mixed.state, KEY, mixed.dt, dpd.Plan(4, 25), progress=False)
    assert run.frames["temperature"].max() < 1.3
    assert int(run.final.step) == 100
    for b in mixed.fluid.bonded:
        q = np.asarray(measured(mixed.fluid, run.final, b)[0])
        assert np.all(np.isfinite(q)) and (b.kind != "bond" or q.max() < 2.5)
    assert abs(float(temperature(mixed.fluid, mixed.state)) - 1.0) < 0.2


def test_a_bilayer_has_its_heads_outside_and_the_water_beyond():
    made = of(
        {"H2T3": 40, "W": 460},
        box=[5.0, 5.0, 9.0],
        a={"*": 25.0, "TW": 80.0, "TH": 50.0},
        arrangement="bilayer",
    )
    z = np.asarray(made.state.position)[:, 2]
    water = z[made.ids["W"].ravel()]
    z = z[made.ids["H2T3"]]
    from_middle = np.abs(z - 4.5)
    assert np.all(from_middle[:, 0] > from_middle[:, -1])
    upper = z[:, 0] > 4.5
    assert upper.sum() == 20
    assert np.median(np.abs(water - 4.5)) > from_middle[:, 0].mean()


def test_lamellae_fill_the_box():
    made = of({"A2B2": 1.0}, box=[4.0, 4.0, 8.0], arrangement="lamella", periods=2)
    z = np.asarray(made.state.position)[:, 2][made.ids["A2B2"]] % 4.0
    # A from 0 to 1 and 3 to 4 of each period, B in the middle.
    outside = lambda z: np.abs(z - 2.0) > 1.0
    assert outside(z[:, :2]).mean() > 0.85 and outside(z[:, 2:]).mean() < 0.15


@pytest.mark.parametrize(
    "amounts, how, told",
    [
        ({"A2": 0.5, "B": 0.2}, {}, "add up to 0.7"),
        ({"A2": 1.0}, {"a": {"AB": 3.0}}, "no pair of A"),
        ({"A2B": 1.0}, {"a": {"AA": 3.0}}, "no number for AB, BB"),
        (
            {"A2": 1.0},
            {"bonds": {"AB": dpd.term(dpd.laws.harmonic_bond, k=1.0)}},
            "molecules have AA",
        ),
        ({"A2": 5}, {"density": 3.0}, "leave out density"),
        ({"A2": 1.0}, {"arrangement": "bilayers"}, "arrangement is"),
        ({"A2": 1.0}, {"arrangement": {"B": "bilayer"}}, "arrangement names 'B'"),
        ({"A2B": 1.0}, {"mass": {"A": 1.0}}, "mass names A"),
        ({"A2B2": 1.0}, {"bonds": {"AA": SPRING, "BB": SPRING}}, "bonds has none for AB"),
        ({"A2": 1.0}, {"bonds": ()}, "bonds has none for AA"),
        ({"AB": 1.0}, {"bonds": {"AB": SPRING, "B-A": SPRING}}, "'AB' and 'B-A', which are the"),
        ({"NaCl": 1.0}, {"a": {"*": 25, "NaCl": 30, "ClNa": 50}}, "two numbers for 'NaCl'"),
        ({"A900": 0.1, "W": 0.9}, {}, "no whole molecule of 900 beads"),
        ({"A2": 1.0}, {"bonds": LONG}, "bonds start 3.01 long, more than half of a side"),
        ({"A2": 1.0}, {"kT": 0.0}, "kT is 0.0; it must be above zero; or give a="),
        ({"A2": 1.0}, {"kT": 0.0, "a": 25.0}, "bonds follow it, or give bonds="),
        (
            {"A2B2": 1.0},
            {"bonds": FENE, "arrangement": "lamella", "box": [4.0, 4.0, 20.0]},
            "is 2.5 long, where its energy is inf",
        ),
    ],
)
def test_what_cannot_be_made_is_told(amounts, how, told):
    with pytest.raises(ValueError, match=told):
        of(amounts, **how)


def test_it_prints_what_it_made(mixed):
    assert "375 beads in 5 x 5 x 5: 19 of H2(T2)2" in str(mixed)
    assert "of cyclo-R4" in str(mixed) and "angle HTT  cosine_angle, k 5" in str(mixed)


def test_repulsion_and_springs_follow_the_units():
    made = of("A3", box=8.0, kT=0.5, r_c=2.0, gamma=9.0)
    assert made.fluid.value("a") == 25.0 * 0.5 / 2.0
    assert made.fluid.value("k") == 4.0 * 0.5 / 2.0**2
