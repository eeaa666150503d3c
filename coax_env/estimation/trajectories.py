"""Where a machine was, and where simulations that start from there would have put it: for replay.

The measured path is what the filter makes of the readings with the best model there is; where no
sensor shows the place, it is integrated velocity. Every RESTART seconds each simulation is put onto
it, state and all, and flies on by itself with the recorded commands, in still gusts.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from coax_env.estimation import compiled_model
from coax_env.estimation.engine import Engine
from coax_env.estimation.helicopter import HeliModel, record_of
from coax_env.estimation.helicopter_noise import starting_noise
from coax_env.estimation.run_passes import RunPass
from coax_env.logs.flight import Flight
from coax_env.model.layout import ATTITUDE, CHANNELS, GUST_FORCE, GUST_MOMENT, POSITION
from coax_env.model.vehicle import Vehicle

FRAME = 0.1  # [s] between poses
RESTART = 3.0  # [s] of simulation before it is put onto the measured path again
SETTLED = 1.5  # [s] of filtering before the first frame
MOST_FRAMES = 12_000  # of all runs together; longer flights have fewer a second


@dataclass(frozen=True)
class Trajectory:
    """One run as poses (n, 6): north, east, height [m], roll, pitch, heading [rad], not wrapped.

    t: (n,) time [s]. begins: (n,) whether the simulations are put onto the measured path here.
    simulated: model's name -> poses, NaN from where it ran away to its next start.
    """

    run: str
    t: np.ndarray
    begins: np.ndarray
    measured: np.ndarray
    simulated: Mapping[str, np.ndarray]

    def position_error(self, model: str) -> np.ndarray:
        """Distance of a simulation from the measured path [m], (n,)."""
        return np.linalg.norm(self.simulated[model][:, :3] - self.measured[:, :3], axis=1)

    def error_removed(self) -> np.ndarray:
        """How much smaller the last simulation's position error is than the first's [m], (n,)."""
        first, *others = (np.nan_to_num(self.position_error(model)) for model in self.simulated)
        return first - others[-1] if others else first


def trajectories(
    flight: Flight, estimator: Vehicle, models: Mapping[str, Vehicle], restart: float = RESTART
) -> list[Trajectory]:
    """Every run of a flight, measured and as each of `models` flies it.

    Args:
        flight: the runs.
        estimator: whose model the filter uses, the best there is.
        models: name -> vehicle that is simulated.
        restart: seconds after which each simulation is put onto the measured path again.
    """
    records = [record_of(run) for run in flight.runs]
    model = HeliModel(estimator)
    engine = Engine(model, records)
    noise = starting_noise(flight, estimator)
    passes = engine.filter(model.bare_values, noise)
    seconds = sum(run.duration for run in flight.runs)
    frame = max(FRAME, seconds / MOST_FRAMES)
    flown = {name: HeliModel(vehicle) for name, vehicle in models.items()}
    result = []
    for run, dt in zip(passes, engine.intervals, strict=True):
        rows = _rows(run.record.t, frame)
        since = run.record.t[rows] - run.record.t[rows[0]]
        begins = np.diff(np.floor(since / restart + 1e-6), prepend=-1.0) > 0.0
        result.append(
            Trajectory(
                run.record.name,
                run.record.t[rows],
                begins,
                _poses(run.states[rows]),
                {name: _poses(_flown(m, run, dt, rows, begins)) for name, m in flown.items()},
            )
        )
    return result


def _rows(t: np.ndarray, frame: float) -> np.ndarray:
    """Rows of the frames: the first at or after each multiple of `frame`."""
    first = min(t[0] + SETTLED, t[-1] - frame)
    return np.unique(np.searchsorted(t, np.arange(first, t[-1] + 1e-9, frame) - 1e-9))


def _poses(states: np.ndarray) -> np.ndarray:
    """States (n, nx) as poses (n, 6)."""
    north, east, down = states[:, POSITION].T
    return np.column_stack([north, east, -down, np.unwrap(states[:, ATTITUDE], axis=0)])


def _flown(
    model: HeliModel, run: RunPass, dt: np.ndarray, rows: np.ndarray, begins: np.ndarray
) -> np.ndarray:
    """States (n, nx) of a simulation at each of `rows`, put onto the filter's where it `begins`."""
    p = model.vector(model.bare_values)
    inputs = model.inputs(run.record, p)
    states = np.full((rows.size, run.states.shape[1]), np.nan)
    readings = np.empty((1, len(CHANNELS)))
    target = np.full((1, len(CHANNELS)), -1, np.int64)
    x = np.full((1, run.states.shape[1]), np.nan)
    compiled = compiled_model.CompiledModel.of(model)
    for k, row in enumerate(rows):
        if begins[k]:
            x = run.states[[row]]
            x[:, GUST_FORCE] = 0.0
            x[:, GUST_MOMENT] = 0.0
        elif np.isfinite(x).all():
            target[0, 0] = row
            if not compiled_model.fly_open_loop(
                compiled, dt, inputs, x, p, rows[k - 1 : k], target, readings
            ):  # fmt: skip
                x = np.full_like(x, np.nan)
        states[k] = x[0]
    return states
