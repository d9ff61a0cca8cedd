"""Surfaces of what a film shows: tubes along its lines, and a ball."""

from typing import NamedTuple

import numpy as np

from .film import Film

SLIDE = 0.3
"""Mitres of a tube where it turns back on itself are cut short by this bound on 1 + cos."""


class Mesh(NamedTuple):
    """A surface: vertices (t, v, 3) in mm, quadrilaterals (f, 4), the line (v,) of each vertex."""

    vertices: np.ndarray
    faces: np.ndarray
    line: np.ndarray


def tubes(film: Film, sides: int) -> Mesh:
    """Tubes with `sides` sides along the lines of a film."""
    vertices, faces, line = [], [], []
    first = 0
    for number, path in enumerate(film.lines):
        rings = _tube(film.nodes[:, list(path)], film.rod_radius, sides)
        count = rings.shape[1]
        vertices.append(rings.reshape(len(rings), count * sides, 3))
        faces.append(first + _quadrilaterals(count, sides))
        line += [number] * (count * sides)
        first += count * sides
    return Mesh(np.concatenate(vertices, axis=1), np.concatenate(faces), np.array(line))


def ball(rings: int, sides: int) -> tuple[np.ndarray, np.ndarray]:
    """A ball about the origin with radius 1: vertices (v, 3) and quadrilaterals (f, 4)."""
    down = np.linspace(0.0, np.pi, rings)[:, None]
    around = np.linspace(0.0, 2 * np.pi, sides, endpoint=False)
    ring = np.sin(down) * np.cos(around), np.sin(down) * np.sin(around), np.cos(down) + 0 * around
    return np.stack(ring, axis=-1).reshape(-1, 3), _quadrilaterals(rings, sides)


def _tube(path: np.ndarray, radius: float, sides: int) -> np.ndarray:
    """(t, rings, sides, 3): rings about a path (t, m, 3), mitred at its nodes, with round ends."""
    along = np.diff(path, axis=1)
    along = along / np.maximum(np.linalg.norm(along, axis=-1, keepdims=True), 1e-30)
    turns = np.linspace(0.0, 2 * np.pi, sides, endpoint=False)[:, None]
    across = np.cross(along[:, 0], np.eye(3)[np.abs(along[:, 0]).argmin(axis=-1)])
    across /= np.linalg.norm(across, axis=-1, keepdims=True)
    rings = []
    for i in range(path.shape[1]):
        before, after = along[:, max(i - 1, 0)], along[:, min(i, along.shape[1] - 1)]
        other = np.cross(before, across)
        circle = radius * (np.cos(turns) * across[:, None] + np.sin(turns) * other[:, None])
        both = before + after
        slope = _dot(circle, both[:, None]) / np.maximum(_dot(before, both), SLIDE)[:, None]
        rings.append(path[:, i, None] + circle - slope * before[:, None])
        # What is across `before` goes to what is across `after` without turning about them.
        across = across - both * _dot(across, after) / np.maximum(_dot(before, both), 1e-9)
        across /= np.maximum(np.linalg.norm(across, axis=-1, keepdims=True), 1e-30)
    return np.stack(
        [
            *_cap(path[:, 0], rings[0], -radius * along[:, 0])[::-1],
            *rings,
            *_cap(path[:, -1], rings[-1], radius * along[:, -1]),
        ],
        axis=1,
    )


def _cap(centre: np.ndarray, ring: np.ndarray, outwards: np.ndarray) -> list[np.ndarray]:
    """Two smaller rings beyond the last `ring` (t, sides, 3) of a tube, which close it."""
    centre, outwards = centre[:, None], outwards[:, None]
    return [centre + 0.8 * (ring - centre) + 0.6 * outwards, centre + outwards + 0 * ring]


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.sum(a * b, axis=-1, keepdims=True)


def _quadrilaterals(rings: int, sides: int) -> np.ndarray:
    """(f, 4): the corners of the faces between rings of `sides` vertices each."""
    ring, side = np.meshgrid(np.arange(rings - 1), np.arange(sides), indexing="ij")
    ring, side, after = sides * ring.ravel(), side.ravel(), (side.ravel() + 1) % sides
    return np.stack([ring + side, ring + after, ring + sides + after, ring + sides + side], axis=1)
