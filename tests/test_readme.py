"""README's first command finds the truth, and prints what README says that it prints."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest
import xarray as xr
from quick import environment_of_users

ROOT = Path(__file__).parents[1]
TRUTH = {"C_t": 4.8, "C_r": 0.36}

BETWEEN_CODES = 3e-3
"""The tracks are another code's: its speeds and rates differ by 0.1 %, and with them what is
fitted by about as much."""

ESTIMATE = re.compile(r"^(C_t|C_r) = .*$", re.MULTILINE)


def test_the_values_of_the_readme_are_the_truth() -> None:
    """To what it claims, and to how far the two codes are apart."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    shown = {match[1]: match[0] for match in ESTIMATE.finditer(readme)}
    assert set(shown) == set(TRUTH)
    for name, truth in TRUTH.items():
        value, std = map(float, re.findall(r"= (\S+) \+- (\S+) ", shown[name])[0])
        assert abs(value - truth) <= 3.0 * std + BETWEEN_CODES * truth


@pytest.mark.slow
def test_the_calibration_of_the_readme(tmp_path: Path) -> None:
    """In a process of its own, as its simulations take longer than to compile them well."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    command = re.search(r"derjax (fit \S+) -o \S+$", readme, re.MULTILINE)
    assert command is not None
    program = "import sys; from derjax.commands.main import main; sys.exit(main())"
    done = subprocess.run(
        [sys.executable, "-c", program, *command[1].split(), "-o", str(tmp_path / "fit")],
        cwd=ROOT,
        env=environment_of_users(),
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert "warning" not in done.stderr
    fit = json.loads((tmp_path / "fit" / "fit.json").read_text())
    assert fit["status"] == "converged"
    assert (tmp_path / "fit" / "fit.png").stat().st_size > 10_000
    page = (tmp_path / "fit" / "report.html").read_text(encoding="utf-8")
    labelled = xr.load_dataset(tmp_path / "fit" / "fit.nc")
    for name in TRUTH:
        assert f"{fit['parameters'][name]['value']:.6g}" in page
        kept = labelled["value"].sel(parameter=name)
        assert float(kept) == pytest.approx(fit["parameters"][name]["value"])
    for name, truth in TRUTH.items():
        found = fit["parameters"][name]
        assert abs(found["value"] - truth) <= 3.0 * found["std"] + BETWEEN_CODES * truth
    shown = [match[0] for match in ESTIMATE.finditer(readme)]
    assert len(shown) == len(TRUTH)
    assert shown == [match[0] for match in ESTIMATE.finditer(done.stdout)]
