"""Distances of segments against a reference: bisection of a convex function, in extended precision.

The least distance to a point x(s) of the first segment is convex in s, and its slope is known: the
reference halves the interval in which that changes sign. Segments are about 1 long unless said
otherwise; the softness of `near` is that of rods whose diameter is a fifth of that.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import finite_difference_jvp, rotation

from derjax.terms.contact.segments import Near, between, closest, distance, near

# Rounding of nearly degenerate pairs shows in derivatives, and more of it without optimisation.
pytestmark = pytest.mark.optimised

SOFTNESS = 0.01
N = 10_000
LONG = np.longdouble


# Pairs of every kind --------------------------------------------------------------------------


def random_directions(rng: np.random.Generator, n: int) -> np.ndarray:
    u = rng.standard_normal((n, 3))
    return u / np.linalg.norm(u, axis=1, keepdims=True)


def at_angle(rng: np.random.Generator, n: int, angle: float, gap: float) -> np.ndarray:
    """Segments of length 1 whose lines pass at a distance `gap` and an `angle` (rad)."""
    u = random_directions(rng, n)
    across = np.cross(u, random_directions(rng, n))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    v = np.cos(angle) * u + np.sin(angle) * across
    # where on either line they are closest: half of them within the segments
    s, t = rng.uniform(-0.5, 1.5, (2, n, 1))
    start = -s * u
    other = gap * np.cross(u, across) - t * v
    return np.stack([start, start + u, other, other + v], axis=1)


def collinear(rng: np.random.Generator, n: int) -> np.ndarray:
    """On one line, apart or overlapping."""
    u = random_directions(rng, n)
    shift = rng.uniform(-2.5, 2.5, (n, 1))
    return np.stack([0 * u, u, shift * u, (shift + 0.7) * u], axis=1)


def end_to_end(rng: np.random.Generator, n: int, gap: float) -> np.ndarray:
    """The end of the first before the start of the second; at gap 0 they share it."""
    u, v = random_directions(rng, n), random_directions(rng, n)
    v = np.where(np.sum(u * v, axis=1, keepdims=True) < -0.5, -v, v)  # not folded back
    start = (1.0 + gap) * u
    return np.stack([0 * u, u, start, start + v], axis=1)


def scaled(rng: np.random.Generator, n: int, first: float, second: float) -> np.ndarray:
    """Segments of random lengths around `first` and `second`."""
    x = rng.standard_normal((n, 4, 3))
    x[:, 1] = x[:, 0] + first * (x[:, 1] - x[:, 0])
    x[:, 3] = x[:, 2] + second * (x[:, 3] - x[:, 2])
    return x


KINDS = {
    "random": lambda rng, n: rng.standard_normal((n, 4, 3)),
    "crossing": lambda rng, n: at_angle(rng, n, 0.8, 0.0),
    "passing": lambda rng, n: at_angle(rng, n, 0.8, 0.2),
    "parallel": lambda rng, n: at_angle(rng, n, 0.0, 0.2),
    "antiparallel": lambda rng, n: at_angle(rng, n, np.pi, 0.2),
    "parallel to 1e-12": lambda rng, n: at_angle(rng, n, 1e-12, 0.2),
    "parallel to 1e-7": lambda rng, n: at_angle(rng, n, 1e-7, 0.2),
    "parallel to 1e-3": lambda rng, n: at_angle(rng, n, 1e-3, 0.2),
    "crossing at 1e-5": lambda rng, n: at_angle(rng, n, 1e-5, 0.0),
    "crossing at 1e-3": lambda rng, n: at_angle(rng, n, 1e-3, 0.0),
    "collinear": collinear,
    "end to end": lambda rng, n: end_to_end(rng, n, 0.1),
    "shared end": lambda rng, n: end_to_end(rng, n, 0.0),
    "a point": lambda rng, n: scaled(rng, n, 0.0, 1.0),
    "another point": lambda rng, n: scaled(rng, n, 1.0, 0.0),
    "two points": lambda rng, n: scaled(rng, n, 0.0, 0.0),
    "short": lambda rng, n: scaled(rng, n, 1e-6, 1e-6),
    "short and long": lambda rng, n: scaled(rng, n, 1e-4, 1e4),
    "long": lambda rng, n: scaled(rng, n, 1e3, 1e3),
}


def pairs_of_every_kind(n: int) -> tuple[np.ndarray, np.ndarray]:
    """About n pairs (.., 4, 3), half of them of the first kind, and the index of their kinds."""
    rng = np.random.default_rng(7)
    few = n // (2 * len(KINDS) - 2)
    counts = [n - few * (len(KINDS) - 1)] + [few] * (len(KINDS) - 1)
    parts = [make(rng, k) for make, k in zip(KINDS.values(), counts, strict=True)]
    return np.concatenate(parts), np.repeat(np.arange(len(KINDS)), counts)


PAIRS, KIND = pairs_of_every_kind(N)
SIZE = np.abs(PAIRS).max(axis=(1, 2))


def of(*names: str) -> np.ndarray:
    """Which pairs are of these kinds."""
    return np.isin(KIND, [list(KINDS).index(name) for name in names])


# The reference --------------------------------------------------------------------------------


def reference(pair: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Closest points (s, t) and the vector between them, in extended precision."""
    x0, x1, y0, y1 = (pair[:, i].astype(LONG) for i in range(4))
    u, v = x1 - x0, y1 - y0
    square = np.sum(v * v, axis=1)
    low, high = np.zeros(len(pair), LONG), np.ones(len(pair), LONG)

    def look(s):
        x = x0 + s[:, None] * u
        t = np.sum((x - y0) * v, axis=1) / np.where(square > 0, square, 1)
        t = np.clip(t, 0, 1)
        return t, x - y0 - t[:, None] * v

    for _ in range(70):
        s = (low + high) / 2
        ahead = np.sum(look(s)[1] * u, axis=1) > 0
        low, high = np.where(ahead, low, s), np.where(ahead, s, high)
    # what is at an end is exactly there
    s = np.where(low == 0, 0, np.where(high == 1, 1, (low + high) / 2))
    return s, *look(s)


def norm(x: np.ndarray) -> np.ndarray:
    return np.sqrt(np.sum(x * x, axis=-1))


S, T, GAP = reference(PAIRS)
LENGTHS = norm(PAIRS[:, 1] - PAIRS[:, 0]), norm(PAIRS[:, 3] - PAIRS[:, 2])
ANGLE = norm(np.cross(PAIRS[:, 1] - PAIRS[:, 0], PAIRS[:, 3] - PAIRS[:, 2])) / (
    np.where(LENGTHS[0] > 0, LENGTHS[0], 1) * np.where(LENGTHS[1] > 0, LENGTHS[1], 1)
)
"""Sine of the angle between the segments."""
UNIQUE = (norm(GAP) > 1e-2) & (ANGLE > 1e-2) & ~of("short", "short and long")
"""Where the closest points are unique, well enough for 1e-10."""


def envelope(pair: np.ndarray) -> np.ndarray:
    """(.., 12) gradient of the distance: the closest points do not move it to first order."""
    s, t, gap = reference(pair)
    weights = np.stack([1 - s, s, t - 1, -t], axis=1)
    normal = gap / np.maximum(norm(gap), 1e-30)[:, None]
    return (weights[:, :, None] * normal[:, None, :]).reshape(-1, 12)


@jax.jit
def exact(pair, along):
    """Distance, gradient in reverse and forward mode, second derivative along a direction."""

    def total(x):
        return jnp.sum(distance(x))

    gradient, second = jax.jvp(jax.grad(total), (pair,), (along,))
    return distance(pair), gradient, jax.jvp(distance, (pair,), (along,))[1], second


ALONG = np.random.default_rng(8).standard_normal(PAIRS.shape)


@pytest.fixture(scope="module")
def found() -> tuple[np.ndarray, ...]:
    return tuple(np.asarray(x) for x in exact(PAIRS, ALONG))


@pytest.mark.parametrize("kind", KINDS)
def test_distance(found, kind):
    error = np.abs(found[0] - norm(GAP)) / SIZE
    assert error[of(kind)].max() < 1e-10


def test_closest_points_are_on_the_segments_and_give_the_distance():
    s, t = (np.asarray(x) for x in jax.jit(closest)(PAIRS))
    assert np.min(s) >= 0
    assert np.max(s) <= 1
    assert np.min(t) >= 0
    assert np.max(t) <= 1
    apart = norm(np.asarray(between(*(jnp.asarray(x) for x in (PAIRS, s, t)))))
    assert np.max(np.abs(apart - norm(GAP)) / SIZE) < 1e-10
    good = UNIQUE & (ANGLE > 0.1) & (np.minimum(*LENGTHS) > 0.01)
    assert np.abs(s - S)[good].max() < 1e-10
    assert np.abs(t - T)[good].max() < 1e-10


def test_gradient_of_the_distance(found):
    expected = envelope(PAIRS)[UNIQUE].reshape(-1, 4, 3)
    assert UNIQUE.sum() > 0.5 * N
    assert np.abs(found[1][UNIQUE] - expected).max() < 1e-10
    slope = np.sum(expected * ALONG[UNIQUE], axis=(1, 2))
    assert np.abs(found[2][UNIQUE] - slope).max() < 1e-10


def test_second_derivative_of_the_distance(found):
    """Against differences of the reference, where the same sides of the square stay active."""
    h = 1e-5
    chosen = UNIQUE & (ANGLE > 0.1) & of("random", "passing", "end to end", "another point")
    sides = [np.sign(w) - np.sign(1 - w) for w in (S, T)]
    shifted = {k: PAIRS.astype(LONG) + LONG(k * h) * ALONG for k in (-2, -1, 1, 2)}
    for x in (shifted[-2], shifted[2]):
        s, t, _ = reference(x)
        for before, now in zip(sides, (s, t), strict=True):
            chosen &= before == np.sign(now) - np.sign(1 - now)
    assert chosen.sum() > 0.3 * N
    value = {k: envelope(x[chosen]) for k, x in shifted.items()}
    expected = (8 * (value[1] - value[-1]) - (value[2] - value[-2])) / (12 * h)
    error = np.abs(found[3][chosen].reshape(-1, 12) - expected).max(axis=1)
    assert (error / (1 + np.abs(expected).max(axis=1) ** 2)).max() < 1e-8


def test_derivatives_of_the_distance_are_always_finite(found):
    """At crossing, touching, parallel and degenerate segments too, in both modes."""
    for derivative in found:
        assert np.isfinite(derivative).all()
    assert np.abs(found[1]).max() < 1.01  # never more than the vertices move


# The softened distance ------------------------------------------------------------------------

near_all = jax.jit(jax.vmap(near, in_axes=(0, None)))


def squared(pair, softness=SOFTNESS):
    return near(pair, jnp.asarray(softness)).squared


@pytest.fixture(scope="module")
def soft() -> Near:
    return jax.tree.map(np.asarray, near_all(PAIRS, SOFTNESS))


def slope_of_barrier(a: np.ndarray) -> np.ndarray:
    return (2 * a - 1) / np.sqrt(a * (1 - a))


def test_softened_distance_exceeds_the_exact_one_by_a_bounded_amount(soft):
    excess = soft.squared - norm(GAP) ** 2
    rounding = 1e-14 * SIZE**2
    assert np.all(excess >= -rounding)
    assert np.all(excess <= 2 * SOFTNESS**2 + rounding)
    assert excess[of("random")].max() > 0.5 * SOFTNESS**2


def test_near_points_are_stationary(soft):
    """One more Newton step, in extended precision, does not move them."""
    pair = PAIRS.astype(LONG)
    s, t = soft.s.astype(LONG), soft.t.astype(LONG)
    assert np.all((s > 0) & (s < 1) & (t > 0) & (t < 1))
    u, v = pair[:, 1] - pair[:, 0], pair[:, 3] - pair[:, 2]
    gap = pair[:, 0] + s[:, None] * u - pair[:, 2] - t[:, None] * v
    weight = LONG(SOFTNESS) ** 2 / 2
    g0 = np.sum(gap * u, axis=1) + weight * slope_of_barrier(s)
    g1 = np.sum(gap * -v, axis=1) + weight * slope_of_barrier(t)
    h00, h11 = (
        np.sum(edge * edge, axis=1) + weight / 2 * (place * (1 - place)) ** LONG(-1.5)
        for edge, place in ((u, s), (v, t))
    )
    h01 = -np.sum(u * v, axis=1)
    determinant = h00 * h11 - h01**2
    assert np.max(np.abs(h11 * g0 - h01 * g1) / determinant) < 1e-11
    assert np.max(np.abs(h00 * g1 - h01 * g0) / determinant) < 1e-11


def test_softened_distance_tends_to_the_exact_one():
    """By the squared softness: at crossing segments, where nothing else can be left, too."""
    for kind in ("random", "crossing", "parallel", "end to end"):
        chosen = of(kind)
        exact = norm(GAP[chosen]) ** 2
        for softness in (1e-1, 1e-3, 1e-5):
            excess = np.asarray(near_all(PAIRS, softness).squared)[chosen] - exact
            assert np.abs(excess).max() <= 2 * softness**2 + 1e-13
            assert excess.max() > 0.1 * softness**2


def test_softened_distance_does_not_depend_on_labels(soft):
    """Which segment is the first, and where each of them starts."""
    swapped = near_all(PAIRS[:, [2, 3, 0, 1]], SOFTNESS)
    np.testing.assert_allclose(swapped.squared, soft.squared, rtol=1e-12, atol=1e-16)
    reversed_one = near_all(PAIRS[:, [1, 0, 2, 3]], SOFTNESS)
    scale = 1e-14 * SIZE**2
    assert np.all(np.abs(reversed_one.squared - soft.squared) <= scale + 1e-13 * soft.squared)
    usual = of("random", "passing", "parallel", "crossing", "collinear", "end to end")
    assert np.abs(np.asarray(swapped.s) - soft.t)[usual].max() < 1e-9
    assert np.abs(np.asarray(reversed_one.s) - (1 - soft.s))[usual].max() < 1e-9


def test_softened_distance_is_that_of_the_moved_pair(soft, rng):
    turn = np.asarray(rotation(rng.standard_normal(3), 1.3))
    moved = near_all(PAIRS @ turn.T + rng.standard_normal(3), SOFTNESS)
    np.testing.assert_array_less(np.abs(moved.squared - soft.squared), 1e-13 * (1 + SIZE**2))
    usual = of("random", "passing", "parallel", "crossing", "collinear", "end to end")
    turned = np.asarray(moved.gap)[usual] - soft.gap[usual] @ turn.T
    assert np.abs(turned).max() < 1e-9


@jax.jit
@partial(jax.vmap, in_axes=(0, 0))
def expansion(pair, along):
    """Derivatives of order 1, 2 and 3 of the softened square in one direction, by forward mode,
    the first two also by reverse mode, and that of the near points.
    """

    def line(x):
        return near(pair + x * along, jnp.asarray(SOFTNESS))

    first = jax.jacfwd(lambda x: line(x).squared)
    second = jax.jacfwd(first)
    reverse = jax.grad(squared)
    gradient, bend = jax.jvp(reverse, (pair,), (along,))
    points = jax.jacfwd(lambda x: jnp.stack(line(x)[2:]))(0.0)
    forward = jnp.stack([first(0.0), second(0.0), jax.jacfwd(second)(0.0)])
    return forward, jnp.stack([jnp.sum(gradient * along), jnp.sum(bend * along)]), points, gradient


@pytest.fixture(scope="module")
def expanded() -> tuple[np.ndarray, ...]:
    return tuple(np.asarray(x) for x in expansion(PAIRS, ALONG))


def test_derivatives_of_the_softened_distance_are_finite(expanded):
    for derivative in expanded:
        assert np.isfinite(derivative).all()


def test_modes_of_differentiation_agree(expanded):
    forward, reverse, _, _ = expanded
    scale = np.abs(forward[:, :2]).max(axis=1, keepdims=True) + SIZE[:, None] ** 2
    assert np.max(np.abs(forward[:, :2] - reverse) / scale) < 1e-10


def test_gradient_of_the_softened_square_is_that_of_an_envelope(soft, expanded):
    weights = np.stack([1 - soft.s, soft.s, soft.t - 1, -soft.t], axis=1)
    expected = 2 * weights[:, :, None] * soft.gap[:, None, :]
    assert np.max(np.abs(expanded[3] - expected) / (1 + SIZE)[:, None, None] ** 2) < 1e-10


def test_near_points_move_as_their_derivative_says(expanded):
    chosen = of("random", "crossing", "passing", "parallel", "antiparallel", "collinear")

    def points(x):
        return jnp.stack(near_all(x, SOFTNESS)[2:], axis=1)

    expected = finite_difference_jvp(points, PAIRS, ALONG, 3e-7)
    scale = 1 + np.abs(expanded[2]) ** 3  # of the truncation: the points of parallel ones are fast
    error = np.abs(expanded[2] - expected) / scale
    assert error[chosen].max() < 1e-5
    assert np.abs(expected[of("parallel")]).max() > 3


KINKS = {
    # a segment turned through being parallel to another
    "parallel": (
        [[0, 0, 0], [1, 0, 0], [0.1, 0.0, 0.2], [1.1, 0.0, 0.2]],
        [[0, 0, 0], [0, 0, 0], [0, 1, 0], [0, -1, 0]],
    ),
    # tilted: the near points jump from one end to the other
    "tilted": (
        [[0, 0, 0], [1, 0, 0], [0.0, 0.0, 0.2], [1.0, 0.0, 0.2]],
        [[0, 0, 0], [0, 0, 0], [0, 0, 1], [0, 0, -1]],
    ),
    # a segment that passes the end of another
    "end": (
        [[0, 0, 0], [1, 0, 0], [1.0, -0.5, 0.2], [1.0, 0.5, 0.2]],
        [[0, 0, 0], [0, 0, 0], [1, 0, 0], [1, 0, 0]],
    ),
    # two collinear segments that begin to overlap
    "collinear": (
        [[0, 0, 0], [1, 0, 0], [1.0, 0.0, 0.02], [2.0, 0.0, 0.02]],
        [[0, 0, 0], [0, 0, 0], [1, 0, 0], [1, 0, 0]],
    ),
    # two segments that pass through each other
    "crossing": (
        [[0, 0, 0], [1, 0, 0], [0.5, -0.5, 0.0], [0.5, 0.5, 0.0]],
        [[0, 0, 0], [0, 0, 0], [0, 0, 1], [0, 0, 1]],
    ),
}


@pytest.mark.parametrize("kink", KINKS)
def test_softened_distance_is_smooth_where_the_exact_one_is_not(kink):
    """Every derivative is the integral of the next: no jump is left out between samples."""
    pair, along = (np.array(x, float) for x in KINKS[kink])
    # far finer than the softness around the kink itself
    x = np.concatenate([-np.geomspace(1e-7, 0.05, 2000)[::-1], [0], np.geomspace(1e-7, 0.05, 2000)])
    moved = pair + x[:, None, None] * along
    fill = np.resize(np.arange(len(x)), N)  # the shape of the program that there is already
    forward = np.asarray(expansion(moved[fill], np.broadcast_to(along, (N, 4, 3)))[0])[: len(x)]
    values = np.asarray(near_all(moved[fill], SOFTNESS).squared)[: len(x), None]
    derivatives = np.concatenate([values, forward], axis=1)
    step = np.diff(x)[:, None]
    change = np.diff(derivatives[:, :3], axis=0)
    mean = 0.5 * (derivatives[1:, 1:] + derivatives[:-1, 1:])
    size = np.abs(derivatives).max(axis=0)
    assert np.all(np.abs(change - step * mean) < 2e-3 * step * size[1:] + 1e-11 * (1 + size[:3]))
