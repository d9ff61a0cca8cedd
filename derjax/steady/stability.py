"""Whether a steady state is stable: growth rates, modes, and where they change sign.

A small displacement xi of the turning shape obeys M d2xi/dt2 + D dxi/dt + J xi = 0, with J the
derivative of the imbalance of forces by the shape, that of the rigid motion included, D that by the
rates, Coriolis' force included, and M that by the accelerations. So exp(lambda t) needs
(lambda^2 M + lambda D + J) xi = 0, an eigenproblem. In a scene without inertia M is zero, and there
are half as many modes. Most angles have no drag: they follow the others at once, and are eliminated
before. (So that they do, their moments of inertia, which are tiny, are left out.) Rigid motions of
the shape have the eigenvalues 0 and, as seen from the turning shape, +-i |Omega|.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Complex, Float

from ..core.derivatives import jacobian
from ..core.pytree import pytree, replace
from ..core.status import SolverError
from ..integrate.step import Scene
from .equilibrium import equilibrium
from .motion import imbalance, rates, rotating_acceleration
from .solve import Steady, steady, steady_as

INFINITE = 1e12
"""Eigenvalues (1/s) that are larger are those of motions without drag: over the rate of the motor,
or over the slowest of all where nothing turns."""

FIRST_STEP, LONGEST_STEP = 0.02, 0.3
"""Of the search for a threshold, over the value itself."""

RIGID = 1e-5
"""How far from those of rigid motions, over the rate of rotation, their eigenvalues may be."""


@pytree
class Linearisation:
    """What a steady state's shape resists small changes with, on the free degrees of freedom.

    Attributes:
        stiffness: (f, f) J, N/m and so on.
        drag: (f, f) D, N s/m and so on.
        mass: (f, f) M, kg.
    """

    stiffness: Float[Array, "f f"]
    drag: Float[Array, "f f"]
    mass: Float[Array, "f f"]


@dataclass(frozen=True)
class Stability:
    """How small displacements of a steady state grow.

    Attributes:
        state: the steady state.
        eigenvalues: (m,) 1/s, of all modes but rigid motions, the fastest growing first; those in
            the upper half of the complex plane.
        modes: (m, d) displacements (m, rad) of all degrees of freedom, in the turning frame.
        left: (m, d) the left eigenvectors, which derivatives of eigenvalues need.
        rigid_error: largest error of the eigenvalues of rigid motions, over the rate of rotation.
    """

    state: Steady
    eigenvalues: Complex[np.ndarray, " m"]
    modes: Complex[np.ndarray, "m d"]
    left: Complex[np.ndarray, "m d"]
    rigid_error: float

    def mode(self, number: int = 0) -> "Mode":
        """One of the modes, for derivatives of its eigenvalue."""
        parts = self.eigenvalues[number], self.modes[number], self.left[number]
        return Mode(self.state, *(jnp.asarray(part) for part in parts))

    @property
    def growth_rate(self) -> float:
        """1/s, of the mode that grows fastest, or decays slowest."""
        return float(self.eigenvalues[0].real)

    @property
    def frequency(self) -> float:
        """1/s, of that mode as seen from the turning shape."""
        return float(self.eigenvalues[0].imag) / (2 * np.pi)

    @property
    def laboratory_frequency(self) -> float:
        """1/s, of that mode in the laboratory, where the shape turns beneath it."""
        turning = float(jnp.linalg.norm(self.state.motion.rotation))
        return (float(self.eigenvalues[0].imag) - turning) / (2 * np.pi)

    @property
    def is_stable(self) -> bool:
        """Whether every mode decays."""
        return self.growth_rate < 0.0


def _imbalance_by(state: Steady, q: Array, rate: Array, acceleration: Array) -> Array:
    """The imbalance at a shape that moves as the steady one does, and besides.

    Args:
        state: the steady one.
        q: (d,) the shape.
        rate: (d,) m/s and rad/s, at which it changes in the turning frame.
        acceleration: (d,) m/s^2 and rad/s^2, likewise.
    """
    # Carried from the state itself, frames do not turn to first order, and the rate of an angle is
    # the physical spin of its edge. Carried from elsewhere they would.
    scene = replace(state.scene, initial=state.state)
    velocity = rates(scene, state.symmetry, q, state.motion, state.motor_rate)
    turning = rotating_acceleration(scene, state.motion, velocity)
    coriolis = 2.0 * rotating_acceleration(scene, state.motion, rate)
    n = 3 * scene.rod.topology.n_nodes
    of_nodes = jnp.where(np.arange(q.size) < n, acceleration, 0.0)
    return imbalance(scene, q, velocity + rate, turning + coriolis + of_nodes)


@jax.jit
def linearisation(state: Steady) -> Linearisation:
    """The matrices of small displacements from a steady state."""
    q, still = state.state.q, jnp.zeros_like(state.state.q)
    free = state.scene.rod.topology.free_dofs
    by_shape = jacobian(lambda x: _imbalance_by(state, x, still, still), q)
    by_rate = jacobian(lambda v: _imbalance_by(state, q, v, still), still)
    by_acceleration = jacobian(lambda a: _imbalance_by(state, q, still, a), still)
    every = (by_shape, by_rate, by_acceleration)
    return Linearisation(*(matrix[free][:, free] for matrix in every))


def stability(state: Steady) -> Stability:
    """The modes of a steady state, on the host.

    Raises:
        SolverError: the state is not one, or its rigid motions are not found among the modes.
    """
    state.raise_if_failed()
    topology = state.scene.rod.topology
    scale = np.broadcast_to(state.scene.newton.force_scale, (topology.n_dofs,))
    unit = scale[topology.free_dofs]
    matrices = linearisation(state)
    stiffness, drag, mass = (
        np.asarray(matrix) / unit[:, None]
        for matrix in (matrices.stiffness, matrices.drag, matrices.mass)
    )
    moving = np.any(drag, axis=0) | np.any(drag, axis=1) | np.any(mass, axis=1)
    follow, among = _Followers(stiffness, moving), np.ix_(moving, moving)
    turning = float(jnp.linalg.norm(state.motion.rotation))
    pace = max(turning, abs(float(state.motor_rate)))
    alpha, beta, left, right = _modes(follow.condensed(), drag[among], mass[among], pace or 1.0)
    left, right = follow.left(left), follow.right(right)
    if pace == 0.0:  # nothing turns: the slowest mode says what is fast
        pace = np.min(np.abs(alpha[beta != 0.0] / beta[beta != 0.0]))
    finite = np.abs(alpha) < INFINITE * pace * np.abs(beta)
    values, left, right = alpha[finite] / beta[finite], left[:, finite], right[:, finite]
    keep, error = _without_rigid(values, state, turning)
    keep &= values.imag >= 0.0
    order = np.flatnonzero(keep)[np.argsort(-values[keep].real)]

    def whole(vectors: np.ndarray) -> np.ndarray:
        full = np.zeros((len(order), topology.n_dofs), complex)
        full[:, topology.free_dofs] = vectors[:, order].T
        return full

    # The left eigenvectors were those of rows in the solver's units.
    return Stability(state, values[order], whole(right), whole(left / unit[:, None]), error)


def _modes(
    stiffness: np.ndarray, drag: np.ndarray, mass: np.ndarray, pace: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Eigenvalues (1/s) as alpha / beta, and left and right eigenvectors in columns.

    Args:
        stiffness: (m, m) J.
        drag: (m, m) D.
        mass: (m, m) M.
        pace: 1/s, about as fast as motions are: what displacements change at counts over it.
    """
    import scipy.linalg  # here, for importing derjax to stay quick

    if not np.any(mass):
        a, b = -stiffness, drag
    else:
        one, none = np.eye(len(drag)), np.zeros_like(drag)
        a = np.block([[none, one], [-stiffness, -pace * drag]])
        b = np.block([[one, none], [none, pace**2 * mass]])
    found: Any = scipy.linalg.eig(a, b, True, True, homogeneous_eigvals=True)
    (alpha, beta), left, right = found
    if not np.any(mass):
        return alpha, beta, left, right
    # Displacements come first; forces that nothing does work on, the left eigenvectors, last.
    count = len(drag)
    return pace * alpha, beta, left[count:], right[:count]


class _Followers:
    """Degrees of freedom without drag: always where the others put them, in balance.

    Args:
        stiffness: (f, f) of all degrees of freedom.
        moving: (f,) which of them have drag.
    """

    def __init__(self, stiffness: np.ndarray, moving: np.ndarray) -> None:
        self.stiffness, self.moving = stiffness, moving
        at, others = np.flatnonzero(moving), np.flatnonzero(~moving)
        own = stiffness[np.ix_(others, others)]
        self.rows = np.linalg.solve(own, stiffness[np.ix_(others, at)])
        self.columns = np.linalg.solve(own.T, stiffness[np.ix_(at, others)].T)

    def condensed(self) -> np.ndarray:
        """The stiffness that those with drag feel."""
        at, others = np.flatnonzero(self.moving), np.flatnonzero(~self.moving)
        between = self.stiffness[np.ix_(at, others)]
        return self.stiffness[np.ix_(at, at)] - between @ self.rows

    def right(self, vectors: np.ndarray) -> np.ndarray:
        """Eigenvectors of all, from those of the ones with drag."""
        return self._whole(vectors, -self.rows @ vectors)

    def left(self, vectors: np.ndarray) -> np.ndarray:
        """The same for left eigenvectors."""
        return self._whole(vectors, -self.columns @ vectors)

    def _whole(self, vectors: np.ndarray, others: np.ndarray) -> np.ndarray:
        full = np.zeros((len(self.moving), vectors.shape[1]), vectors.dtype)
        full[self.moving], full[~self.moving] = vectors, others
        return full


def _without_rigid(values: np.ndarray, state: Steady, turning: float) -> tuple[np.ndarray, float]:
    """Which modes are no rigid motions, and the largest error of those that are."""
    symmetry, keep, worst = state.symmetry, np.ones(len(values), bool), 0.0
    if not symmetry.moves:
        return keep, worst
    around = [1j * turning, -1j * turning]
    expected = [0.0, 0.0, *around, *(around if len(symmetry.axes) == 3 else [])]
    for target in expected:
        distance = np.where(keep, np.abs(values - target), np.inf)
        found = int(np.argmin(distance))
        worst = max(worst, float(distance[found]) / turning)
        keep[found] = False
    # Pairs of equal eigenvalues with one direction of motion are found to the root of rounding.
    if worst > np.sqrt(RIGID):
        raise SolverError(
            f"the modes of rigid motion are off by {worst:.1e} of the rate of rotation: something "
            "acts on the robot that is not the same in all directions, or the state is not steady"
        )
    return keep, worst


@pytree
class Mode:
    """One mode of a steady state.

    Attributes:
        state: the steady state.
        eigenvalue: 1/s.
        right: (d,) displacement (m, rad) in the turning frame.
        left: (d,) the left eigenvector.
    """

    state: Steady
    eigenvalue: Complex[Array, ""]
    right: Complex[Array, " d"]
    left: Complex[Array, " d"]


def eigenvalue(scene: Scene, known: Mode) -> Array:
    """The eigenvalue (1/s, complex) of a mode, as a function of the numbers of the scene.

    Right at the scene for which the mode is known, and so is its first derivative: perturbation
    theory, `w (dJ + lambda dD + lambda^2 dM) xi / (w (D + 2 lambda M) xi)`, with the change of the
    steady state in it.

    Args:
        scene: with the same numbers as `known.state.scene`, which JAX may trace.
        known: the mode at these numbers.
    """
    value, xi, w = lax.stop_gradient((known.eigenvalue, known.right, known.left.conj()))
    state = steady_as(scene, known.state)
    q, still = state.state.q, jnp.zeros_like(state.state.q)

    def pushed(state: Steady, shape: Array, rate: Array, acceleration: Array) -> Array:
        """What a displacement that changes makes of the imbalance; complex."""

        def by(way: tuple[Array, Array, Array]) -> Array:
            return jax.jvp(lambda *at: _imbalance_by(state, *at), (q, still, still), way)[1]

        # One program for the real and the imaginary part: it is differentiated again, and takes
        # long to compile.
        parts = (jnp.stack([way.real, way.imag]) for way in (shape, rate, acceleration))
        real, imaginary = jax.vmap(lambda *ways: by(ways))(*parts)
        return real + 1j * imaginary

    left = w @ pushed(state, xi, value * xi, value**2 * xi)
    by_value = w @ pushed(lax.stop_gradient(state), 0.0 * xi, xi, 2.0 * value * xi)
    return value - left / lax.stop_gradient(by_value)


def growth_slopes(known: Stability, names: Sequence[str], mode: int = 0) -> dict[str, float]:
    """Derivatives of the growth rate of a mode (1/s) by parameters of the scene, by name."""
    slopes = _growth_slopes(
        {name: known.state.scene.parameters[name] for name in names}, known.mode(mode)
    )
    return {name: float(slopes[name]) for name in names}


@jax.jit
def _growth_slopes(numbers: dict[str, Array], known: Mode) -> dict[str, Array]:
    def growth(numbers: dict[str, Array]) -> Array:
        return eigenvalue(known.state.scene.replace(**numbers), known).real

    return jax.jacfwd(growth)(numbers)


@dataclass(frozen=True)
class Threshold:
    """Where a steady state loses its stability.

    Attributes:
        name: of the parameter that was varied.
        value: of it, where the growth rate vanishes.
        stability: there.
        iterations: steady states that were looked at.
    """

    name: str
    value: float
    stability: Stability
    iterations: int

    def derivatives(self, names: Sequence[str]) -> dict[str, float]:
        """How the threshold moves with other parameters: d(threshold) / d(parameter).

        Exact, by perturbation theory; the first call compiles for about a minute.
        """
        slopes = growth_slopes(self.stability, [self.name, *names])
        return {name: -slopes[name] / slopes[self.name] for name in names}


def threshold(
    scene: Scene,
    name: str = "rpm",
    start: float | None = None,
    tolerance: float = 1e-9,
    most: int = 30,
    known: Steady | None = None,
) -> Threshold:
    """Where the growth rate of the leading mode vanishes, by secants.

    Args:
        scene: a robot that swims steadily, or with a `known` equilibrium a rod that is held.
        name: of the parameter that is varied.
        start: value to start from; None for that of the scene.
        known: a state near the one at `start`: on its branch the threshold is looked for.
        tolerance: relative change of the value at which it is found.
        most: steady states that are looked at.

    Raises:
        SolverError: no threshold was found, or no steady state on the way to it.
    """
    value = scene.number(name) if start is None else start
    before: tuple[float, float] | None = None
    find = equilibrium if known is not None and known.scene.motor is None else steady
    for count in range(1, most + 1):
        here = scene.replace(**{name: value})
        state = find(here, known)
        modes = stability(state)
        growth = modes.growth_rate
        if before is None:
            step = FIRST_STEP * abs(value)
        else:
            step = -growth * (value - before[0]) / (growth - before[1])
            step = float(np.clip(step, -LONGEST_STEP * abs(value), LONGEST_STEP * abs(value)))
            if abs(step) <= tolerance * abs(value):
                return Threshold(name, value, modes, count)
        before, known = (value, growth), state
        value += step
    raise SolverError(
        f"the growth rate has not vanished in {most} steady states: near {name} = {value:.6g} it "
        f"is {before[1] if before else float('nan'):.3g} 1/s. Try another start, or look at it "
        f"over {name} first."
    )
