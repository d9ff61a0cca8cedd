"""[solver]: how the equations of a step are solved."""

from typing import Annotated, Literal

import jax.numpy as jnp
import numpy as np
from pydantic import Field

from ...io.fields import Count, Positive
from ...rods.topology import Topology
from ...solve.blocks import Layout
from ...solve.newton import NewtonSettings
from .ingredient import Ingredient, SceneFile, Setting

LARGE = 220
"""Nodes from which on a robot is solved for in blocks, unless the scene file says otherwise."""

BLOCK = 16
"""Nodes of a block."""

EXACT = 1e-9
"""Largest scaled residual of a solution, unless the scene file gives another one."""

NEGLIGIBLE = 1e-3
"""Of the largest error of a step: by how much its equations may be unsolved."""


class SolverTable(Ingredient):
    """[solver] Newton's method: largest scaled residual, and number of iterations.

    `tolerance` is 1e-9 if it is not given, but where steps adapt and no derivative is taken: there
    it is enough that a solution is off by a thousandth of what the step may be.
    `method`: one dense matrix, or blocks along the flagella and an iterative method for what
    couples them; by default blocks for robots of many nodes, where they can be had.
    """

    method: Literal["dense", "blocks"] | None = None
    tolerance: Annotated[Positive, Field(lt=1)] | None = None
    max_iterations: Count = 40

    def layout(self, file: SceneFile, topology: Topology) -> Layout | None:
        """The blocks of a robot that is solved for in blocks."""
        large = topology.n_nodes >= LARGE and file.in_blocks
        method = self.method or ("blocks" if large else "dense")
        return Layout(topology, BLOCK) if method == "blocks" else None

    @property
    def negligible(self) -> float:
        """The part of the largest error of a step by which its equations may be unsolved."""
        return NEGLIGIBLE if self.tolerance is None else 0.0

    def newton(self, setting: Setting) -> NewtonSettings:
        """Residuals are measured in EI / L^2, which bends a flagellum by its own length."""
        p, rod = setting.numbers, setting.rod
        length = jnp.sum(rod.rest_length) / setting.file.robot.count
        bending = jnp.mean(p["youngs_modulus"]) * jnp.pi * p["rod_radius"] ** 4 / 4
        position = np.arange(rod.topology.n_dofs) < 3 * rod.topology.n_nodes
        return NewtonSettings(
            tolerance=jnp.asarray(EXACT if self.tolerance is None else self.tolerance),
            force_scale=jnp.where(position, bending / length**2, bending / length),
            size=jnp.where(position, 0.0, jnp.pi),
            max_iterations=self.max_iterations,
        )
