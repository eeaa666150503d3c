"""The log before under its model, and what every number would change of its innovations."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from coax_env.comparison.two_logs.coordinates import ROTOR_SPEED, Coordinate, coordinates
from coax_env.comparison.two_logs.logs import Logs
from coax_env.diagnosis.fits import fitted, noise_fitted, start
from coax_env.diagnosis.preparation import namable
from coax_env.diagnosis.problem import Fit, Problem
from coax_env.diagnosis.search import search
from coax_env.diagnosis.settings import SETTINGS, Settings
from coax_env.estimation import vibration
from coax_env.estimation.battery import stated
from coax_env.estimation.changing_model import BEFORE, ChangingModel, clock_of
from coax_env.estimation.flown import flown_parts
from coax_env.estimation.helicopter import HeliModel, Moment, record_of
from coax_env.estimation.helicopter_noise import starting_noise
from coax_env.estimation.parted_engine import of_part
from coax_env.estimation.prediction import WARM_UP
from coax_env.logs.fast_rows import decimated
from coax_env.logs.flight import Flight
from coax_env.model import effects
from coax_env.model.vehicle import Vehicle
from coax_env.progress import Progress


def calm(flight: Flight, vehicle: Vehicle) -> Flight:
    """What was flown, without what vibrates at a rotor's speed, in no more rows than a fit needs.

    Args:
        flight: as read.
        vehicle: in the flight's air.
    """
    return decimated(vibration.calmed(flown_parts(flight, vehicle), vehicle)[1])


def fitted_model(
    flight: Flight,
    vehicle: Vehicle,
    settings: Settings = SETTINGS,
    progress: Progress | None = None,
) -> tuple[Problem, Fit]:
    """The model of a flight, all runs fitted, with the effects that a search finds.

    Args:
        flight: `calm`.
        vehicle: in the flight's air.
        settings: of the search.
        progress: called with a line of text.
    """
    model = HeliModel(vehicle, stated(flight, vehicle))
    records = [record_of(run) for run in flight.runs]
    candidates = namable((), vehicle, flight)
    problem = Problem.of(model, records, candidates, settings, progress)
    fit = start(problem, starting_noise(flight, vibration.without(vehicle)))
    fit, _ = search(problem, noise_fitted(problem, fitted(problem, fit)))
    return problem, fitted(problem, fit, settings.most_steps, settings.refinement_gain)


@dataclass(frozen=True)
class Before:
    """The log before under its model, and what every number would change of its innovations.

    Attributes:
        problem, fit: of that log.
        innovations: per record, (n, m) whitened.
        there: per record, (n, m), readings that count: from WARM_UP on, since a filter starts from the
            first readings as they are, biased or not.
        known: effect -> its coordinates.
        slopes: effect -> derivatives of all innovations in them, (readings, coordinates).
        later: moment -> the same from that moment on, as far as it was asked for.
    """

    problem: Problem
    fit: Fit
    innovations: list[np.ndarray]
    there: list[np.ndarray]
    known: Mapping[str, list[Coordinate]]
    slopes: Mapping[str, np.ndarray]
    later: dict[Moment, "Before"] = field(default_factory=dict, repr=False, compare=False)

    @classmethod
    def of(cls, problem: Problem, fit: Fit) -> "Before":
        """From a fit, by one filter pass per number.

        Args:
            problem, fit: `fitted_model`, or of any diagnosis.
        """
        known: dict[str, list[Coordinate]] = {}
        for c in coordinates(problem, fit):
            known.setdefault(c.effect, []).append(c)
        passes = problem.engine.filter(fit.values, fit.noise)
        here = [run.innovations for run in passes]
        there = [
            np.isfinite(run.innovations) & (run.record.t - run.record.t[0] >= WARM_UP)[:, None]
            for run in passes
        ]
        own = Logs(problem.engine, fit, here, there)
        problem.report(f"what {sum(map(len, known.values()))} numbers change of the innovations")
        slopes = {e: own.slopes(fit.values, coordinates) for e, coordinates in known.items()}
        return cls(problem, fit, here, there, known, slopes)

    def since(self, moment: Moment) -> "Before":
        """Of numbers that change at a moment of the flight, not in all of it; remembered.

        Args:
            moment: its run may be one that was cut into parts.
        """
        if moment not in self.later:
            self.later[moment] = self._since(moment)
        return self.later[moment]

    def _since(self, moment: Moment) -> "Before":
        clock = clock_of(self.problem.engine.records)
        known = [e for e in self.known if e != ROTOR_SPEED]
        model = ChangingModel(self.problem.model, dict.fromkeys(known, moment), clock)
        was = {
            of_part(name, BEFORE): self.fit.values.get(name, p.off)
            for e in known
            for name, p in zip(
                effects.CATALOGUE[e].names(), effects.CATALOGUE[e].parameters, strict=True
            )
        }
        problem, fit = self.problem.with_model(model), self.fit.at(was)
        there = [
            mask & (model.stretches(record) == 0.0)[:, None]
            for mask, record in zip(self.there, problem.engine.records, strict=True)
        ]
        own = Logs(problem.engine, fit, self.innovations, there)
        slopes = {e: own.slopes(fit.values, group) for e, group in self.known.items()}
        return replace(self, problem=problem, fit=fit, there=there, slopes=slopes, later={})
