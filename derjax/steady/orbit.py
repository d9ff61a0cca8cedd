"""Relative periodic orbits: how robots with several flagella swim steadily.

Flagella on one head pass each other in every turn of their motors, so that no shape stays as it is.
But after a turn the robot may be what it was, moved and turned as a whole: with Phi the motion
during one turn and g that rigid motion, a state s with

    s = g^-1 Phi(s)

is looked for by Newton's method. Its matrix is known by what it does only, from derivatives of a
rollout in forward mode, and as most displacements die out within a turn a few products do
(shooting with GMRES: Viswanath, J. Fluid Mech. 580, 339, 2007). Contact may be active. The
eigenvalues of the same map are the Floquet multipliers: what a turn makes of a small displacement.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from ..core.errors import InputError
from ..core.status import SolverError, Status
from ..integrate.step import Scene, enlarge
from ..rods.rod import State
from .motion import prescribed
from .turn import Turn, TurnDerivative, by_parameter, one_turn, rates_along, states_of_turn

SLOWEST = 6
"""Turns of the slower motors within which all motors must be back where they were."""

GMRES = 1e-3
"""To how much of the residual a step of Newton's method is solved for."""

PARTS = (1.0, 0.3, 0.1, 0.0)
"""Of a step of Newton's method, tried one after another."""

EXACT = 1e-8
"""To how much derivatives by parameters are."""


@dataclass(frozen=True)
class Orbit:
    """A steady motion that comes back to itself in every turn of the motors.

    Attributes:
        scene: whose motion.
        state: where a turn begins.
        period: s, of a turn.
        steps: of time in a turn.
        turn, shift: what a turn makes of the robot as a whole: x to turn x + shift (m).
        speed: m/s, along the axis about which the robot is turned, in the sense in which flagella
            spin: how fast it gets on.
        head_rate: rad/s, at which the head turns about its own axis, on average.
        residual: what a turn changes otherwise, over the length of the robot.
        iterations: Newton steps.
        turns: of the motors that were computed, a product with the derivative counted as one.
        enlarged: how often the lists of contacts of the scene were made longer.
    """

    scene: Scene
    state: State
    period: float
    steps: int
    turn: Float[np.ndarray, "3 3"]
    shift: Float[np.ndarray, " 3"]
    speed: float
    head_rate: float
    residual: float
    iterations: int
    turns: int
    enlarged: int

    def one_turn(self) -> State:
        """The states of a turn, after every step of time, with a leading axis."""
        return states_of_turn(self.steps, self.scene, self.state, self.period)

    def multipliers(self, count: int = 4) -> Complex[np.ndarray, " k"]:
        """The largest Floquet multipliers.

        What a turn makes of small displacements, rigid motions excluded: all are smaller than one
        where the orbit attracts.
        """
        program = TurnDerivative(self.scene, self.state, self.period, self.steps)
        return program.eigenvalues(count)

    def derivatives(self, names: Sequence[str]) -> dict[str, dict[str, float]]:
        """Of speed (m/s) and head rate (rad/s) by parameters of the scene, by name.

        Exact for the steps of time that are taken, by the implicit function theorem.

        Raises:
            KeyError: a parameter that the scene does not have.
            ValueError: one with several values.
        """
        program = TurnDerivative(self.scene, self.state, self.period, self.steps)
        found = {}
        for name in names:
            self.scene.number(name)
            along = by_parameter(
                name, self.enlarged, self.scene, self.state, self.steps, self.period
            )
            z = program.solve(program.of_one_size(along[0]), EXACT)
            speed, head_rate = rates_along(
                self.scene, self.state, self.period, self.steps, program.whole(z)
            )
            found[name] = {
                "speed": float(along[1] + speed),
                "head_rate": float(along[2] + head_rate),
            }
        return found


def orbit(
    scene: Scene,
    state: State | None = None,
    *,
    steps: int = 50,
    turns: int = 4,
    tolerance: float = 1e-6,
    most: int = 12,
) -> Orbit:
    """The relative periodic orbit of a robot whose motors turn at constant rates.

    Unknown are positions, angles and their rates where a turn begins; what a step knows of those
    before it (`State.history`) is left out, and so are accelerations, which only masses feel. On
    the host; `Orbit.derivatives` has derivatives.

    Args:
        scene: of one flagellum or more. Its own scheme is used, with steps of one length.
        state: where the search starts; None for the end of some `turns` from rest.
        steps: of time in a turn.
        turns: of the motors before the search begins.
        tolerance: of what may change in a turn, over the length of the robot.
        most: Newton steps.

    Raises:
        InputError: the rates of the motors change, or they have no short period in common.
        SolverError: a step of time failed, or no orbit was found: it may not be periodic.
    """
    search = _Search(scene, period_of(scene), steps)
    begin = scene.start if state is None else state
    for _ in range(turns if state is None else 0):
        begin = search.turn(begin).state
    residual, before = np.inf, np.inf
    for iteration in range(most):
        done = search.turn(begin)
        program = TurnDerivative(search.scene, begin, search.period, steps)
        change = program.of_one_size(done.change)
        residual = float(np.max(np.abs(change)))
        if residual <= tolerance:
            return search.found(begin, done, residual, iteration)
        if residual > max(2.0 * before, 0.1):
            break
        before = residual
        z = program.solve(change, GMRES)
        search.turns += program.products
        begin = search.nearer(begin, program.whole(z))
    raise SolverError(
        f"no orbit was found in {most} Newton steps: in a turn the robot still changes by "
        f"{residual:.1e} of its length. Its motion may not be periodic, as with flagella that "
        "bundle and part again; try more turns first, or a state of a long run."
    )


class _Search:
    """Turn by turn, with longer lists of contacts where they are needed."""

    def __init__(self, scene: Scene, period: float, steps: int) -> None:
        self.scene, self.period, self.steps = scene, period, steps
        self.enlarged, self.turns = 0, 0

    def turn(self, begin: State, z: Array | None = None) -> Turn:
        """A turn from a state that is displaced by z."""
        z = jnp.zeros(2 * begin.q.size) if z is None else z
        self.turns += 1
        done = one_turn(self.steps, self.scene, begin, self.period, z)
        while int(done.stats.status) == Status.CAPACITY:
            self.scene, self.enlarged = enlarge(self.scene), self.enlarged + 1
            done = one_turn(self.steps, self.scene, begin, self.period, z)
        if not done.stats.ok:
            raise SolverError(f"in a turn of {self.period:.4g} s: {done.stats.message()}")
        return done

    def nearer(self, begin: State, z: Array) -> State:
        """The end of a turn from where Newton's method leads, or less far where that fails.

        As rods overlap there, say. With no step at all it is one more turn.
        """
        for part in PARTS:
            try:
                return self.turn(begin, part * z).state
            except SolverError:
                if part == 0.0:
                    raise
        raise AssertionError("the last part is zero")

    def found(self, begin: State, done: Turn, residual: float, iterations: int) -> Orbit:
        return Orbit(
            scene=self.scene,
            state=begin,
            period=self.period,
            steps=self.steps,
            turn=np.asarray(done.turn),
            shift=np.asarray(done.shift),
            speed=float(done.speed),
            head_rate=float(done.head_rate),
            residual=residual,
            iterations=iterations,
            turns=self.turns,
            enlarged=self.enlarged,
        )


def period_of(scene: Scene) -> float:
    """s, after which all motors are back where they were.

    Raises:
        InputError: they stand still, their rates change, or that would take too many turns.
    """
    motor = prescribed(scene)
    if not np.any(motor.rate):
        raise InputError("an orbit needs motors that turn at constant rates: they stand still")
    rates = np.abs(np.asarray(motor.rate[0]))
    rates = rates[rates > 0.0]
    turns = [Fraction(float(r / rates.min())).limit_denominator(SLOWEST) for r in rates]
    exact = all(
        abs(float(t) * rates.min() - r) < 1e-9 * r for t, r in zip(turns, rates, strict=True)
    )
    common = int(np.lcm.reduce([t.denominator for t in turns]))
    if not exact or common > SLOWEST:
        rpm = ", ".join(f"{r * 30 / np.pi:.6g}" for r in rates)
        raise InputError(
            f"motors at {rpm} rpm have no period of at most {SLOWEST} turns in common: their "
            "motion does not come back to itself; simulate it in time"
        )
    return float(2 * np.pi * common / rates.min())
