"""The usual ways, on the same flights: regression of the residual wrench on the catalogue's effects.

Reconstruct the states with the bare model's filter; take force from the accelerometers and moment
from the smoothed gyros' derivative; what the bare model lacks of them is the residual wrench, scaled
per axis by its own scatter. Each effect's regressors are the wrench's change per usual size along the
same states (for lags: with the commands lagged by the usual size). Then:

- stepwise regression, forward with backward elimination, by partial F or by BIC (Klein and Morelli
  2006, ch. 5), whole effects at a time, an intercept per axis always in;
- sparse regression: PySINDy's STLSQ (Brunton, Proctor and Kutz 2016).

As with the package, what is too small to matter in prediction is not named.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.signal import lfilter, savgol_filter

from coax_env.diagnosis.settings import SETTINGS
from coax_env.estimation.engine import Engine
from coax_env.estimation.helicopter import HeliModel, record_of
from coax_env.estimation.helicopter_noise import fitted_levels, starting_noise
from coax_env.estimation.noise_levels import fit_noise
from coax_env.estimation.run_passes import RunPass
from coax_env.estimation.state_space import FreeParameter
from coax_env.kernel.compilation import compiled
from coax_env.logs.flight import Flight
from coax_env.model import workspace as F
from coax_env.model.dynamics import measure
from coax_env.model.effects import CATALOGUE
from coax_env.model.layout import (
    CHANNELS,
    FLYBAR,
    GUST_FORCE,
    LOWER_FLAP,
    N_FULL,
    RATE,
    ROTOR_SPEED,
    SWASH,
)
from coax_env.model.vehicle_file import load_vehicle
from study.judge import tied

SETTLING = 1.0  # s of each run that the filter needs
SMOOTHING = 15  # rows of the Savitzky-Golay filter that differentiates the gyros
SPARSE_THRESHOLD = 0.2  # usual sizes
RIDGE = 0.05  # PySINDy's own
AXES = 6
GYROS = [CHANNELS.index(c) for c in ("p", "q", "r")]
ACCELEROMETERS = [CHANNELS.index(c) for c in ("ax", "ay", "az")]
LAGS = {"motor_lag.upper": (0,), "motor_lag.lower": (1,), "servo_lag.time": (2, 3)}
"""Commands that a first-order lag delays."""
Lag = Callable[[np.ndarray], np.ndarray]


def name_causes(flight: Flight) -> dict[str, dict[str, Any]]:
    """What each baseline names on a flight: {"F > 4": {"causes": [{"effect": ...}]}, ...}."""
    X, y, groups = regression(flight)
    gram = Gram(X, y, always=AXES)
    found: dict[str, list[str] | None] = {
        "F > 4": stepwise(gram, groups, by_f(4.0)),
        "F > 20": stepwise(gram, groups, by_f(20.0)),
        "BIC": stepwise(gram, groups, by_bic),
        "STLSQ": sparse(gram, groups),
    }
    visible = [e for e, columns in groups.items() if gram.spread(columns) > 0.0]
    result: dict[str, dict[str, Any]] = {}
    for method, names in found.items():
        if names is not None:
            result[method] = {"causes": [{"effect": e} for e in untied(names)], "visible": visible}
    return result


def untied(names: Sequence[str]) -> list[str]:
    """The names with the first of every tie group alone: naming both is no error either."""
    return [n for i, n in enumerate(names) if not any(tied(n, other) for other in names[:i])]


# --- the regression problem --------------------------------------------------------------------------


def regression(flight: Flight) -> tuple[np.ndarray, np.ndarray, dict[str, list[int]]]:
    """Regressors (6n, k) in usual sizes, intercepts first; residual wrench (6n,); effect -> columns."""
    vehicle = load_vehicle(flight.vehicle).in_air(flight.air)
    model = HeliModel(vehicle)
    engine = Engine(model, [record_of(run) for run in flight.runs])
    noise = starting_noise(flight, vehicle)
    bare = model.bare_values
    noise = fit_noise(
        engine, bare, noise, fitted_levels(noise), SETTINGS.first_noise_evaluations,
        tolerance=SETTINGS.step_gain, seconds=SETTINGS.noise_fit_seconds,
    )  # fmt: skip
    passes = engine.filter(bare, noise)
    free = [f for effect in CATALOGUE for f in model.effect_parameters(effect)]
    blocks, targets = [], []
    for run in passes:
        columns = [_regressor(model, run, bare, f) for f in free]
        kept = _usable(run)
        measured = _measured(run)
        blocks.append(np.stack(columns, axis=-1)[kept])
        targets.append((measured - wrench(model, run, bare))[kept])
    X, y = np.concatenate(blocks), np.concatenate(targets)
    scatter = 1.4826 * np.median(np.abs(y - np.median(y, axis=0)), axis=0)
    X, y = X / scatter[:, None], y / scatter
    intercepts = np.tile(np.eye(AXES), (len(y), 1))
    names = [f.name.partition(".")[0] for f in free]
    groups = {
        e: [AXES + i for i, name in enumerate(names) if name == e] for e in dict.fromkeys(names)
    }
    return np.hstack([intercepts, X.reshape(-1, len(free))]), y.ravel(), groups


@compiled()
def _along(
    places: np.ndarray,
    x: np.ndarray,
    u: np.ndarray,
    p: np.ndarray,
    work: np.ndarray,
    out: np.ndarray,
    readings: np.ndarray,
) -> None:
    """What stands at `places` of the workspace, at states (n, 26) and inputs (n, 5), into `out`."""
    for k in range(len(x)):
        measure(x[k], u[k], p, work, readings)
        for i in range(places.size):
            out[k, i] = work[places[i]]


_SLOPES = F.N_FLOW + N_FULL  # where `measure` leaves the rates of the states
_PLACES = np.array(
    [F.READING + i for i in ACCELEROMETERS]
    + [F.P_DOT, F.Q_DOT, F.R_DOT]
    + [_SLOPES + i for i in range(LOWER_FLAP.start, FLYBAR.stop)],
    dtype=np.int64,
)


def along(
    model: HeliModel, run: RunPass, values: dict[str, float], moved: Lag | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Wrench (n, 6) and the rates of the four flap angles (n, 4) along a run, gusts off.

    Args:
        model: of the helicopter. run: the filter's pass over it, n rows.
        values: of the model's parameters. moved: changes the commands (n, 5), as a lag does.
    """
    p = model.vector(values)
    u = model.inputs(run.record, p)
    if moved is not None:
        u = moved(u)
    x = run.states.copy()
    x[:, ROTOR_SPEED], x[:, SWASH] = u[:, 0:2], u[:, 2:4]
    x[:, GUST_FORCE.start :] = 0.0
    out = np.empty((len(x), _PLACES.size))
    _along(_PLACES, x, u, p, np.zeros(model.work_size), out, np.empty(len(CHANNELS)))
    return out[:, :AXES], out[:, AXES:]


def wrench(
    model: HeliModel,
    run: RunPass,
    values: dict[str, float],
    moved: Lag | None = None,
    flaps: np.ndarray | None = None,
) -> np.ndarray:
    """The model's specific force [m/s2] and angular acceleration [rad/s2] along a run, (n, 6).

    Args:
        model, run, values, moved: as of `along`.
        flaps: (n, 4) rates of the flap angles of the bare model [rad/s]. What differs from them is
            followed with the flaps' own lags, since the reconstructed angles are the bare model's.
    """
    acting, rates = along(model, run, values, moved)
    if flaps is None or np.allclose(rates, flaps, rtol=0.0, atol=1e-12):
        return acting
    dt = _median_step(run)
    lags = [values["flap_time_constant"]] * 2 + [values["flybar_time_constant"]] * 2
    keep = [float(np.exp(-dt / lag)) for lag in lags]
    shift = [
        lfilter([0.0, lag * (1.0 - k)], [1.0, -k], column)
        for lag, k, column in zip(lags, keep, (rates - flaps).T, strict=True)
    ]
    states = run.states.copy()
    states[:, LOWER_FLAP.start : FLYBAR.stop] += np.column_stack(shift)
    return along(model, replace(run, states=states), values, moved)[0]


def _regressor(
    model: HeliModel, run: RunPass, bare: dict[str, float], parameter: FreeParameter
) -> np.ndarray:
    """Change of the wrench (n, 6) per usual size of a parameter; 1 is the usual size."""
    name, size = parameter.name, parameter.std
    now, flaps = along(model, run, bare)
    if name in LAGS:

        def late(u: np.ndarray) -> np.ndarray:
            u = u.copy()
            keep = float(np.exp(-_median_step(run) / size))
            for i in LAGS[name]:
                u[:, i] = lfilter([1.0 - keep], [1.0, -keep], u[:, i], zi=[keep * u[0, i]])[0]
            return u

        return wrench(model, run, bare, late, flaps) - now
    if name == "servo_delay.time":
        return wrench(model, run, {**bare, name: size}, None, flaps) - now
    if name.startswith("wind."):  # acts through a drag: the usual one
        bare = {**bare, "rotor_drag.coefficient": 4e-4}
        now, flaps = along(model, run, bare)
    step = 0.1
    moved = {**bare, name: parameter.value + step * size}
    return (wrench(model, run, moved, None, flaps) - now) / step


def _median_step(run: RunPass) -> float:
    return float(np.median(np.diff(run.record.t)))


def _measured(run: RunPass) -> np.ndarray:
    """Accelerometers, and the derivative of the gyros smoothed by a local cubic, (n, 6)."""
    z, dt = run.record.z, _median_step(run)
    gyros = np.where(np.isfinite(z[:, GYROS]), z[:, GYROS], run.states[:, RATE])
    turning = savgol_filter(gyros, SMOOTHING, 3, deriv=1, delta=dt, axis=0)
    return np.hstack([z[:, ACCELEROMETERS], turning])


def _usable(run: RunPass) -> np.ndarray:
    z, t = run.record.z, run.record.t
    return np.isfinite(z[:, ACCELEROMETERS]).all(1) & (t > t[0] + SETTLING)


# --- picking -----------------------------------------------------------------------------------------


class Gram:
    """Normal equations of y = X b, from which any subset is solved at once.

    always: number of leading columns that every fit has.
    """

    def __init__(self, X: np.ndarray, y: np.ndarray, always: int = 0) -> None:
        self.XX, self.Xy, self.yy = X.T @ X, X.T @ y, float(y @ y)
        self.n = len(y)
        self.always = list(range(always))

    def spread(self, columns: Sequence[int]) -> float:
        """Sum of squares of some columns."""
        return float(self.XX[columns, columns].sum())

    def fit(self, columns: Sequence[int]) -> tuple[np.ndarray, float]:
        """Coefficients of these columns beside those always in, and the residual sum of squares."""
        kept = self.always + list(columns)
        A, b = self.XX[np.ix_(kept, kept)], self.Xy[kept]
        solution = np.linalg.lstsq(A, b, rcond=1e-10)[0]
        left = max(self.yy - float(b @ solution), 1e-12 * self.yy)
        return solution[len(self.always) :], left


Rule = Callable[[int, float, float, int, int], float]
"""(rows, residual sums of squares without and with, columns of the effect, columns in all): positive
where the effect earns its place."""


def by_f(least: float) -> Rule:
    """Partial F above a bound."""

    def rule(n: int, without: float, with_it: float, own: int, columns: int) -> float:
        return (without - with_it) / own / (with_it / (n - columns)) - least

    return rule


def by_bic(n: int, without: float, with_it: float, own: int, columns: int) -> float:
    """Fall of the Bayesian information criterion [twice a nat].

    Args:
        n: rows. without, with_it: residual sums of squares.
        own: columns of the effect. columns: in all (no part of this criterion).
    """
    return n * float(np.log(without / with_it)) - own * float(np.log(n))


def stepwise(gram: Gram, groups: dict[str, list[int]], rule: Rule) -> list[str]:
    """Effects in after forward steps, each followed by backward ones.

    Args:
        gram: the regression. groups: columns of each effect, which come and go together.
        rule: says what an effect must earn.
    """
    chosen: list[str] = []

    def columns(names: Sequence[str]) -> list[int]:
        return [c for name in names for c in groups[name]]

    def merit(name: str, others: Sequence[str]) -> float:
        _, without = gram.fit(columns(others))
        _, with_it = gram.fit(columns([*others, name]))
        own = len(groups[name])
        total = len(gram.always) + len(columns(others)) + own
        return rule(gram.n, without, with_it, own, total)

    visible = [name for name, own in groups.items() if gram.spread(own) > 0.0]
    for _ in range(2 * len(visible)):
        gains = {name: merit(name, chosen) for name in visible if name not in chosen}
        best = max(gains, key=lambda name: gains[name], default=None)
        if best is None or gains[best] <= 0.0:
            break
        chosen.append(best)
        while len(chosen) > 1:
            worth = {n: merit(n, [o for o in chosen if o != n]) for n in chosen}
            worst = min(worth, key=lambda name: worth[name])
            if worth[worst] > 0.0:
                break
            chosen.remove(worst)
        if best not in chosen:  # in and out again: it would go round for ever
            break
    coefficients, _ = gram.fit(columns(chosen))
    sizes = dict(zip(columns(chosen), coefficients, strict=True))
    return [name for name in chosen if _is_large(name, [sizes[c] for c in groups[name]])]


def sparse(gram: Gram, groups: dict[str, list[int]]) -> list[str] | None:
    """Effects that sequentially thresholded least squares keeps; None without PySINDy.

    The triangular factor of the normal equations stands for the rows: the same problem, far smaller.
    """
    try:
        from pysindy import STLSQ
    except ImportError:
        return None
    lead = gram.always
    own = [c for columns in groups.values() for c in columns if gram.XX[c, c] > 0.0]
    project = np.linalg.solve(gram.XX[np.ix_(lead, lead)], gram.XX[np.ix_(lead, own)])
    XX = gram.XX[np.ix_(own, own)] - gram.XX[np.ix_(own, lead)] @ project
    Xy = gram.Xy[own] - project.T @ gram.Xy[lead]
    scale = float(np.trace(XX)) / len(own)
    values, vectors = np.linalg.eigh(XX / scale)
    kept = values > 1e-10
    rows = np.sqrt(values[kept])[:, None] * vectors[:, kept].T
    target = (vectors[:, kept].T @ Xy / scale) / np.sqrt(values[kept])
    optimizer = STLSQ(threshold=SPARSE_THRESHOLD, alpha=RIDGE / scale)
    optimizer.fit(rows, target[:, None])
    sizes = dict(zip(own, np.ravel(optimizer.coef_), strict=True))
    return [
        name
        for name, columns in groups.items()
        if _is_large(name, [sizes.get(c, 0.0) for c in columns])
    ]


def _is_large(effect: str, sizes: Sequence[float]) -> bool:
    """Whether any parameter, in usual sizes, matters in prediction."""
    parameters = CATALOGUE[effect].parameters
    return any(
        p.smallest > 0.0 and abs(size) * p.usual >= p.smallest
        for p, size in zip(parameters, sizes, strict=True)
    )
