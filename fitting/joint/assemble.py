"""From a dataset to a `Problem`: which unknowns there are, and what each part asks of them."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from derjax import InputError, SceneFile

from ..observe import ANGLE, CHANNELS
from ..tracks import Dataset, Run
from ..transforms import Log, Whole
from . import maps
from .file import Nuisances, Prior
from .parts import RatesPart, TrackPart
from .problem import FromRest, Problem, Sourced, model_from_rest
from .rates import Rates
from .sources import source
from .unknowns import Unknown, Unknowns, fitted_unknowns, of_prior

RPM = 0.1
"""Change of a rate of a motor that is neither large nor small, as a part of it."""


def assemble(
    dataset: Dataset,
    names: Sequence[str],
    initial: Mapping[str, float],
    store: Path | None = None,
) -> Problem:
    """The problem that a dataset poses.

    Args:
        dataset: tracks and speeds.
        names: parameters that are fitted.
        initial: where to start.
        store: a directory for what is simulated from rest.

    Raises:
        InputError: something that cannot be estimated, or would have no effect.
    """
    maker = _Maker(dataset, names, initial, store)
    for run in dataset.runs:
        maker.add_run(run)
    for rates in dataset.rates:
        maker.add_rates(rates)
    if unknown := set(dataset.priors) - set(names):
        raise InputError(
            f"{dataset.path}: [priors] {min(unknown)}: is not among the parameters that are fitted "
            f"({', '.join(names)})"
        )
    return maker.problem()


SLIP = 1.0
"""rad, by which the phase of a motor of uncertain rate may be off at the end of a track."""

MARGIN = 5.0
"""s, by how much a time offset of which nothing is known may be later."""


class _Maker:
    """A problem while it is put together."""

    def __init__(
        self,
        dataset: Dataset,
        names: Sequence[str],
        initial: Mapping[str, float],
        store: Path | None,
    ) -> None:
        self.dataset, self.names, self.initial = dataset, tuple(names), initial
        self.store = store
        self.unknowns = Unknowns()
        self.parts: list[TrackPart | RatesPart] = []
        self.sources: list[Sourced] = []
        self.resting: list[tuple[int, int | None, SceneFile, tuple[int, ...], tuple[str, ...]]] = []
        self.said: list[str] = []
        # What was asked for comes first.
        self._fitted(dataset.scene, None, ())

    def _fitted(
        self, scene: SceneFile, owner: str | None, own: Sequence[str]
    ) -> tuple[tuple[str, ...], tuple[int, ...]]:
        """Names and places of what is fitted, as a run has it."""
        found = fitted_unknowns(
            self.names, scene.single_numbers, self.initial, self.dataset.priors, owner, own
        )
        taken = owner is not None or not any(
            set(self.names) & set(part.own) for part in (*self.dataset.runs, *self.dataset.rates)
        )
        if not taken:
            return self.names, ()
        return self.names, tuple(self.unknowns.index(found[name]) for name in self.names)

    def _viscosity(
        self, owner: str, scene: SceneFile, nuisances: Nuisances
    ) -> tuple[tuple[str, ...], tuple[int, ...]]:
        """Name and place of a viscosity that is not known, if it is not."""
        prior, name = nuisances.viscosity, f"{owner}: viscosity"
        if prior is None:
            prior, name = self.dataset.shared.viscosity, "viscosity (of all)"
        if prior is None:
            return (), ()
        if "viscosity" in self.names:
            raise InputError(f"{owner}: nuisances.viscosity: is fitted already")
        start = float(scene.parameters["viscosity"]) if prior.mean is None else prior.mean
        std = prior.std
        unknown = Unknown(name, Log(), start, "Pa s", None if std is None else start, std)
        return ("viscosity",), (self.unknowns.index(unknown),)

    def _rpm(
        self, owner: str, rpm: float, prior: Prior | None
    ) -> tuple[tuple[str, ...], tuple[int, ...]]:
        """Name and place of a rate of the motor that is not known exactly."""
        if prior is None:
            return (), ()
        unknown = of_prior(f"{owner}: motor_rpm", prior, rpm, RPM * abs(rpm), "rpm")
        return ("rpm",), (self.unknowns.index(unknown),)

    def add_run(self, run: Run) -> None:
        """A track."""
        scene = run.scene or self.dataset.scene
        names, places = self._fitted(scene, run.name, run.own)
        more, others = self._viscosity(run.name, scene, run.nuisances)
        names, places = (*names, *more), (*places, *others)
        if run.steady:
            self._add_steady(run, scene, names, places)
        else:
            self._add_from_rest(run, scene, names, places)

    def _add_steady(
        self, run: Run, scene: SceneFile, names: tuple[str, ...], places: tuple[int, ...]
    ) -> None:
        if run.sight is not None:
            raise InputError(
                f'{run.name}: start = "steady": a silhouette changes as the robot rolls; such '
                "tracks are simulated from rest"
            )
        rpm = scene.parameters["rpm"] if run.motor_rpm is None else run.motor_rpm
        prior = run.nuisances.motor_rpm
        if prior is not None and np.ndim(rpm):
            raise InputError(
                f"{run.name}: nuisances.motor_rpm: is only for motors that all turn at one rate"
            )
        more, others = self._rpm(run.name, float(np.ravel(rpm)[0]), prior)
        names, places = (*names, *more), (*places, *others)
        try:
            found = source(scene, rpm, names)
        except InputError as error:
            raise InputError(f'{run.name}: start = "steady": {error}') from None
        self.sources.append(Sourced(found, places, f"run {run.name!r}"))
        averaged = _averaged(run, found.in_words() == "a periodic orbit")
        start = self._start(run, found.in_words() == "a periodic orbit", averaged)
        chosen, mapped = self._maps(run, steady=True)
        place = len(self.sources) - 1
        self.parts.append(TrackPart(run, place, places, start, chosen, mapped, averaged))
        own = [u.name.removeprefix(f"{run.name}: ") for u in self.unknowns.every]
        fitted = [
            name
            for name, unknown in zip(own, self.unknowns.every, strict=True)
            if unknown.name.startswith(f"{run.name}: ")
        ]
        self.said.append(
            f"{run.name}: compared with {found.in_words()} from the first frame on, without "
            f"simulating the transient; also estimated: {', '.join(fitted)}"
        )
        if any(averaged):
            self.said.append(
                f"{run.name}: as the rate of the motor is uncertain, its phase cannot be told over "
                "the whole track: how the head moves in every turn of it is averaged over"
            )

    def _start(
        self, run: Run, is_orbit: bool, averaged: tuple[bool, bool]
    ) -> tuple[int | None, int | None]:
        """Places of the phase and the roll in the first frame, where they are seen."""
        given = run.nuisances.phase
        phase = roll = None
        if is_orbit and not averaged[0]:
            phase = self.unknowns.index(of_prior(f"{run.name}: phase", given, 0.0, 1.0, "rad"))
        if not averaged[1] and _coordinates(run):
            # With one flagellum the robot turned about its way is the robot at another phase.
            name = f"{run.name}: {'roll' if is_orbit else 'phase'}"
            prior = None if is_orbit else given
            roll = self.unknowns.index(of_prior(name, prior, 0.0, 1.0, "rad"))
        if given is not None and phase is None and (is_orbit or roll is None):
            raise InputError(f"{run.name}: nuisances.phase: has no effect on what is compared")
        return phase, roll

    def _add_from_rest(
        self, run: Run, scene: SceneFile, names: tuple[str, ...], places: tuple[int, ...]
    ) -> None:
        offset = None
        if run.nuisances.time_offset is not None:
            unknown = of_prior(f"{run.name}: time_offset", run.nuisances.time_offset, 0.0, 1.0, "s")
            offset = self.unknowns.index(unknown)
        chosen, mapped = self._maps(run, steady=False)
        varied = places if offset is None else (*places, offset)
        number = len(self.parts)
        self.parts.append(TrackPart(run, None, varied, (None, None), chosen, mapped))
        self.resting.append((number, offset, scene, places, names))
        self.said.append(f"{run.name}: simulated from rest")

    def _maps(self, run: Run, steady: bool) -> tuple[tuple[maps.Map, ...], tuple[int, ...]]:
        """From the robot's track to what is seen of it, and the places of all numbers."""
        given, coordinates = run.nuisances.given, _coordinates(run)
        chosen: list[tuple[maps.Map, Prior | None]] = []
        if self.dataset.noise.discrepancy is not None:
            chosen.append((maps.DISCREPANCY, None))
        # A rotation about y is seen along z, and one about z along y.
        about = tuple(axis for axis, across in (("y", "z"), ("z", "y")) if across in coordinates)
        if (prior := given.get("orientation")) is not None and prior.std is not None:
            about = ("y", "z")
        if about and (steady or "orientation" in given):
            chosen.append((maps.orientation(about), given.get("orientation")))
        if coordinates and (steady or run.free_origin or "origin" in given):
            chosen.append((maps.origin(coordinates), given.get("origin")))
        if coordinates and (run.drift or "drift" in given):
            chosen.append((maps.drift(coordinates), given.get("drift")))
        tracked = ANGLE in run.channels
        if tracked and (steady or run.free_angle or "angle_origin" in given):
            chosen.append((maps.ANGLE_ORIGIN, given.get("angle_origin")))
        made = {one.name for one, _ in chosen}
        for name in set(given) & {"orientation", "origin", "drift", "angle_origin"} - made:
            raise InputError(f"{run.name}: nuisances.{name}: has no effect on what was tracked")
        places: list[int] = []
        for one, prior in chosen:
            places += self._numbers(run.name, one, prior)
        return tuple(one for one, _ in chosen), tuple(places)

    def _numbers(self, owner: str, one: maps.Map, prior: Prior | None) -> list[int]:
        if one is maps.DISCREPANCY:
            return self._discrepancy()
        places = []
        for label, unit, scale in zip(one.labels, one.units, one.scales, strict=True):
            name = f"{owner}: {one.name} {label}".rstrip()
            places.append(self.unknowns.index(of_prior(name, prior, 0.0, scale, unit)))
        return places

    def _discrepancy(self) -> list[int]:
        """Places of by how much the model is off, the same for all."""
        allowed = self.dataset.noise.discrepancy
        if allowed is None:
            return []
        return [
            self.unknowns.index(
                Unknown(f"discrepancy of the {label}", Whole(0.01), 0.0, "1", 0.0, std)
            )
            for label, std in (("way", allowed.way), ("angle", allowed.angle))
        ]

    def add_rates(self, rates: Rates) -> None:
        """Speeds."""
        names, places = self._fitted(rates.scene, rates.name, rates.own)
        more, others = self._viscosity(rates.name, rates.scene, rates.nuisances)
        names, places = (*names, *more), (*places, *others)
        numbers, varied, words = [], [], ""
        for rpm in rates.motor_rpm:
            label = f"{rates.name}, {rpm:g} rpm"
            one, two = self._rpm(label, float(rpm), rates.nuisances.motor_rpm)
            try:
                found = source(rates.scene, float(rpm), (*names, *one))
            except InputError as error:
                raise InputError(f"{rates.name}: {error}") from None
            words = found.in_words()
            varied.append((*places, *two))
            numbers.append(len(self.sources))
            self.sources.append(Sourced(found, varied[-1], label))
        self.parts.append(
            RatesPart(rates, tuple(numbers), tuple(varied), tuple(self._discrepancy()))
        )
        kind = "steady states" if words == "a steady state" else "periodic orbits"
        self.said.append(f"{rates.name}: {len(numbers)} rates, compared with {kind}")

    def problem(self) -> Problem:
        """All that was added."""
        rest = []
        for scene in dict.fromkeys(id(entry[2]) for entry in self.resting):
            entries = [entry for entry in self.resting if id(entry[2]) == scene]
            for places in dict.fromkeys(entry[3] for entry in entries):
                group = [entry for entry in entries if entry[3] == places]
                runs = []
                for number, *_ in group:
                    part = self.parts[number]
                    assert isinstance(part, TrackPart)
                    runs.append(_longer(part.run))
                file, names = group[0][2], group[0][4]
                rest.append(
                    FromRest(
                        model_from_rest(file, runs, names, self.store),
                        tuple(entry[0] for entry in group),
                        places,
                        tuple(entry[1] for entry in group),
                    )
                )
        return Problem(
            self.dataset,
            self.names,
            self.unknowns,
            self.parts,
            self.sources,
            rest,
            self.said,
            self.store,
        )


def _coordinates(run: Run) -> tuple[str, ...]:
    return tuple(CHANNELS[c] for c in run.channels if c != ANGLE)


def _averaged(run: Run, is_orbit: bool) -> tuple[bool, bool]:
    """Whether the phase of the motors is lost over a track, as their rate is not known well enough.

    There would be a minimum of the loss for every turn by which the rate may be off.
    """
    prior = run.nuisances.motor_rpm
    if prior is None:
        return False, False
    slip = np.inf
    if prior.std is not None:
        slip = 2 * np.pi / 60 * prior.std * float(run.time[-1] - run.time[0])
    lost = bool(slip > SLIP)
    return lost, lost and not is_orbit


def _longer(run: Run) -> Run:
    """With frames a little later than they are said to be, if their time is not known."""
    prior = run.nuisances.time_offset
    if prior is None:
        return run
    later = MARGIN if prior.std is None else abs(prior.mean or 0.0) + 4 * prior.std
    return replace(run, time=run.time + later)
