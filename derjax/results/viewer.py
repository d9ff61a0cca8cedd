"""A film of a trajectory as a web page: a view in three dimensions to turn, zoom and play.

The page holds everything that it needs, the library plotly.js included (5 MB), and loads
nothing from elsewhere.
"""

from pathlib import Path
from typing import Any

import numpy as np
import plotly.graph_objects as go

from ..io.files import atomic_path
from .film import HEAD, Film
from .surfaces import ball, tubes

PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<title>Film of a run of derjax</title>
<style>body { margin: 0; overflow: hidden; }</style>
</head>
<body>
CONTENT
</body>
</html>
"""
# With every frame plotly.js sets the camera back to where it was at the end of the last drag. So
# that the view can be turned and zoomed at any time, the film rests meanwhile.
REST_WHILE_TURNED = """
const view = document.getElementById("{plot_id}");
const [play, pause] = view.layout.updatemenus[0].buttons.map((button) => button.args);
const last = view.layout.sliders[0].steps.at(-1).args[0][0];
let playing = false, resting = false, shown = null, timer = null;
view.on("plotly_buttonclicked", (event) => { playing = event.button.label === "Play"; });
view.on("plotly_sliderchange", (event) => { if (event.interaction) playing = false; });
view.on("plotly_animatingframe", (event) => { shown = event.name; });
const rest = () => {
  clearTimeout(timer);
  if (playing && !resting && shown !== last) {
    resting = true;
    Plotly.animate(view, ...pause).catch(() => {});
  }
};
const goOn = () => {
  clearTimeout(timer);
  timer = setTimeout(() => {
    // At the end of a drag plotly.js notes the camera; after turning the wheel it does not.
    scene.querySelector("canvas").dispatchEvent(new MouseEvent("mouseup"));
    if (resting && playing) Plotly.animate(view, ...play).catch(() => {});
    resting = false;
  }, 500);
};
const scene = view.querySelector(".gl-container");
for (const moved of ["mousedown", "touchstart", "wheel"]) {
  scene.addEventListener(moved, rest, { capture: true, passive: true });
}
for (const left of ["mouseup", "touchend", "wheel"]) window.addEventListener(left, goOn);
"""
SIDES, BALL = 5, (9, 14)
LIGHTING = {"ambient": 0.55, "diffuse": 0.6, "specular": 0.15, "roughness": 0.6, "fresnel": 0.1}
LIGHT = {"x": -3e4, "y": -1e5, "z": 1e5}


def write_html(film: Film, path: Path) -> None:
    """Writes the page.

    Raises:
        OSError: it cannot be written.
    """
    content = view(film).to_html(
        full_html=False,
        include_plotlyjs=True,
        include_mathjax=False,
        auto_play=False,
        post_script=REST_WHILE_TURNED,
        config={"displaylogo": False, "responsive": True},
        default_height="100vh",
    )
    with atomic_path(path) as temporary:
        temporary.write_text(PAGE.replace("CONTENT", content), encoding="utf-8")


def view(film: Film) -> go.Figure:
    """The figure: rods and head as meshes, whose vertices are all that a frame changes."""
    mesh = tubes(film, SIDES)
    surfaces = [mesh.vertices]
    traces = [
        go.Mesh3d(
            **_coordinates(mesh.vertices[0]),
            **_triangles(mesh.faces),
            vertexcolor=[film.colours[line] for line in mesh.line],
            lighting=LIGHTING,
            lightposition=LIGHT,
            hoverinfo="skip",
        )
    ]
    if film.head is not None:
        shape, faces = ball(*BALL)
        surfaces.append(film.head[:, None] + film.head_radius * shape)
        traces.append(
            go.Mesh3d(
                **_coordinates(surfaces[1][0]),
                **_triangles(faces),
                color=HEAD,
                opacity=0.2,
                lighting=LIGHTING,
                lightposition=LIGHT,
                hoverinfo="skip",
            )
        )
    frames = [
        go.Frame(
            name=str(i),
            data=[{"type": "mesh3d", **_coordinates(surface[i])} for surface in surfaces],
            traces=list(range(len(surfaces))),
        )
        for i in range(film.n_frames)
    ]
    return go.Figure(traces, _layout(film), frames)


def _coordinates(vertices: np.ndarray) -> dict[str, np.ndarray]:
    """The vertices (v, 3) in mm, in single precision, which a picture does not exceed."""
    return dict(zip("xyz", vertices.T.astype(np.float32), strict=True))


def _triangles(faces: np.ndarray) -> dict[str, np.ndarray]:
    """Quadrilaterals (f, 4) as two triangles each."""
    return dict(zip("ijk", np.concatenate([faces[:, :3], faces[:, [0, 2, 3]]]).T, strict=True))


def _layout(film: Film) -> dict[str, Any]:
    low, high = film.bounds()
    moment = {"mode": "immediate", "transition": {"duration": 0}}
    still = moment | {"frame": {"duration": 0, "redraw": True}}
    running = moment | {
        "frame": {"duration": 1e3 * film.frame_length, "redraw": True},
        "fromcurrent": True,
    }
    axes = {
        f"{name}axis": {
            "title": film.axis_label(name),
            "range": [float(low[i]), float(high[i])],
            "showspikes": False,
            "backgroundcolor": "#f6f6f6",
            "gridcolor": "#dddddd",
        }
        for i, name in enumerate("xyz")
    }
    box = dict(zip("xyz", ((high - low) / (high - low).max()).tolist(), strict=True))
    return {
        "template": "plotly_white",
        "margin": {"l": 0, "r": 0, "t": 0, "b": 0},
        "showlegend": False,
        "uirevision": "kept",  # turning and zooming last while the film plays
        "scene": {
            **axes,
            "aspectmode": "manual",
            "aspectratio": box,
            "camera": {"eye": {"x": 0.4, "y": -1.2, "z": 0.45}},
        },
        "updatemenus": [
            {
                "type": "buttons",
                "direction": "left",
                "x": 0.02,
                "y": 0.0,
                "xanchor": "left",
                "yanchor": "top",
                "pad": {"t": 12},
                "showactive": False,
                "buttons": [
                    {"label": "Play", "method": "animate", "args": [None, running]},
                    {"label": "Pause", "method": "animate", "args": [[None], still]},
                ],
            }
        ],
        "sliders": [
            {
                "x": 0.16,
                "y": 0.0,
                "len": 0.8,
                "yanchor": "top",
                "pad": {"t": 0, "b": 10},
                "currentvalue": {"prefix": "t = ", "suffix": " s"},
                "ticklen": 0,
                "minorticklen": 0,
                "steps": [
                    {"label": film.moment(i), "method": "animate", "args": [[str(i)], still]}
                    for i in range(film.n_frames)
                ],
            }
        ],
    }
