"""How the study of the paper's claims judges, on numbers whose verdict is known."""

import json

import numpy as np
import pandas as pd
import pytest

from benchmarks.paper import local, runs, studies
from benchmarks.paper.__main__ import MARK, parts_of
from benchmarks.paper.claims import CLAIMS, cycle, judged
from derjax.scenes.file import SceneFile

COLUMNS = {claim.column for claim in CLAIMS}


def table(values, phases=("in phase", "antiphase"), rates=(50, 60)):
    """Numbers by pitch over radius, the same for all columns, with others in antiphase at 60."""
    rows = []
    for phase in phases:
        for rpm in rates:
            other = phase == "antiphase" and rpm == 60
            for ratio, value in values.items():
                number = 1.0 - value if other else value
                rows.append({"phase": phase, "rpm": rpm, "pitch/r": ratio})
                rows[-1] |= dict.fromkeys(COLUMNS, number)
    return pd.DataFrame(rows)


def test_verdicts():
    made = judged(table({5: 0.3, 7: 0.1, 9: 0.01}), pd.DataFrame()).set_index("claim")
    bundles = made.loc["5: bundles"]
    assert (bundles["in phase"], bundles["antiphase"]) == ("all", "all")
    assert bundles["verdict"] == "holds"
    partial = made.loc["7: partial bundle"]
    assert (partial["in phase"], partial["antiphase"]) == ("all", "50")
    fast = made.loc["head rate highest at 7"]
    assert (fast["in phase"], fast["antiphase"], fast["verdict"]) == ("none", "none", "contradicts")
    lowest = made.loc["efficiency lowest at 5"]
    assert (lowest["in phase"], lowest["antiphase"]) == ("none", "60")
    assert lowest["verdict"] == "holds only under these conditions"


def test_what_fails_with_one_thing_changed_is_conditional():
    changed = table({5: 0.1, 7: 0.1, 9: 0.01}, ("in phase",), (50,)).assign(**{"if": "friction"})
    made = judged(table({5: 0.3, 7: 0.1, 9: 0.01}), changed).set_index("claim")
    assert made.loc["5: bundles", "but not with"] == "friction"
    assert made.loc["5: bundles", "verdict"] == "holds only under these conditions"
    assert made.loc["7: partial bundle", "verdict"] == "holds"


@pytest.mark.parametrize(("period", "duty"), [(60.0, 1 / 6), (30.0, 0.5)])
def test_period_and_duty_of_a_cycle(period, duty):
    """Of pulses with ripple at the rate of the motors, and noise."""
    time = np.arange(0.0, 300.0, 0.2)
    rng = np.random.default_rng(0)
    pulses = 0.2 + 0.1 * ((time / period) % 1.0 < duty)
    ripple = 0.03 * np.sin(2 * np.pi * time / 1.2) + 0.005 * rng.normal(size=time.size)
    series = pd.DataFrame({"time": time, "bundle_fraction": pulses + ripple})
    found, part, amplitude = cycle(series)
    assert found == pytest.approx(period, rel=0.05)
    assert part == pytest.approx(duty, abs=0.04)
    assert amplitude == pytest.approx(0.1, abs=0.02)


@pytest.mark.parametrize("length", [studies.WHOLE, studies.QUICK], ids=["whole", "quick"])
def test_every_run_of_the_study_is_a_scene(length):
    makers = (studies.pairs, studies.conditions, studies.unbundling, studies.winding)
    cases = [c for make in (*makers, studies.synchrony, studies.wrapping) for c in make(length)]
    assert len({case.name for case in cases}) == len(cases)
    for case in cases:
        SceneFile.from_dict(case.tables)


def test_runs_are_made_once_and_obey_the_law_of_efficiency(tmp_path):
    """eta = (3/4) (C_t / C_r) v / (r_h omega_h), which makes the paper's orderings contradict."""
    tables = runs.two_flagella(5, 0.4, robot={"edge_length": 0.03}, contact={"method": "none"})
    case = runs.Case("one", {"pitch/r": 5}, tables)
    first = runs.results_of([case], tmp_path)["one"]
    numbers = first.numbers
    law = 0.75 * 4.8 / 0.36 * abs(numbers["v_x_m_per_s"] / numbers["head_rate_rad_per_s"]) / 31e-3
    assert numbers["efficiency"] == pytest.approx(law, rel=1e-12)
    kept = json.loads((tmp_path / "one.json").read_text())
    kept["numbers"]["efficiency"] = 7.0
    (tmp_path / "one.json").write_text(json.dumps(kept))
    assert runs.results_of([case], tmp_path)["one"].numbers["efficiency"] == 7.0
    other = case._replace(tables=tables | {"motor": {"rpm": 61.0}})
    assert runs.results_of([other], tmp_path)["one"].numbers["efficiency"] != 7.0


def test_the_local_model_crosses_where_it_is_known_to():
    """Clamped beams swing at 3.516 and 22.03; a little flow turns tips by Bu / 8; crossing at 7."""
    matrix, _ = local.fourth_derivative()
    rates = np.sqrt(np.sort(np.linalg.eigvals(matrix).real)[:2])
    assert rates == pytest.approx([3.516, 22.03], rel=2e-3)
    assert local.turned(0.1)[-1] == pytest.approx(0.1 / 8, rel=5e-3)
    assert local.turned(6.5, end=8.0)[-1] < np.pi / 2 < local.turned(7.5, end=8.0)[-1]
    assert studies.PUBLISHED.number(studies.PUBLISHED_RATE) == pytest.approx(1050, rel=0.01)


def test_a_page_keeps_the_parts_of_other_studies(tmp_path):
    page = tmp_path / "paper.md"
    assert parts_of(page) == {}
    text = "# Title\n\n"
    for name in ("pairs", "single"):
        text += f"{MARK.format(name)}\n\n## Of {name}\n\n| a |\n\n"
    page.write_text(text)
    assert parts_of(page) == {name: f"## Of {name}\n\n| a |\n" for name in ("pairs", "single")}
