"""Regularized Stokeslet segments: the kernels, and the drag of bodies with known drag."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import finite_difference_jvp
from scipy.integrate import quad_vec

from benchmarks import rodenborn
from benchmarks.rigid import (
    propulsion,
    rigid_resistance,
    stokeslet_resistance,
)
from derjax.shapes import helix
from derjax.terms.fluid.kernels import moments, segment_kernels
from derjax.terms.fluid.stokeslets import flow, mobility, pull

# A segment of length L from START to END, in a general direction.
START = np.array([0.2, -0.1, 0.3])
DIRECTION = np.array([2.0, -1.0, 2.0]) / 3.0
LENGTH = 0.8
END = START + LENGTH * DIRECTION
NORMAL = np.array([1.0, 2.0, 0.0]) / np.sqrt(5.0)


def beside(along: float, across: float) -> np.ndarray:
    """The point at `along` and `across` segment lengths from the start of the segment."""
    return START + LENGTH * (along * DIRECTION + across * NORMAL)


TARGETS = {
    "start": beside(0, 0),
    "end": beside(1, 0),
    "middle": beside(0.5, 0),
    "on it": beside(0.83, 0),
    "in line behind": beside(-0.6, 0),
    "in line ahead": beside(1.9, 0),
    "in line, one neighbour on": beside(2, 0),
    "close": beside(0.3, 0.01),
    "general": beside(1.4, -0.7),
    "far in line": beside(100, 0),
    "far across": beside(0.5, 100),
    "far": beside(-60, 80),
}
RATIOS = (1e-3, 0.03, 0.3, 1.0)  # eps / L


@jax.jit
def kernels(target, regularization):
    m1, m2 = segment_kernels(target[None], START[None], END[None], regularization)
    return jnp.array(m1)[:, :, 0, 0], jnp.array(m2)[:, :, 0, 0]


def quadrature(integrand, target: np.ndarray, epsilon: float) -> np.ndarray:
    """Integral over the segment, a from 0 to 1, told where the integrand is steep."""
    nearest = float(np.clip((target - START) @ DIRECTION / LENGTH, 0, 1))
    width = np.hypot(epsilon, np.linalg.norm(target - START - nearest * (END - START))) / LENGTH
    steps = width * np.geomspace(0.3, 1e4, 40)
    marks = np.concatenate([[nearest], nearest - steps, nearest + steps])
    marks = marks[(marks > 0) & (marks < 1)]
    return quad_vec(integrand, 0, 1, epsabs=0, epsrel=1e-13, points=marks, norm="max")[0]


def regularized_stokeslet(x: np.ndarray, epsilon: float) -> np.ndarray:
    """8 pi mu times the velocity at x due to unit forces at 0 (Cortez 2005, eq. 11)."""
    r2 = x @ x
    return ((r2 + 2 * epsilon**2) * np.eye(3) + np.outer(x, x)) / (r2 + epsilon**2) ** 1.5


@pytest.mark.parametrize("ratio", RATIOS)
@pytest.mark.parametrize("target", TARGETS.values(), ids=TARGETS)
def test_kernels_are_integrals_of_the_regularized_stokeslet(target, ratio):
    epsilon = ratio * LENGTH

    def integrand(a):
        flow = regularized_stokeslet(target - START - a * (END - START), epsilon)
        return np.stack([(1 - a) * flow, a * flow])

    exact = quadrature(integrand, target, epsilon)
    # moments are about the start; seen from the end, terms of size (L / eps)^2 cancel
    tolerance = 1e-11 + np.finfo(float).eps / ratio**2
    for kernel, reference in zip(kernels(jnp.asarray(target), epsilon), exact, strict=True):
        size = np.abs(reference).max()
        np.testing.assert_allclose(kernel, reference, atol=tolerance * size, rtol=0)


@pytest.mark.parametrize("ratio", RATIOS)
@pytest.mark.parametrize("name", ["end", "middle", "in line ahead", "close", "general"])
def test_moments_are_those_of_quadrature(name, ratio):
    target, epsilon = TARGETS[name], ratio * LENGTH
    x0, v = target - START, START - END
    powers = {"t01": (0, 1), "t03": (0, 3), "t11": (1, 1), "t13": (1, 3), "t23": (2, 3)}
    powers["t33"] = (3, 3)

    def integrand(a):
        r = np.sqrt(np.sum((x0 + a * v) ** 2) + epsilon**2)
        return np.array([a**m * r**-q for m, q in powers.values()])

    exact = dict(zip(powers, quadrature(integrand, target, epsilon), strict=True))
    ends = [jnp.sqrt(np.sum((x0 + a * v) ** 2) + epsilon**2) for a in (0, 1)]
    found = moments(*ends, jnp.asarray(v @ v), jnp.asarray(x0 @ v))
    for m in powers:
        assert getattr(found, m) == pytest.approx(exact[m], rel=1e-9), m


@pytest.mark.parametrize("ratio", RATIOS)
def test_kernels_have_finite_and_exact_derivatives_wherever_the_target_is(ratio):
    """With respect to the target, the ends of the segment, and the regularization."""
    epsilon = ratio * LENGTH

    def both(target, start, end, regularization):
        return jnp.array(segment_kernels(target[None], start[None], end[None], regularization))

    @jax.jit
    def directional(at, along):
        exact = jax.jvp(both, at, along)[1]
        step = 1e-3 * at[3]
        differences = finite_difference_jvp(lambda p: both(*p), at, along, step)
        return exact, differences

    rng = np.random.default_rng(1)
    for name, target in TARGETS.items():
        # displacements of the order of eps, so that nothing changes more than the kernel allows
        along = tuple(jnp.asarray(d) for d in rng.uniform(-1, 1, (3, 3)))
        at = (jnp.asarray(target), jnp.asarray(START), jnp.asarray(END), jnp.asarray(epsilon))
        exact, differences = directional(at, (*along, jnp.asarray(0.5)))
        assert jnp.isfinite(exact).all(), name
        size = float(jnp.abs(exact).max())
        rounding = 1e-10 * float(jnp.abs(both(*at)).max()) / (1e-3 * epsilon)
        np.testing.assert_allclose(exact, differences, atol=1e-8 * size + rounding, err_msg=name)


def test_flow_far_away_is_that_of_a_point_force():
    """A fixed force spread over the segment looks like a Stokeslet, whatever its spread."""
    target = TARGETS["far"] - 0.5 * (START + END)
    stokeslet = (np.eye(3) + np.outer(target, target) / (target @ target)) / np.linalg.norm(target)
    m1, m2 = kernels(jnp.asarray(TARGETS["far"]), 0.1 * LENGTH)
    # the first correction is that of the quadrupole, of relative size (L / r)^2
    np.testing.assert_allclose(m1 + m2, stokeslet, atol=2e-4 * np.abs(stokeslet).max())


@pytest.mark.parametrize("end_nodes", ["half", "full"])
def test_products_with_the_mobility_are_those_of_the_matrix(rng, end_nodes):
    """Of the matrix and of its transpose, for two filaments of different lengths."""
    filaments = tuple(jnp.asarray(rng.normal(size=(n, 3))) for n in (4, 6))
    vector = jnp.asarray(rng.normal(size=(10, 3)))
    fluid = jnp.asarray(2.0), jnp.asarray(0.1), end_nodes
    matrix = mobility(filaments, *fluid)
    forth, back = (function(filaments, vector, *fluid) for function in (flow, pull))
    np.testing.assert_allclose(forth.ravel(), matrix @ vector.ravel(), rtol=1e-11, atol=1e-12)
    np.testing.assert_allclose(back.ravel(), matrix.T @ vector.ravel(), rtol=1e-11, atol=1e-12)


def test_mobility_takes_forces_to_velocities_by_superposition(rng):
    """Against a sum over segments of quadratures, for both meanings of a nodal force."""
    epsilon, viscosity = 0.05, 3.0
    nodes = np.cumsum(rng.uniform(0.2, 0.5, (4, 3)), axis=0)
    forces = rng.standard_normal((4, 3))
    length = np.linalg.norm(np.diff(nodes, axis=0), axis=1)
    stands_for = 0.5 * (np.append(length, 0) + np.append(0, length))

    def flow(density, weight):
        velocity = np.zeros((4, 3))
        for i, target in enumerate(nodes):
            for k in range(3):

                def integrand(a, k=k, target=target):
                    x = target - (1 - a) * nodes[k] - a * nodes[k + 1]
                    blend = (1 - a) * density[k] + a * density[k + 1]
                    return regularized_stokeslet(x, epsilon) @ blend

                marks = np.linspace(0.02, 0.98, 25)
                velocity[i] += weight[k] * quad_vec(integrand, 0, 1, epsrel=1e-12, points=marks)[0]
        return velocity / (8 * np.pi * viscosity)

    half = mobility((jnp.asarray(nodes),), viscosity, epsilon, "half") @ forces.ravel()
    expected = flow(forces / stands_for[:, None], length)
    np.testing.assert_allclose(half.reshape(4, 3), expected, rtol=1e-9)
    full = mobility((jnp.asarray(nodes),), viscosity, epsilon, "full") @ forces.ravel()
    np.testing.assert_allclose(full.reshape(4, 3), flow(forces, np.ones(3)), rtol=1e-9)


# Straight rods ------------------------------------------------------------------------------

ASPECT = 50.0  # length / diameter
RADIUS = 0.5 / ASPECT  # of a rod of unit length
BLOB = {"sqrt(e)": np.sqrt(np.e), "1.02": 1.02, "0.104": 0.104}  # eps / radius


@partial(jax.jit, static_argnames=("n_edges", "end_nodes", "drag_matrix"))
def rod_drag(ratio, n_edges, end_nodes="half", drag_matrix="symmetric"):
    """Drag along and across, and resistance to turning end over end, of a rod of unit length."""
    nodes = jnp.zeros((n_edges + 1, 3)).at[:, 0].set(jnp.linspace(-0.5, 0.5, n_edges + 1))
    matrix = stokeslet_resistance(nodes, 1.0, ratio * RADIUS, end_nodes, drag_matrix)
    total = rigid_resistance(nodes, matrix)
    return total[0, 0], total[1, 1], total[5, 5]


def cylinder() -> tuple[float, float, float]:
    """The same for a cylinder with flat ends: Tirado & Garcia de la Torre 1979, 1980."""
    p, log = ASPECT, np.log(ASPECT)
    return (
        2 * np.pi / (log - 0.207 + 0.980 / p - 0.133 / p**2),
        4 * np.pi / (log + 0.839 + 0.185 / p + 0.233 / p**2),
        np.pi / 3 / (log - 0.662 + 0.917 / p - 0.050 / p**2),
    )


def spheroid() -> tuple[float, float]:
    """Drag along and across of a prolate spheroid inscribed in that cylinder (Oberbeck)."""
    a, e = 0.5, np.sqrt(1 - (2 * RADIUS) ** 2)
    log = np.log((1 + e) / (1 - e))
    along = 16 * np.pi * a * e**3 / ((1 + e**2) * log - 2 * e)
    across = 32 * np.pi * a * e**3 / (2 * e + (3 * e**2 - 1) * log)
    return along, across


def test_closed_forms_of_the_references():
    """The formulas above, against tabulated values of the same solutions."""
    assert cylinder()[:2] == pytest.approx((1.6870, 2.6429), abs=1e-4)
    assert spheroid() == pytest.approx((1.5300, 2.4615), abs=1e-4)
    per_sphere = np.array(spheroid()) / (6 * np.pi * RADIUS)
    assert per_sphere == pytest.approx((8.116792, 13.058402), abs=1e-6)


# Ratio of the drag (along, across) to that of the cylinder, computed independently.
TABULATED = {
    ("0.104", 10): (0.610, 0.678),
    ("0.104", 20): (0.590, 0.654),
    ("0.104", 40): (0.581, 0.643),
    ("1.02", 10): (0.928, 0.964),
    ("1.02", 20): (0.905, 0.936),
    ("1.02", 40): (0.896, 0.924),
    ("sqrt(e)", 10): (1.043, 1.059),
    ("sqrt(e)", 20): (1.021, 1.031),
    ("sqrt(e)", 40): (1.015, 1.020),
}


@pytest.mark.parametrize(("blob", "n_edges"), TABULATED, ids=lambda v: str(v))
def test_drag_of_a_rod_as_computed_independently(blob, n_edges):
    along, across, _ = rod_drag(BLOB[blob], n_edges)
    reference = cylinder()
    found = (along / reference[0], across / reference[1])
    assert found == pytest.approx(TABULATED[blob, n_edges], abs=6e-4)  # half its last digit


def test_blob_of_sqrt_e_radii_has_the_drag_of_a_cylinder():
    """As matched asymptotics has it, in both directions and for turning end over end."""
    along, across, turning = rod_drag(BLOB["sqrt(e)"], 40)
    reference = cylinder()
    assert along / reference[0] == pytest.approx(1.0, abs=0.02)
    assert across / reference[1] == pytest.approx(1.0, abs=0.025)
    assert turning / reference[2] == pytest.approx(1.0, abs=0.035)


def test_blob_of_the_radius_has_the_drag_of_the_inscribed_spheroid():
    along, across, _ = rod_drag(BLOB["1.02"], 40)
    reference = spheroid()
    assert along / reference[0] == pytest.approx(1.0, abs=0.015)
    assert across / reference[1] == pytest.approx(1.0, abs=0.015)


def test_full_weight_at_the_ends_adds_the_documented_drag():
    """14 to 17 % on a straight rod of 21 nodes, and less the more nodes there are."""
    half, full = (np.array(rod_drag(BLOB["1.02"], 20, w)[:2]) for w in ("half", "full"))
    along, across = full / half
    assert along == pytest.approx(1.17, abs=0.005)
    assert across == pytest.approx(1.144, abs=0.005)
    finer = np.array(rod_drag(BLOB["1.02"], 40, "full")) / np.array(rod_drag(BLOB["1.02"], 40))
    assert (finer[:2] > 1.0).all()
    assert (finer[:2] < full / half).all()


def test_drag_of_a_rod_does_not_depend_on_how_the_mobility_is_made_symmetric():
    """For a straight, evenly divided rod only its ends spoil the symmetry."""
    plain = rod_drag(BLOB["1.02"], 20, drag_matrix="collocation")
    np.testing.assert_allclose(rod_drag(BLOB["1.02"], 20), plain, rtol=1e-12)
    triangle = rod_drag(BLOB["1.02"], 20, drag_matrix="lower_triangle")
    assert 1e-3 < np.abs(np.array(triangle) / np.array(plain) - 1).max() < 0.2


# Helices ------------------------------------------------------------------------------------

# Thrust, torque and drag of the helices of Rodenborn et al. (2013) by an independent
# implementation with segments of 1 mm; RFT by integrating its closed form over the contour.
INDEPENDENT = {
    "RSS, eps = 1.649 a": [
        (6.03, 132.4, 52.4),
        (9.21, 97.8, 46.5),
        (10.43, 76.4, 38.6),
        (9.23, 68.0, 33.8),
        (6.97, 61.4, 30.2),
    ],
    "RSS, eps = 1.02 a": [
        (6.16, 114.9, 50.5),
        (9.07, 84.8, 44.2),
        (10.06, 67.0, 36.1),
        (8.81, 60.3, 31.2),
        (6.62, 55.0, 27.7),
    ],
    "RSS, eps = 0.104 a": [
        (6.05, 70.7, 43.4),
        (8.02, 52.3, 36.0),
        (8.29, 42.5, 27.5),
        (7.06, 39.4, 22.9),
        (5.21, 37.0, 19.8),
    ],
    "RFT, Gray-Hancock": [
        (18.9, 110, 157),
        (16.3, 69.8, 88.1),
        (12.2, 50.0, 49.1),
        (9.07, 43.5, 35.2),
        (6.09, 39.5, 27.2),
    ],
    "RFT, Lighthill": [
        (29.4, 142, 215),
        (26.4, 100, 130),
        (20.3, 76.5, 75.0),
        (15.0, 67.3, 53.5),
        (9.88, 60.4, 40.5),
    ],
}


def helices(name: str) -> np.ndarray:
    """(5, 3): computed thrust, torque and drag at the measured pitches."""
    rows = rodenborn.sweep(rodenborn.experiment().pitch_over_radius.to_numpy(), [name])
    return rows[list(rodenborn.QUANTITIES)].to_numpy()


@pytest.mark.parametrize("name", INDEPENDENT)
def test_helices_as_computed_independently(name):
    # 2.5 mm segments where the other had 1 mm, and three digits: at most 1 %
    np.testing.assert_allclose(helices(name), INDEPENDENT[name], rtol=0.01)


def test_helices_have_the_thrust_torque_and_drag_of_the_experiment():
    """Within 12 % at eps = sqrt(e) a, without any adjustment; 5 % in the mean."""
    measured = rodenborn.experiment()[list(rodenborn.QUANTITIES)].to_numpy()
    deviation = helices("RSS, eps = 1.649 a") / measured - 1
    assert np.abs(deviation).max() < 0.12
    assert np.abs(deviation).mean() < 0.06


@pytest.mark.parametrize("drag_matrix", ["symmetric", "collocation"])
def test_symmetrising_does_not_change_what_helices_do(drag_matrix):
    nodes = helix(1.0, 6.509, rodenborn.AXIAL_LENGTH, 100, "left")

    @jax.jit
    def resistance(epsilon):
        matrix = stokeslet_resistance(nodes, 1.0, epsilon, "half", drag_matrix)
        return rigid_resistance(nodes, matrix)

    found = propulsion(resistance(BLOB["sqrt(e)"] * rodenborn.ROD_RADIUS))
    expected = dict(zip(rodenborn.QUANTITIES, (10.43, 76.4, 38.6), strict=True))
    assert found == pytest.approx(expected, rel=0.02)


def test_resistive_theory_is_the_integral_of_its_closed_form():
    """Thrust, torque and drag of an ideal helix with given coefficients, to 2nd order."""
    pitch, parallel, normal, length = 5.0, 2.0, 3.3, rodenborn.AXIAL_LENGTH
    sine, cosine = np.array([2 * np.pi, pitch]) / np.hypot(2 * np.pi, pitch)
    exact = {
        "thrust": (normal - parallel) * sine * length,
        "torque": (normal * cosine**2 + parallel * sine**2) * length / cosine,
        "drag": (normal * sine**2 + parallel * cosine**2) * length / cosine,
    }

    def law(*_):
        return parallel, normal

    errors = []
    for n_edges in (80, 160):
        found = propulsion(rodenborn.resistive(pitch, law, n_edges))
        errors.append([abs(found[k] / exact[k] - 1) for k in exact])
    coarse, fine = np.array(errors)
    assert fine.max() < 0.01
    np.testing.assert_allclose(np.log2(coarse / fine), 2.0, atol=0.3)


def test_a_mirrored_helix_pushes_the_other_way():
    @partial(jax.jit, static_argnums=0)
    def resistance(handedness):
        nodes = helix(1.0, 5.0, 10.0, 40, handedness)
        return rigid_resistance(nodes, stokeslet_resistance(nodes, 1.0, 0.1))

    left, right = np.array(resistance("left")), np.array(resistance("right"))
    mirror = np.diag([1, 1, -1, -1, -1, 1])  # of velocities and of rates of rotation, in z
    np.testing.assert_allclose(right, mirror @ left @ mirror, atol=1e-10 * left.max())
    # a right-handed screw that turns about +x advances to +x: the drag, which is minus this
    # matrix times the motion, pushes it there
    assert right[0, 3] == pytest.approx(-6.2066, rel=1e-3)


@pytest.mark.parametrize("drag_matrix", ["symmetric", "collocation"])
def test_resistance_of_a_helix_has_exact_derivatives(drag_matrix):
    def thrust(pitch):
        nodes = helix(1.0, pitch, 8.0, 24, "left")
        resistance = stokeslet_resistance(nodes, 1.0, 0.1, drag_matrix=drag_matrix)
        return rigid_resistance(nodes, resistance)[0, 3]

    slope = jax.jit(jax.grad(thrust))(4.0)
    seen = (thrust(4.0 + 1e-4) - thrust(4.0 - 1e-4)) / 2e-4
    assert float(slope) == pytest.approx(float(seen), rel=1e-6)
