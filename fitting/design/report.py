"""What is said of a design: its numbers, in files and in words."""

import json
import math
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from derjax import SceneFile
from derjax.io.output import Output
from derjax.scenes.extensions import unit_of

from .outcome import Design
from .problem import Point

REPORT, SCENE, MOTOR = "design.json", "best.toml", "best_motor.csv"
"""Names of files."""


def as_dict(design: Design, finer: float = math.nan) -> dict[str, Any]:
    """The design as it is written to design.json; SI units. What is not finite becomes null.

    Args:
        design: that has been found.
        finer: its objective with edges half as long; NaN if that is not known.
    """
    problem, objective = design.problem, design.problem.objective
    variables = problem.variables
    content = {
        "status": design.status,
        "objective": {
            "name": objective.name,
            "meaning": objective.meaning,
            "unit": objective.unit,
            "sense": "maximise" if problem.sign > 0 else "minimise",
            "statistic": statistic(design),
            "value": design.objective,
            "value_on_a_finer_mesh": finer,
            "start": None if design.start is None else design.start.objective,
        },
        "through": problem.through,
        "parameters": {
            name: {
                "value": np.asarray(value).tolist(),
                "start": np.asarray(variables.start[name]).tolist(),
                "low": variables.low[name],
                "high": variables.high[name],
                "unit": unit_of(name),
            }
            for name, value in design.values.items()
        },
        "quantities": {
            name: {"value": value, "unit": _unit(design, name)}
            for name, value in design.quantities.items()
        },
        "constraints": [
            {
                "name": limit.quantity.name,
                "min": limit.low,
                "max": limit.high,
                "value": design.quantities[limit.quantity.name],
            }
            for limit in problem.limits
        ],
        "binding": list(design.binding),
        "at_bounds": list(design.at_bounds),
        "sensitivities": {
            name: {
                "slope": each.slope,
                "curvature": each.curvature,
                "tolerance_for_1_percent": each.tolerance,
            }
            for name, each in design.sensitivities.items()
        },
        "starts": [
            {
                "from": _numbers(design, attempt.start),
                "to": None if attempt.end is None else _numbers(design, attempt.end),
                "objective": None if attempt.end is None else attempt.end.objective,
                "status": attempt.status,
                "message": attempt.message,
                "evaluations": len(attempt.path),
            }
            for attempt in design.attempts
        ],
        "evaluations": len(design.points),
        "failures": sum(not point.ok for point in design.points),
        "warnings": list(design.warnings),
        "derjax": version("derjax"),
    }
    if design.spread.size:
        content["spread"] = _spread(design)
    return _finite(content)


def statistic(design: Design) -> str:
    """What of the objective is made good: its value, its mean, or a quantile."""
    uncertain = design.problem.uncertain
    if uncertain is None:
        return "value"
    return "mean" if uncertain.quantile is None else f"quantile {uncertain.quantile:g}"


def _spread(design: Design) -> dict[str, Any]:
    """Of the objective over draws of the uncertain parameters."""
    good = design.spread[np.isfinite(design.spread)]
    levels = (0.05, 0.25, 0.5, 0.75, 0.95)
    return {
        "draws": int(design.spread.size),
        "failed": int(design.spread.size - good.size),
        "mean": float(good.mean()) if good.size else None,
        "std": float(good.std()) if good.size else None,
        "quantiles": {f"{q:g}": float(np.quantile(good, q)) for q in levels} if good.size else {},
    }


def _unit(design: Design, name: str) -> str:
    units = {quantity.name: quantity.unit for quantity in design.problem.quantities}
    return units.get(name) or unit_of(name)


def _numbers(design: Design, point: Point) -> dict[str, Any]:
    numbers = design.problem.variables.numbers(point.x)
    return {name: np.asarray(value).tolist() for name, value in numbers.items()}


def _finite(content: Any) -> Any:
    if isinstance(content, dict):
        return {key: _finite(value) for key, value in content.items()}
    if isinstance(content, list):
        return [_finite(value) for value in content]
    if isinstance(content, float) and not math.isfinite(content):
        return None
    return content


def sentences(design: Design, finer: float = math.nan) -> list[str]:
    """The design in words, for the terminal; arguments as of `as_dict`."""
    objective = design.problem.objective
    unit = "" if objective.unit == "1" else f" {objective.unit}"
    before = "" if design.start is None else f" (the start: {design.start.objective:.6g})"
    said = "" if design.problem.uncertain is None else f"{statistic(design)} of "
    lines = [f"{said}{objective.name} = {design.objective:.6g}{unit}{before}"]
    if math.isfinite(finer):
        off = 100 * (finer / design.objective - 1)
        lines.append(f"with edges half as long: {finer:.6g}{unit} ({off:+.2g} %)")
    lines.append("")
    numbers = {n: v for n, v in design.numbers.items() if np.ndim(v) == 0}
    width = max((len(name) for name in numbers), default=0)
    for name, value in numbers.items():
        own = unit_of(name)
        line = f"{name:<{width}} = {value:.6g}{'' if own == '1' else f' {own}'}"
        if name in design.sensitivities:
            off = design.sensitivities[name].tolerance
            line += f"   (1 % of the objective is lost {off:.2g} off)"
        lines.append(line + ("   at its bound" if name in design.at_bounds else ""))
    for name, value in design.values.items():
        if np.ndim(value):
            lines.append(
                f"{name}: {np.size(value)} values, {np.min(value):.4g} to {np.max(value):.4g}"
            )
    others = {k: v for k, v in design.quantities.items() if k not in (objective.name, "rpm")}
    lines += [""] * bool(others)
    for name, value in others.items():
        own = _unit(design, name)
        lines.append(f"{name} = {value:.6g}{'' if own == '1' else f' {own}'}")
    if design.binding:
        lines += ["", f"limits that bind: {', '.join(design.binding)}"]
    if design.spread.size:
        spread = _spread(design)
        lines += [
            "",
            f"over {spread['draws']} draws of what is uncertain: mean "
            f"{spread['mean']:.6g}, 5 to 95 %: {spread['quantiles']['0.05']:.6g} to "
            f"{spread['quantiles']['0.95']:.6g}",
        ]
    return lines


def write(design: Design, output: Output, finer: float = math.nan) -> list[Path]:
    """Write design.json, and the best design as a scene file; returns their paths."""
    with output.replacing(REPORT) as temporary:
        text = json.dumps(as_dict(design, finer), indent=2, allow_nan=False)
        temporary.write_text(text + "\n", encoding="utf-8")
    file: SceneFile = design.problem.scene.source.file
    scene = _on_the_same_mesh(file.with_parameters({**_means(design), **design.numbers}), file)
    content = scene.model_dump(mode="json", exclude_unset=True, exclude_none=True)
    paths = [output.path / REPORT, output.path / SCENE]
    if scene.motor_table is not None:
        content["motor"] = {**content.get("motor", {}), "table": MOTOR}
        for key in ("rpm", "columns", "time_unit", "time_offset", "counts_per_turn"):
            content["motor"].pop(key, None)
        rates = np.array(scene.motor_table.rpm).reshape(len(scene.motor_table.time), -1)
        names = ["rpm"] if rates.shape[1] == 1 else [f"rpm_{k + 1}" for k in range(rates.shape[1])]
        import pandas as pd  # slow to import

        frame = pd.DataFrame(
            {"time": scene.motor_table.time} | dict(zip(names, rates.T, strict=True))
        )
        with output.replacing(MOTOR) as temporary:
            frame.to_csv(temporary, index=False)
        paths.append(output.path / MOTOR)
    with output.replacing(SCENE) as temporary:
        temporary.write_text(tomli_w.dumps(content), encoding="utf-8")
    return paths


def _on_the_same_mesh(scene: SceneFile, before: SceneFile) -> SceneFile:
    """With the number of edges that designs have, which is that of the scene of the start.

    Where no length of edges gives that number to every flagellum, each has the nearest.
    """
    if scene.edge_counts == before.edge_counts:
        return scene
    edge = min(c / n for c, n in zip(scene.contours, before.edge_counts, strict=True))
    robot = scene.robot.model_copy(update={"edge_length": edge * (1 - 1e-12)})
    fields = {"edge_length"} | scene.robot.model_fields_set
    robot = type(robot).model_construct(_fields_set=fields, **dict(robot))
    return scene.model_copy(update={"robot": robot})


def _means(design: Design) -> dict[str, Any]:
    """What a fit has found in place of the numbers of the scene's file."""
    uncertain = design.problem.uncertain
    return (
        {}
        if uncertain is None
        else dict(zip(uncertain.names, uncertain.mean.tolist(), strict=True))
    )
