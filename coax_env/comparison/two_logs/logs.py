"""Two logs of one flight under one model: the difference of their whitened innovations."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from coax_env.comparison.two_logs.coordinates import ROTOR_SCALE, Coordinate, moved
from coax_env.diagnosis.problem import Fit
from coax_env.estimation.changing_model import ChangingModel
from coax_env.estimation.engine import Engine
from coax_env.estimation.helicopter import ROTORS
from coax_env.estimation.linearised_runs import BLOCK
from coax_env.model.layout import N_COMMANDS


@dataclass(frozen=True)
class Logs:
    """Two logs under one model: innovations of the one before, an engine over the one after.

    there: per record, (n, m), readings that both have.
    """

    engine: Engine
    fit: Fit
    before: list[np.ndarray]
    there: list[np.ndarray]

    def difference(self, values: Mapping[str, float]) -> np.ndarray:
        """Whitened innovations (k,) of the log after at these values, less those of the one before."""
        faster = 1.0 + values.get(ROTOR_SCALE, 0.0)
        engine = self.engine if faster == 1.0 else with_rotors(self.engine, faster)
        own = {name: value for name, value in values.items() if name != ROTOR_SCALE}
        passes = engine.filter(own, self.fit.noise)
        parts = [
            (run.innovations - before)[there]
            for run, before, there in zip(passes, self.before, self.there, strict=True)
        ]
        return np.nan_to_num(np.concatenate(parts), nan=0.0, posinf=0.0, neginf=0.0)

    @property
    def block(self) -> np.ndarray:
        """Number of the block of BLOCK seconds of every reading that is there, (k,)."""
        found, end = [], 0
        for record, there in zip(self.engine.records, self.there, strict=True):
            own = ((record.t - record.t[0]) / BLOCK).astype(np.int64)[np.nonzero(there)[0]]
            found.append(own + end)
            end += int(own.max(initial=-1)) + 1
        return np.concatenate(found)

    def slopes(self, at: Mapping[str, float], of: Sequence[Coordinate]) -> np.ndarray:
        """Derivatives (k, coordinates) of the difference about values `at`."""
        here = self.difference(at)
        columns = [(self.difference(moved(at, {c.name: c.step})) - here) / c.step for c in of]
        return np.column_stack(columns) if columns else np.zeros((here.size, 0))


def with_rotors(engine: Engine, factor: float) -> Engine:
    """Over the same records, their rotor commands times a factor; from the model's moment on."""
    times = np.ones(N_COMMANDS)
    times[list(ROTORS)] = factor
    model, records = engine.model, []
    for record in engine.records:
        late = np.ones(record.t.size, bool)
        if isinstance(model, ChangingModel):
            late = model.stretches(record) == 0.0
        command = np.where(late[:, None], record.command * times, record.command)
        records.append(replace(record, command=command))
    return Engine(model, records, engine.threads)
