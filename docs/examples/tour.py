"""What can be done with derjax from Python, in ten short tasks.

    python docs/examples/tour.py [DIRECTORY]

Figures and films go to the directory, by default one that is thrown away. The robot is divided
coarsely, with local drag, so that all of it takes one or two minutes, most of them compilation.
"""

import sys
import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import derjax as dj


def trap(x: jax.Array, stiffness: jax.Array, target: jax.Array) -> jax.Array:
    """The energy (J) of a node that a spring ties to a place."""
    return 0.5 * stiffness * jnp.sum((x[0] - target) ** 2)


def main(directory: Path) -> None:
    """All ten, one after the other."""
    dj.enable_compilation_cache()

    print("1. A scene: from a file, from tables, or by keyword")
    coarse = {"edge_length": 0.02, "time": {"step": 0.02, "end": 0.4, "frame": 0.04}}
    file = dj.robots.single_flagellum(**coarse, fluid={"hydrodynamics": "rft"})
    scene = dj.build(file, {"C_t": 4.0})
    print(scene)

    print("2. A run, its numbers, a figure and a film")
    run = dj.rollout(scene)
    run.raise_if_failed()
    print(run)
    print(f"   speed {1e3 * run.summary()['v_x_m_per_s']:.3f} mm/s")
    figure = run.plot("shape")
    if figure is not None:
        figure.savefig(directory / "shape.png")
    print(f"   {run.film(directory / 'swim.gif', fps=10)}")
    print(run.to_dataset().sizes)

    print("3. Other numbers, without compiling anew")
    for pitch in (0.04, 0.05):
        other = dj.rollout(scene.replace(pitch=pitch))
        print(f"   pitch {pitch} m: moved {1e3 * float(moved(other)):.4f} mm")

    print("4. Gradients of a run, in both modes")
    swim = jax.jit(lambda C_t, pitch: moved(dj.rollout(scene.replace(C_t=C_t, pitch=pitch))))
    forward = jax.jit(jax.jacfwd(swim, argnums=(0, 1)))(4.0, 0.0445)
    reverse = jax.jit(jax.grad(swim, argnums=(0, 1)))(4.0, 0.0445)
    print(f"   {np.array(forward)} {np.array(reverse)}")
    np.testing.assert_allclose(forward, reverse, rtol=1e-8)

    print("5. Energies and forces")
    energies = dj.energies(scene, run.last)
    print({name: f"{float(energy):.3g} J" for name, energy in energies.items()})
    forces = dj.forces(scene, run.last)
    print({name: f"{float(force[0, 0]):.3g} N" for name, force in forces.items()})

    print("6. One step as a potential: value, gradient, Hessian")
    potential = dj.potential(scene, run.last, length=0.01)
    q = run.last.q
    print(f"   {float(potential.value(q)):.4g} J, {potential.hessian(q).shape}")

    print("7. Resistance of the robot as if it were rigid (N s/m, N s, N m s)")
    with np.printoptions(precision=2, suppress=False):
        print(np.asarray(dj.resistance(scene)))

    print("8. An own ingredient in one line: a trap that holds the tip")
    target = dj.positions(scene.rod.topology, scene.start.q)[-1]

    def held(stiffness: jax.Array) -> jax.Array:
        spring = dj.Energy(trap, nodes=[-1], data=(stiffness, target))
        return moved(dj.rollout(scene.with_term(spring)))

    slope = jax.jit(jax.jacfwd(held))(jnp.array(0.1))
    print(f"   {float(held(jnp.array(0.1))):.3g} m, {float(slope):.3g} m^2/N")

    print("9. Many runs at once")
    rates = jnp.array([30.0, 60.0, 90.0])
    rpm = jax.jit(jax.vmap(lambda rpm: moved(dj.rollout(scene.replace(rpm=rpm)))))
    print(f"   {rates} rpm: {1e3 * np.asarray(rpm(rates))} mm")

    print("10. What cannot be says so")
    for wrong in ({"pich": 0.05}, {"pitch": -1.0}):
        try:
            scene.replace(**wrong)
        except (KeyError, dj.InputError) as error:
            print(f"   {type(error).__name__}: {error}")


def moved(run: dj.Run) -> jax.Array:
    """How far the head has gone along x, m."""
    return run.head_position[-1, 0] - run.head_position[0, 0]


if __name__ == "__main__":
    if len(sys.argv) > 1:
        chosen = Path(sys.argv[1])
        chosen.mkdir(parents=True, exist_ok=True)
        main(chosen)
    else:
        with tempfile.TemporaryDirectory() as temporary:
            main(Path(temporary))
