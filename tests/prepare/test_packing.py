"""Spheres that do not overlap, and points in the room between them."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dpdjax.pairs import box as boxes
from dpdjax.prepare import packing

CUBE, SLAB = (1.0, 1.0, 1.0), (1.0, 2.0, 0.8)


def spheres(n, spread):
    """Gaussian radii of mean 1."""
    return np.clip(1 + spread * np.random.default_rng(n).normal(size=n), 0.4, None)


def box_for(radius, fraction, shape=CUBE, dtype=None):
    """The box of a shape that spheres fill to a fraction."""
    shape = np.asarray(shape)
    box = boxes.box(shape * np.cbrt(4 / 3 * np.pi * np.sum(radius**3) / fraction / shape.prod()))
    return jax.tree.map(lambda leaf: leaf.astype(dtype), box) if dtype else box


def separations(box, a, b):
    """Nearest-image distances (len(a), len(b)) in plain numpy and double precision."""
    lengths = np.asarray(box.lengths, float)
    d = np.asarray(a, float)[:, None] - np.asarray(b, float)[None]
    d -= lengths * np.round(d / lengths)
    return np.sqrt(np.einsum("ijk,ijk->ij", d, d))


def gaps(box, position, radius):
    """Surface gaps of all pairs."""
    i, j = np.triu_indices(len(radius), 1)
    return separations(box, position, position)[i, j] - radius[i] - radius[j]


def is_inside(box, position):
    return np.all(np.asarray(position) >= 0) and np.all(
        np.asarray(position) < np.asarray(box.lengths)
    )


@pytest.mark.parametrize(
    "fraction, n, spread, shape, gap",
    [
        (0.05, 120, 0.0, CUBE, None),
        (0.2, 260, 0.2, SLAB, None),
        (0.2, 120, 0.1, SLAB, 0.3),
        (0.45, 400, 0.0, CUBE, None),
        (0.45, 150, 0.15, SLAB, 0.0),
        (0.58, 120, 0.0, CUBE, None),
        (0.1, 2, 0.0, CUBE, None),
        (0.02, 1, 0.0, CUBE, None),
    ],
)
def test_no_gap_is_narrower_than_wanted(fraction, n, spread, shape, gap, key):
    radius = spheres(n, spread)
    box = box_for(radius, fraction, shape)
    position = packing.pack(key, box, radius, gap=gap)
    assert position.shape == (n, 3) and position.dtype == jnp.float64
    assert is_inside(box, position)
    wanted = 0.02 * radius.min() if gap is None else gap
    assert np.all(gaps(box, position, radius) > wanted)


def test_a_large_sphere_among_small_ones(key):
    """It touches so many at once that it would be thrown about, did it not give way less."""
    radius = np.repeat([3.0, 0.2], [1, 2200])
    box = boxes.box(12.3)
    assert gaps(box, packing.pack(key, box, radius), radius).min() > 0.02 * 0.2


def test_the_same_key_gives_the_same_bits_and_another_other_spheres(key):
    radius = spheres(150, 0.15)
    box = box_for(radius, 0.45, SLAB)
    first, again = (packing.pack(key, box, radius, gap=0.0) for _ in range(2))
    assert jnp.array_equal(first, again)
    assert jnp.array_equal(
        first, packing.pack(jax.random.key_data(key), box, jnp.asarray(radius), gap=0.0)
    )
    other = packing.pack(jax.random.key(8), box, radius, gap=0.0)
    assert np.median(np.diag(separations(box, first, other))) > 1.0


def test_a_list_that_overflows_grows_and_changes_nothing(key, monkeypatch):
    radius = spheres(24, 0.1)
    box = box_for(radius, 0.3)
    whole = packing.pack(key, box, radius)
    monkeypatch.setattr(packing, "_roomy", lambda grid: dataclasses.replace(grid, capacity=16))
    assert jnp.array_equal(packing.pack(key, box, radius), whole)


def highest_peak(box, position):
    """The largest structure factor over the wave vectors of the box, per sphere: 1 for a lattice
    that fits."""
    count = np.arange(-8, 9)
    index = np.stack(np.meshgrid(count[8:], count, count), -1).reshape(-1, 3)
    index = index[np.any(index != 0, axis=1)]
    wave = 2 * np.pi * index / np.asarray(box.lengths)
    return np.max(np.abs(np.mean(np.exp(1j * wave @ np.asarray(position).T), axis=1))) ** 2


def test_packed_spheres_are_no_lattice(key):
    radius = spheres(400, 0.0)
    box = box_for(radius, 0.45)
    cell = np.array([[0, 0, 0], [0, 1, 1], [1, 0, 1], [1, 1, 0]]) / 2
    corners = np.stack(np.meshgrid(*[np.arange(5)] * 3), -1).reshape(-1, 1, 3)
    lattice = (corners + cell).reshape(-1, 3) / 5 * np.asarray(box.lengths)
    shaken = lattice + 0.1 * np.random.default_rng(0).normal(size=lattice.shape)
    assert highest_peak(box, shaken) > 0.5
    assert highest_peak(box, packing.pack(key, box, radius)) < 0.1


def test_packed_spheres_have_about_the_contacts_of_a_liquid():
    """Pairs near contact, against Carnahan & Starling: random points have none, spheres merely
    separated too many."""
    n, fraction = 400, 0.45
    radius = spheres(n, 0.0)
    box = box_for(radius, fraction)
    close = [
        np.sum(gaps(box, packing.pack(jax.random.key(k), box, radius), radius) < 0.1)
        for k in range(3)
    ]
    ideal = n / 2 * fraction * (2.1**3 - 2.0**3)
    assert 0.6 < np.mean(close) / ideal / ((1 - fraction / 2) / (1 - fraction) ** 3) < 1.2


@pytest.fixture(scope="module")
def suspension(key):
    """Thirty spheres of several sizes, and 20,000 points around them."""
    radius = spheres(30, 0.15)
    box = box_for(radius, 0.3, (1.0, 1.3, 0.9))
    centres = packing.pack(key, box, radius)
    return box, centres, radius, packing.fill(key, box, centres, radius, 20_000)


def test_points_are_outside_all_spheres(suspension):
    box, centres, radius, points = suspension
    assert points.shape == (20_000, 3) and points.dtype == jnp.float64
    assert is_inside(box, points)
    assert np.all(separations(box, points, centres) > radius)
    assert len(np.unique(points[:, 0])) > 19_990, "no point is drawn twice"


def chi_square(sample, expected):
    """Of counts against shares, and how many standard deviations it is above its mean."""
    expected = expected / expected.sum() * sample.sum()
    enough = expected > 20
    count = enough.sum() - 1
    return (np.sum((sample - expected)[enough] ** 2 / expected[enough]) - count) / np.sqrt(
        2 * count
    )


def test_points_are_uniform_in_the_free_volume(suspension):
    box, centres, radius, points = suspension
    lengths = np.asarray(box.lengths)
    fine = (
        np.stack(np.meshgrid(*[np.arange(48)] * 3, indexing="ij"), -1).reshape(-1, 3) + 0.5
    ) / 48
    distance = lambda position: np.min(separations(box, position, centres) - radius, axis=1)
    from_points, from_fine = distance(points), distance(fine * lengths)
    free = from_fine > 0
    by_cell = lambda s: np.histogramdd(s, bins=4, range=[(0, 1)] * 3)[0].ravel()
    assert abs(chi_square(by_cell(np.asarray(points) / lengths), by_cell(fine[free]))) < 4
    # The layer at the surfaces would show points that were moved there instead of drawn anew.
    by_gap = lambda h: np.histogram(h, bins=np.linspace(0, 1.2, 13))[0]
    assert abs(chi_square(by_gap(from_points), by_gap(from_fine[free]))) < 4


def test_points_keep_clear_of_spheres_found_through_cells(key):
    radius = spheres(100, 0.15)
    box = box_for(radius, 0.2)
    centres = packing.pack(key, box, radius)
    points = packing.fill(key, box, centres, radius, 5000, clearance=0.2)
    nearest = np.min(separations(box, points, centres) - radius, axis=1)
    assert 0.2 < nearest.min() < 0.21


def test_points_are_a_function_of_the_key(suspension, key):
    box, centres, radius, points = suspension
    assert jnp.array_equal(packing.fill(key, box, centres, radius, 20_000), points)
    assert not np.isin(
        np.asarray(packing.fill(jax.random.key(8), box, centres, radius, 20_000)), points
    ).any()


def test_single_precision(key):
    radius = spheres(60, 0.1)
    box = box_for(radius, 0.45, dtype=jnp.float32)
    centres = packing.pack(key, box, radius)
    points = packing.fill(key, box, centres, radius, 2000)
    assert centres.dtype == points.dtype == jnp.float32
    assert is_inside(box, centres) and is_inside(box, points)
    assert gaps(box, centres, radius).min() > 0.02 * radius.min() - 1e-5
    assert np.min(separations(box, points, centres) - radius) > -1e-5


TEN = np.ones(10)


@pytest.mark.parametrize(
    "sides, radius, gap, message",
    [
        (
            5.0,
            np.ones(25),
            None,
            r"fraction 0\.8378 .* not below 0\.6.*use at most 17 such spheres, or sides over "
            r"1\.118 times",
        ),
        (10.0, [1.0, -1.0], None, "radius is .* must be above zero"),
        (10.0, 1.0, None, "one for each sphere"),
        (10.0, np.ones((3, 3)), None, "one for each sphere"),
        (10.0, [], None, "one for each sphere"),
        (10.0, TEN, -0.1, "gap is -0.1; it must not be negative"),
        (
            10.0,
            TEN,
            4.5,
            r"with gaps of 4\.5 fill more than 0\.6 of the box; use a gap below 2\.857",
        ),
        ((20.0, 20.0, 4.02), TEN, None, r"side 4\.02 is below 2 \(2 radius \+ gap\) = 4\.04"),
    ],
)
def test_spheres_that_cannot_be_packed(sides, radius, gap, message, key):
    with pytest.raises(ValueError, match=message):
        packing.pack(key, boxes.box(sides), radius, gap=gap)


def test_what_the_message_says_would_pass_does(key):
    for sides, n in ((5.0, 17), (5.0 * 1.119, 25)):
        packing._checked_gap(np.full(3, sides), np.ones(n), None)


@pytest.mark.parametrize(
    "radius, count, clearance, message",
    [
        (np.ones(9), 100, 0.0, r"centres have shape \(10, 3\); 9 radii need \(9, 3\)"),
        (0.0 * TEN, 100, 0.0, "radius is .* must be above zero"),
        (TEN, 0, 0.0, "count is 0"),
        (TEN, 100, -0.5, "clearance is -0.5; it must not be negative"),
        (TEN, 100, 4.5, r"side 10 is below 2 \(radius \+ clearance\) = 11"),
    ],
)
def test_points_that_cannot_be_placed(radius, count, clearance, message, key):
    with pytest.raises(ValueError, match=message):
        packing.fill(key, boxes.box(10.0), np.zeros((10, 3)), radius, count, clearance=clearance)


def test_spheres_and_points_need_one_key_known_numbers_and_a_box_at_rest(key):
    box, centre, one = boxes.box(10.0), np.zeros((1, 3)), np.ones(1)
    for place in (
        lambda key, box: packing.pack(key, box, one),
        lambda key, box: packing.fill(key, box, centre, one, 5),
    ):
        with pytest.raises(TypeError, match="key"):
            place(None, box)
        with pytest.raises(ValueError, match="3 keys where one is wanted"):
            place(jax.random.split(key, 3), box)
        with pytest.raises(ValueError, match="outside jit"):
            jax.vmap(place, (0, None))(jax.random.split(key, 3), box)
        with pytest.raises(ValueError, match="strain of 0.3"):
            place(key, box.strained(0.3))


def test_giving_up_says_what_is_left(key, monkeypatch):
    monkeypatch.setattr(packing, "MOST_SWEEPS", 2)
    monkeypatch.setattr(packing, "MOST_ROUNDS", 3)
    radius = spheres(24, 0.1)
    box = box_for(radius, 0.3)
    with pytest.raises(
        RuntimeError,
        match=r"fraction 0\.3 is still -.* after 2 sweeps.*smaller gap, or another key",
    ):
        packing.pack(key, box, radius)
    centres = jax.random.uniform(key, (24, 3)) * box.lengths[None]
    with pytest.raises(RuntimeError, match="of 500 points are still inside spheres after 3 rounds"):
        packing.fill(key, box, centres, radius, 500, clearance=0.5)
