"""A fit as a labelled data set, which other programs can open.

import xarray
fit = xarray.open_dataset("results/fit/fit.nc")
fit.value.sel(parameter="C_t")
"""

from importlib.metadata import version

import numpy as np
import xarray as xr

from derjax.io.output import Output

from .observe import ANGLE, CHANNELS
from .outcome import Fit
from .report import NETCDF, as_unit


def to_dataset(fit: Fit) -> xr.Dataset:
    """Parameters, their correlation, tracks and speeds over the fit. SI units, in attributes.

    Of the run k there are the dimensions `frame_k`, `channel_k` and `time_k` of the simulation, and
    the variables `track_k`, `residual_k` and `fitted_k`; of speeds `rate_k`, `measured_k`,
    `fitted_rates_k`.
    """
    names = list(fit.estimates)
    every = {**fit.estimates, **fit.nuisances}
    estimates = list(every.values())
    variables = {
        "value": ("parameter", [e.value for e in estimates], {"long_name": "estimate"}),
        "std": ("parameter", [e.std for e in estimates], {"long_name": "standard error"}),
        "low": ("parameter", [e.ci95[0] for e in estimates], {"long_name": "95 % interval"}),
        "high": ("parameter", [e.ci95[1] for e in estimates], {"long_name": "95 % interval"}),
        "unit": ("parameter", [as_unit(fit, name) for name in every]),
        "fitted": ("parameter", np.array([name in names for name in every])),
        "correlation": (("fitted_parameter", "fitted_parameter_too"), fit.correlation),
        "loss": ("iteration", [one.loss for one in fit.history]),
    }
    coordinates = {
        "parameter": list(every),
        "fitted_parameter": names,
        "fitted_parameter_too": names,
        "iteration": np.arange(len(fit.history)),
    }
    for k, one in enumerate(fit.runs):
        frame, channel, moment = f"frame_{k}", f"channel_{k}", f"moment_{k}"
        units = ", ".join(
            f"{CHANNELS[c]}: {'rad' if c == ANGLE else 'm'}" for c in one.run.channels
        )
        run = {"run": one.run.name, "units": units}
        coordinates[channel] = [CHANNELS[c] for c in one.run.channels]
        variables |= {
            f"time_{k}": (frame, one.run.time, {"units": "s", "run": one.run.name}),
            f"track_{k}": ((frame, channel), one.run.values, run),
            f"residual_{k}": ((frame, channel), one.residuals, run),
            f"fitted_time_{k}": (moment, one.after.time, {"units": "s"}),
            f"fitted_{k}": (
                (moment, channel),
                one.after.observed[:, list(one.run.channels)],
                run,
            ),
        }
    for k, rates in enumerate(fit.rates):
        rate, what = f"rate_{k}", f"what_{k}"
        coordinates[what] = ["speed", "head_rate"]
        told = {"rates": rates.name, "units": "speed: m/s, head_rate: rad/s"}
        variables |= {
            f"motor_rpm_{k}": (rate, rates.motor_rpm, {"units": "rpm"}),
            f"measured_{k}": ((rate, what), rates.data, told),
            f"measured_std_{k}": ((rate, what), rates.std, told),
            f"fitted_rates_{k}": ((rate, what), rates.fitted, told),
        }
    attributes = {
        "status": fit.status,
        "loss": fit.loss,
        "warnings": "\n".join(fit.warnings),
        "decisions": "\n".join(fit.said),
        "goodness": fit.goodness.sentence(),
        "dataset": "" if fit.dataset.path is None else str(fit.dataset.path),
        "derjax": version("derjax"),
        **{f"noise_{kind}": value for kind, value in fit.noise.items()},
        **{f"correlation_of_noise_{kind}": value for kind, value in fit.memory.items()},
    }
    return xr.Dataset(variables, coordinates, attributes)


def write_netcdf(fit: Fit, output: Output) -> None:
    """Write fit.nc."""
    with output.replacing(NETCDF) as temporary:
        to_dataset(fit).to_netcdf(temporary, engine="h5netcdf")
