"""Kinematics of one hinge, and the derivatives of energies that depend on its strains.

Reference frames are transported in time from the state at the start of a step, so that within
the step strains are true functions of the new degrees of freedom, and derivatives exact.

Derivatives go through rotations. Let F = (m1, m2, t) be the material frame of an edge. All
strains of a hinge are functions of the rotation R = F0^T F1 from one frame to the next:

    kappa_i = (R_it - R_ti) / (1 + R_tt),    twist = atan2(R_21 - R_12, R_11 + R_22),

which is the curvature binormal 2 t0 x t1 / (1 + t0 . t1) projected on the averaged material
directors, and the angle between the parallel-transported directors (Bergou et al. 2008; 2010).

Turning the two frames by small vectors p0, p1 (components along F0) changes an energy by

    g . (d - p0 x p1 / 2) + d . K d / 2,    d = p1 - p0,

with g and K its derivatives with respect to R -> exp([d]) R. An edge vector e and an angle
turn their frame by the vector W (e', angle')^T,

    w = t x e'/|e| + (angle' + (t x t_old) . e' / (|e| (1 + t_old . t))) t,

the last fraction being the holonomy of transport from t_old. So, with M the moment on a frame,

    gradient = W^T M,    Hessian = W^T (d2E/dp2) W + sym(d(W^T M)/d(e, angle) at fixed M).

JAX differentiates only the energy as a function of the five numbers above; the rest is linear
algebra with 3 x 3 matrices. It equals what JAX finds for the whole to round-off, in a tenth of
the instructions.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...core.pytree import pytree, replace
from ...rods.kinematics import hinge_tangents, positions
from ...rods.kinematics import tangents as edge_tangents
from ...rods.rod import Rod, State
from ...rods.vectors import cross, dot, holonomy, parallel_transport
from ...solve.local import Sum

Density = Callable[[Float[Array, " 2"], Float[Array, ""], Any], Float[Array, ""]]


@pytree
class HingeFrames:
    """Frames of the two edges of each hinge at the start of a step.

    Attributes:
        tangent: (b, 2, 3) pointing along the hinge.
        director: (b, 2, 3) first reference director.
        sign: (b, 2) +1 where the edge runs along the hinge.
        twist: (b,) rad, theta_1 - theta_0 + reference twist, which counts past +-pi.
    """

    tangent: Float[Array, "*b 2 3"]
    director: Float[Array, "*b 2 3"]
    sign: Float[Array, "*b 2"]
    twist: Float[Array, "*b"]


def hinge_frames(rod: Rod, state: State, motor_angle: Float[Array, " k"]) -> HingeFrames:
    """The frames from which the hinges of `rod` measure their strains during a step.

    Strains at a motor are those between one edge and the other one turned back by the motor's
    angle, so that it bends alike at every angle; see `Topology.motor_hinge` for the other way.

    Args:
        rod: topology and stress-free shape.
        state: at the start of the step.
        motor_angle: (k,) rad, of the motors, for which strains are wanted.
    """
    topology = rod.topology
    tangent = edge_tangents(topology, positions(topology, state.q))
    sign = jnp.asarray(topology.hinge_signs)
    theta = sign * state.q[topology.edge_dofs(topology.hinge_edges)]
    frames = HingeFrames(
        tangent=jnp.stack(hinge_tangents(topology, tangent), axis=1),
        director=state.reference_director[topology.hinge_edges],
        sign=sign,
        twist=theta[:, 1] - theta[:, 0] + state.reference_twist,
    )
    if not topology.motors or topology.motor_hinge == "published":
        return frames
    driven = np.array(topology.motors)
    t, d = frames.tangent[driven, 1], frames.director[driven, 1]
    c, s = jnp.cos(motor_angle)[:, None], jnp.sin(motor_angle)[:, None]
    return replace(
        frames,
        director=frames.director.at[driven, 1].set(c * d - s * cross(t, d)),
        twist=frames.twist.at[driven].add(-motor_angle),
    )


class _Edges(NamedTuple):
    """The two edges of one hinge.

    Attributes:
        length: (2,) m.
        frame: (2, 3, 3) with columns m1, m2, t.
    """

    length: Float[Array, " 2"]
    frame: Float[Array, "2 3 3"]


# skew(v) = v @ _SKEW; a matrix product with a constant, which XLA does not duplicate into
# whatever uses it.
_SKEW = np.zeros((3, 3, 3))
for _i, _j, _k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
    _SKEW[_i, _k, _j], _SKEW[_i, _j, _k] = 1.0, -1.0


def _skew(v: Float[Array, "*b 3"]) -> Float[Array, "*b 3 3"]:
    """The matrix [v] with [v] u = v x u."""
    return (v @ _SKEW.reshape(3, 9)).reshape(*v.shape, 3)


def _edges(local: Float[Array, " 11"], frames: HingeFrames) -> _Edges:
    nodes = local[:9].reshape(3, 3)
    edge = nodes[1:] - nodes[:-1]
    length = jnp.sqrt(dot(edge, edge))
    tangent = edge / length[:, None]
    d1 = parallel_transport(frames.director, frames.tangent, tangent)
    d2 = cross(tangent, d1)
    theta = (frames.sign * local[9:])[:, None]
    c, s = jnp.cos(theta), jnp.sin(theta)
    return _Edges(length, jnp.stack([c * d1 + s * d2, c * d2 - s * d1, tangent], axis=-1))


# The five numbers that strains depend on, as linear functions of R (indices 1, 2, t = 0, 1, 2):
# R_1t - R_t1, R_2t - R_t2, R_tt, R_21 - R_12, R_11 + R_22.
_LINEAR = np.zeros((5, 3, 3))
_LINEAR[0, 0, 2], _LINEAR[0, 2, 0] = 1.0, -1.0
_LINEAR[1, 1, 2], _LINEAR[1, 2, 1] = 1.0, -1.0
_LINEAR[2, 2, 2] = 1.0
_LINEAR[3, 1, 0], _LINEAR[3, 0, 1] = 1.0, -1.0
_LINEAR[4, 0, 0] = _LINEAR[4, 1, 1] = 1.0


def _relative(edges: _Edges) -> tuple[Array, Array, Array]:
    """The first frame F0 (3, 3), the rotation R = F0^T F1 (3, 3), and its five numbers."""
    f0, f1 = edges.frame
    rotation = f0.T @ f1
    return f0, rotation, _LINEAR.reshape(5, 9) @ rotation.ravel()


def _strains(
    numbers: Float[Array, " 5"], previous: Float[Array, ""]
) -> tuple[Float[Array, " 2"], Float[Array, ""]]:
    """Curvature (2,) and twist (rad, within half a turn of `previous`)."""
    n1, n2, cosine_bend, sine, cosine = numbers
    c, s = jnp.cos(previous), jnp.sin(previous)
    twist = previous + jnp.arctan2(sine * c - cosine * s, cosine * c + sine * s)
    return jnp.stack([n1, n2]) / (1.0 + cosine_bend), twist


def strains(
    local: Float[Array, " 11"], frames: HingeFrames
) -> tuple[Float[Array, " 2"], Float[Array, ""]]:
    """Integrated curvature (2,) and twist (rad) of one hinge.

    `local` holds its three nodes (m) and two angles (rad).
    """
    _, _, numbers = _relative(_edges(local, frames))
    return _strains(numbers, frames.twist)


def _turning(edges: _Edges, old_tangent: Float[Array, "2 3"]) -> Float[Array, "2 4 3"]:
    """W^T of both edges: from a moment to the force on (edge vector, angle)."""
    t = edges.frame[:, :, 2]
    turn = holonomy(old_tangent, t)
    force = (turn[:, :, None] * t[:, None, :] - _skew(t)) / edges.length[:, None, None]
    return jnp.concatenate([force, t[:, None, :]], axis=1)


def _change_of_turning(
    edges: _Edges, a: Float[Array, "2 3"], moment: Float[Array, "2 3"]
) -> Float[Array, "2 4 4"]:
    """sym(d(W^T M)/d(e, angle)) at fixed M, for both edges; `a` are their old tangents."""
    t = edges.frame[:, :, 2]
    inverse = 1.0 / edges.length
    weight = 1.0 / (1.0 + dot(a, t))
    axial = dot(moment, t)
    turn = holonomy(a, t)
    force = cross(moment, t) + axial[:, None] * turn
    # d force / d t, then d t / d e = (1 - t t) / |e|, then the 1 / |e| of the force itself.
    by_tangent = (
        _skew(moment)
        + turn[:, :, None] * (moment - (axial * weight)[:, None] * a)[:, None, :]
        - (axial * weight)[:, None, None] * _skew(a)
    )
    along = (by_tangent @ t[:, :, None])[:, :, 0] + force
    by_edge = (by_tangent - along[:, :, None] * t[:, None, :]) * (inverse**2)[:, None, None]
    by_angle = (moment - axial[:, None] * t) * inverse[:, None]
    matrix = jnp.concatenate([by_edge, by_angle[:, None, :]], axis=1)
    matrix = jnp.pad(matrix, ((0, 0), (0, 0), (0, 1)))
    return 0.5 * (matrix + matrix.transpose(0, 2, 1))


# g_k = sum_ij _AXIAL[i, j, k] P_ij: the derivative of tr(P^T [d]) with respect to d.
_AXIAL = _SKEW.transpose(1, 2, 0)


def _axial(p: Float[Array, "*b 3 3"]) -> Float[Array, "*b 3"]:
    return p.reshape(*p.shape[:-2], 9) @ _AXIAL.reshape(9, 3)


# (5, 3) axial vectors of LINEAR R^T, as a matrix that acts on R.
_BY_ROTATION = np.einsum("mij,ikn->mnkj", _LINEAR, _AXIAL).reshape(15, 9)


@dataclass(frozen=True)
class HingePotential:
    """An energy of the strains of a hinge, as a function of its degrees of freedom.

    Attributes:
        density: `(kappa (2,), twist, data) -> J` of one hinge.
    """

    density: Density

    def __call__(self, local: Float[Array, " 11"], data: tuple[HingeFrames, Any]) -> Array:
        frames, parameters = data
        return self.density(*strains(local, frames), parameters)

    def _of_numbers(self, numbers: Array, previous: Array, parameters: Any) -> Array:
        return self.density(*_strains(numbers, previous), parameters)

    def gradient(self, local: Float[Array, " 11"], data: tuple[HingeFrames, Any]) -> Array:
        frames, parameters = data
        edges = _edges(local, frames)
        f0, rotation, numbers = _relative(edges)
        slope = jax.grad(self._of_numbers)(numbers, frames.twist, parameters)
        g = _axial((slope @ _LINEAR.reshape(5, 9)).reshape(3, 3) @ rotation.T)
        force = _turning(edges, frames.tangent) @ (f0 @ g)
        return _to_nodes(jnp.concatenate([-force[0], force[1]]), frames.sign)

    def hessian(self, local: Float[Array, " 11"], data: tuple[HingeFrames, Any]) -> Array:
        frames, parameters = data
        edges = _edges(local, frames)
        f0, rotation, numbers = _relative(edges)
        slope = jax.grad(self._of_numbers)(numbers, frames.twist, parameters)
        curved = jax.hessian(self._of_numbers)(numbers, frames.twist, parameters)
        # First and second derivative of the five linear functions of R under R -> exp([d]) R.
        by_rotation = (_BY_ROTATION @ rotation.ravel()).reshape(5, 3)
        p = (slope @ _LINEAR.reshape(5, 9)).reshape(3, 3) @ rotation.T
        g = _axial(p)
        k = by_rotation.T @ curved @ by_rotation + 0.5 * (p + p.T) - jnp.trace(p) * jnp.eye(3)
        turn0, turn1 = _turning(edges, frames.tangent) @ f0
        off_diagonal = turn0 @ (0.5 * _skew(g) - k) @ turn1.T
        moment = f0 @ g
        geometric = _change_of_turning(edges, frames.tangent, jnp.stack([-moment, moment]))
        upper = jnp.concatenate([turn0 @ k @ turn0.T + geometric[0], off_diagonal], axis=1)
        lower = jnp.concatenate([off_diagonal.T, turn1 @ k @ turn1.T + geometric[1]], axis=1)
        half = _to_nodes(jnp.concatenate([upper, lower]), frames.sign)
        return _to_nodes(half.T, frames.sign)

    @classmethod
    def merge(cls, parts: Sequence[tuple["HingePotential", Any]]) -> tuple[Self, Any]:
        """All terms of a rod share the frames of its hinges."""
        frames = parts[0][1][0]
        density = Sum(potential.density for potential, _ in parts)
        return cls(density), (frames, tuple(data for _, (_, data) in parts))


# From (edge vector, angle) of both edges to (three nodes, two angles); angles get their sign.
_NODES = np.zeros((11, 8))
_NODES[0:3, 0:3] = _NODES[3:6, 4:7] = -np.eye(3)
_NODES[3:6, 0:3] = _NODES[6:9, 4:7] = np.eye(3)
_NODES[9, 3] = _NODES[10, 7] = 1.0


def _to_nodes(rows: Float[Array, "8 *k"], sign: Float[Array, " 2"]) -> Float[Array, "11 *k"]:
    """From (edge vector, angle) of both edges to (three nodes, two angles) of the hinge."""
    scale = jnp.concatenate([jnp.ones(9), sign])
    nodes = _NODES @ rows
    return scale.reshape(-1, *([1] * (nodes.ndim - 1))) * nodes
