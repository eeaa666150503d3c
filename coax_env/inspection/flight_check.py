"""What a flight folder contains, what is wrong with it, and what can be learned from it.

Data flow::

    flight -> runs and channels: rates, gaps, frozen and saturated sensors, what was mended
           -> units and signs, by what must hold of two channels, and of hover
           -> one linearisation along the records with the vehicle as given (estimation/fit.py)
                  -> effects that would show, pairs that no fit could part, own numbers it narrows
           -> the next step, as a command
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from coax_env.design.next_maneuver import logged_rates
from coax_env.diagnosis import vibration
from coax_env.diagnosis.diagnose import namable
from coax_env.diagnosis.search import EVIDENCE, TIE, Search
from coax_env.estimation.fit import Engine
from coax_env.estimation.helicopter import HeliModel, record_of, sensor_std, starting_noise
from coax_env.estimation.quadratic import Quadratic
from coax_env.identification.identify import left_open
from coax_env.logs.flight import Flight, Run, read_flight
from coax_env.logs.repairs import GAP
from coax_env.logs.units import LOG_UNITS, ROTOR_COMMANDS, unit_that_makes
from coax_env.model import effects
from coax_env.model.dynamics import hover_trim
from coax_env.model.layout import ANGLES, CHANNEL_UNITS, CHANNELS, RPM_PER_RAD_S
from coax_env.model.vehicle import Vehicle
from coax_env.model.vehicle_file import load_vehicle

SURE = 2.0
"""Times EVIDENCE that an effect of usual size must be worth to be expected to show."""
ALIKE = 0.95
"""Correlation above which two channels are one quantity and its rate, whatever their units."""
WINDOW = 1.0  # s
FEWEST_WINDOWS = 12
RIGHT = (0.7, 1.4)
"""Ratios that are taken for 1."""
FROZEN = 1.0  # s
SATURATED = 0.005
"""Share of the readings that may stand at one extreme value."""
NOT_BELIEVED = 0.02
"""Share of readings that no filter of this vehicle believes, above which something is wrong."""
NOTHING = 1e-6
"""Information below this, in units of usual sizes, is rounding."""
RATE_OF = (
    ("phi", "p", 1.0), ("theta", "q", 1.0), ("psi", "r", 1.0),
    ("h", "vd", -1.0), ("pn", "vn", 1.0), ("pe", "ve", 1.0),
)  # fmt: skip
"""Channel, the one that is its rate near hover, and the sign between them."""
MOST = {"phi": 1.6, "theta": 1.6, "p": 15.0, "q": 15.0, "r": 15.0}
"""What a helicopter that flies on stays under [rad, rad/s]; degrees do not."""
Progress = Callable[[str], None]


@dataclass(frozen=True)
class RunCheck:
    """One run. rate: rows a second. gaps: longer than GAP without a row."""

    name: str
    seconds: float
    rows: int
    rate: float
    gaps: int
    channels: tuple[str, ...]


@dataclass(frozen=True)
class ChannelCheck:
    """One channel over the runs that have it.

    rate: readings a second. std: of its noise, the card's or from its scatter. longest_gap: s without
    a reading. frozen: longest time with one and the same reading [s], 0 where that is nothing unusual.
    saturated: readings at one extreme value.
    """

    channel: str
    unit: str
    runs: int
    rate: float
    std: float
    longest_gap: float
    frozen: float
    saturated: int


@dataclass(frozen=True)
class EffectCheck:
    """What these flights would tell of an effect, were it there at its usual size.

    nats: expected evidence. std, usual: by parameter, expected std where it is the only effect, and
    the usual size. verdict: "shows", "may show" or "hidden". run: that shows it best. alike: effects
    that would do in its place.
    """

    effect: str
    nats: float
    std: Mapping[str, float]
    usual: Mapping[str, float]
    unit: Mapping[str, str]
    verdict: str
    run: str
    alike: tuple[str, ...]


@dataclass(frozen=True)
class OwnNumber:
    """A base parameter: std in the vehicle file, and expected after a fit to these flights."""

    name: str
    unit: str
    std_before: float
    std_after: float


@dataclass(frozen=True)
class FlightCheck:
    """Result of `check_flight`.

    missing: channels that no run has. mended: what was done to the data while reading. suspicions: of
    units, signs and sensors, in words. effects: of the catalogue, best shown first. undetermined:
    base parameters that these flights leave open, `directions` along what. not_believed: share of
    readings that the filter left out. next_step: in words, with a command.
    """

    flight: str
    vehicle: str
    runs: tuple[RunCheck, ...]
    channels: tuple[ChannelCheck, ...]
    missing: tuple[str, ...]
    mended: tuple[str, ...]
    unread: tuple[str, ...]
    suspicions: tuple[str, ...]
    effects: tuple[EffectCheck, ...]
    own_numbers: tuple[OwnNumber, ...]
    undetermined: tuple[str, ...]
    directions: tuple[str, ...]
    not_believed: float
    next_step: str

    def as_json(self) -> dict[str, Any]:
        """As check.json has it: a number that is not finite is null."""
        return _finite(asdict(self))


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(content) for key, content in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(content) for content in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def check_flight(
    flight: Flight | str | Path,
    vehicle: Vehicle | str | Path | None = None,
    progress: Progress | None = None,
) -> FlightCheck:
    """Look through a flight before anything is fitted to it.

    Args:
        flight: a Flight or its folder. vehicle: a Vehicle, name or path; default the card's.

    Raises:
        InputError: the flight or the vehicle cannot be read; the message says what to do.
    """

    def say(text: str) -> None:
        if progress:
            progress(text)

    flight = flight if isinstance(flight, Flight) else read_flight(flight)
    label = str(flight.vehicle if vehicle is None else getattr(vehicle, "name", vehicle))
    vehicle = load_vehicle(vehicle or flight.vehicle).in_air(flight.air)
    channels = _channels(flight)
    suspicions = [*_suspicions(flight, vehicle), *_sick(channels)]
    say("linearising along the records")
    shown, own, undetermined, directions, doubted = _learnable(flight, vehicle)
    if doubted > NOT_BELIEVED and not suspicions:
        suspicions.append(
            f"{100 * doubted:.0f} % of the readings are too far from what {label} would read to be"
            " believed: is it this vehicle, and are its signs and units those of the contract?"
        )
    where = str(flight.path or "FLIGHT")
    return FlightCheck(
        flight=where,
        vehicle=label,
        runs=tuple(_run(run) for run in flight.runs),
        channels=channels,
        missing=tuple(c for c in CHANNELS if c not in flight.channels),
        mended=flight.notes,
        unread=flight.unread,
        suspicions=tuple(suspicions),
        effects=shown,
        own_numbers=own,
        undetermined=undetermined,
        directions=directions,
        not_believed=doubted,
        next_step=_next_step(where, label, bool(suspicions), shown),
    )


# --- what is there ----------------------------------------------------------------------------------


def _run(run: Run) -> RunCheck:
    steps = np.diff(run.t)
    return RunCheck(
        run.name, run.duration, run.t.size, (run.t.size - 1) / run.duration,
        int(np.count_nonzero(steps > GAP)), tuple(run.measured),
    )  # fmt: skip


def _channels(flight: Flight) -> tuple[ChannelCheck, ...]:
    rates = logged_rates(flight)
    return tuple(_channel(flight, c, rates[c]) for c in flight.channels)


def _channel(flight: Flight, channel: str, rate: float) -> ChannelCheck:
    runs = [run for run in flight.runs if channel in run.measured]
    std = sensor_std(flight, channel)
    gap = frozen = 0.0
    everything = []
    for run in runs:
        values = run.measured[channel]
        given = np.isfinite(values)
        t, y = run.t[given], values[given]
        if y.size:
            gap = max(gap, float(np.diff(np.concatenate([run.t[:1], t, run.t[-1:]])).max()))
            frozen = max(frozen, _longest_constant(t, y))
            everything.append(y)
        else:
            gap = max(gap, run.duration)
    y = np.concatenate(everything) if everything else np.empty(0)
    return ChannelCheck(
        channel, CHANNEL_UNITS[channel], len(runs), rate, std, gap,
        frozen if frozen > FROZEN and std > 0.0 else 0.0, _saturated(y),
    )  # fmt: skip


def _longest_constant(t: np.ndarray, y: np.ndarray) -> float:
    """Longest time [s] through which a reading does not change at all."""
    changes = np.flatnonzero(np.diff(y) != 0.0)
    starts = np.concatenate([[0], changes + 1])
    ends = np.concatenate([changes, [y.size - 1]])
    return float((t[ends] - t[starts]).max())


def _saturated(y: np.ndarray) -> int:
    """Readings at the greatest or the least value, where these are too many for chance."""
    if np.unique(y).size < 50:  # a coarse sensor meets any of its values often
        return 0
    counts = [int(np.count_nonzero(y == extreme)) for extreme in (y.max(), y.min())]
    return max((c for c in counts if c > max(5.0, SATURATED * y.size)), default=0)


def _sick(channels: Sequence[ChannelCheck]) -> list[str]:
    """Sensors that stood still or at their limit, in words."""
    told = [
        f"{c.channel} reads one and the same value for {c.frozen:.1f} s: a frozen sensor? leave its"
        " cells empty there"
        for c in channels
        if c.frozen
    ]
    return told + [
        f"{c.channel} stands at its extreme value in {c.saturated} readings: saturated? leave those"
        " cells empty"
        for c in channels
        if c.saturated
    ]


# --- units and signs --------------------------------------------------------------------------------


def _suspicions(flight: Flight, vehicle: Vehicle) -> list[str]:
    if not flight.channels:
        unread = f" (not read: {', '.join(flight.unread)})" if flight.unread else ""
        return [f"no sensor in it{unread}: name the columns of the sensors under [columns]"]
    told = _rotor_speeds(flight, vehicle) + _weight(flight, vehicle) + _sizes(flight)
    for channel, rate, sign in RATE_OF:
        slope = _slope(flight, channel, rate)
        if slope is None or RIGHT[0] < sign * slope < RIGHT[1]:
            continue
        said = (
            f"{channel} and {rate} disagree: {channel} moves {sign * slope:+.3g} times as much as"
        )
        said += f" {rate} says"
        if RIGHT[0] < -sign * slope < RIGHT[1]:
            told.append(f"{said}: one axis is turned, give one of them scale = -1 under [columns]")
        else:
            told.append(f"{said}: look at the units of both under [columns]")
    return told


def _slope(flight: Flight, channel: str, rate: str) -> float | None:
    """How far a channel moves per unit of what its rate adds up to; None where it cannot be told."""
    moved, summed = [], []
    for run in flight.runs:
        if channel not in run.measured or rate not in run.measured:
            continue
        edges = np.arange(run.t[0], run.t[-1], WINDOW)
        at = _interpolated(run, channel, edges)
        fine = np.arange(run.t[0], run.t[-1], 0.01)
        total = np.interp(edges, fine, np.cumsum(_interpolated(run, rate, fine)) * 0.01)
        moved.append(np.diff(at))
        summed.append(np.diff(total))
    if not moved:
        return None
    x, y = np.concatenate(summed), np.concatenate(moved)
    if x.size < FEWEST_WINDOWS or min(x.std(), y.std()) == 0.0:
        return None
    # with a bias of the rate, not of its changes
    correlation = float(np.corrcoef(x, y)[0, 1])
    return (
        math.copysign(float(y.std() / x.std()), correlation) if abs(correlation) > ALIKE else None
    )


def _interpolated(run: Run, channel: str, times: np.ndarray) -> np.ndarray:
    given = np.isfinite(run.measured[channel])
    values = run.measured[channel][given]
    if channel in ANGLES:
        values = np.unwrap(values)
    return np.interp(times, run.t[given], values) if values.size else np.zeros(times.size)


def _rotor_speeds(flight: Flight, vehicle: Vehicle) -> list[str]:
    """Whether the rotors turn about as fast as in hover."""
    told = []
    trim = hover_trim(vehicle)[1] * RPM_PER_RAD_S
    for k, channel in enumerate(ROTOR_COMMANDS):
        usual = RPM_PER_RAD_S * float(
            np.median(np.concatenate([r.command[:, k] for r in flight.runs]))
        )
        if usual <= 0.0:
            told.append(f"{channel} is 0 most of the time: nothing flies")
        elif not 0.6 < usual / trim[k] < 1.6:
            told.append(
                f"{channel} is {usual:.4g} rev/min most of the time, and {vehicle.name} hovers at"
                f" {trim[k]:.4g}{_perhaps(channel, usual, trim[k])}"
            )
    return told


def _weight(flight: Flight, vehicle: Vehicle) -> list[str]:
    """Whether the accelerometer that points down reads -g."""
    values = _all(flight, "az")
    if values.size == 0:
        return []
    usual, g = float(np.median(values)), vehicle["gravity"].value
    if RIGHT[0] < -usual / g < RIGHT[1]:
        return []
    said = f"az is {usual:.3g} m/s2 most of the time, -{g:.3g} is expected (specific force, z down)"
    if RIGHT[0] < usual / g < RIGHT[1]:
        return [f"{said}: z points up? then y points left, too: scale = -1 for ay, az, q and r"]
    if abs(usual) < 0.2 * g and not (hint := _perhaps("az", usual, -g)):
        return [f"{said}: gravity has been taken out, and is needed"]
    return [said + (hint if abs(usual) < 0.2 * g else _perhaps("az", usual, -g))]


def _sizes(flight: Flight) -> list[str]:
    """Angles and rates that are degrees, and heights that point down."""
    told = []
    for channel, most in MOST.items():
        values = np.abs(_all(flight, channel))
        if values.size and float(np.quantile(values, 0.99)) > most:
            unit = "deg" if LOG_UNITS[channel] == "rad" else "deg/s"
            told.append(
                f"{channel} reaches {np.quantile(values, 0.99):.3g} {LOG_UNITS[channel]}:"
                f' if it is in {unit}, say unit = "{unit}" under [columns]'
            )
    height = _all(flight, "h")
    if height.size and float(np.median(height)) < 0.0:
        told.append(
            f"h is {np.median(height):.3g} m most of the time: it is height, up: scale = -1"
        )
    return told


def _all(flight: Flight, channel: str) -> np.ndarray:
    parts = [run.measured[channel] for run in flight.runs if channel in run.measured]
    values = np.concatenate(parts) if parts else np.empty(0)
    return values[np.isfinite(values)]


def _perhaps(channel: str, found: float, expected: float) -> str:
    unit = unit_that_makes(channel, expected / found, RIGHT)
    return f': in {unit}? say unit = "{unit}" under [columns]' if unit else ""


# --- what can be learned ----------------------------------------------------------------------------


def _learnable(
    flight: Flight, vehicle: Vehicle
) -> tuple[tuple[EffectCheck, ...], tuple[OwnNumber, ...], tuple[str, ...], tuple[str, ...], float]:
    """Effects and own numbers, what stays open, and the share of readings not believed."""
    line = vibration.find(flight)
    calm = vibration.taken_out(flight, line) if line else flight
    model = HeliModel(vibration.without(vehicle) if line else vehicle)
    records = [record_of(run) for run in calm.runs]
    engine = Engine(model, records)
    search = Search(engine, model, namable((), vehicle, flight))
    state = search.begin(starting_noise(calm, model.vehicle))
    passes, lin = engine.linearise(state.values, state.noise, search.all)
    quadratic = Quadratic.of(lin, search.all, state.values)
    by_run = np.einsum("rkk->rk", lin.information)
    readings = sum(int(np.isfinite(r.z).sum()) for r in records)
    doubted = sum(run.deweighted for run in passes) / max(readings, 1)
    if not all(math.isfinite(run.log_likelihood) for run in passes):
        doubted = 1.0
    expected = {e: _nats(search, quadratic, e) for e in search.candidates}
    ties = _ties(search, quadratic, [e for e in expected if expected[e] >= EVIDENCE])
    found = []
    for effect, nats in expected.items():
        own = search.candidate_names(effect)
        known = {f"{effect}.{p.name}": p for p in effects.CATALOGUE[effect].parameters}
        told = by_run[:, quadratic.index(own)] @ [known[n].usual ** 2 for n in own]
        found.append(
            EffectCheck(
                effect,
                nats,
                dict(zip(own, _stds(search, quadratic, effect), strict=True)),
                {n: known[n].usual for n in own},
                {n: known[n].unit for n in own},
                _verdict(nats),
                records[int(np.argmax(told))].name,
                tuple(sorted(ties.get(effect, ()))),
            )
        )
    found.sort(key=lambda e: -e.nats)
    base = search.free([])
    covariance = quadratic.covariance([f.name for f in base])
    after = np.sqrt(np.diag(covariance))
    own_numbers = tuple(
        OwnNumber(f.name, vehicle[f.name].unit, f.std, float(s))
        for f, s in zip(base, after, strict=True)
    )
    return tuple(found), own_numbers, *left_open(base, covariance), doubted


def _verdict(nats: float) -> str:
    return "shows" if nats >= SURE * EVIDENCE else "may show" if nats >= EVIDENCE else "hidden"


def _usual(search: Search, effect: str) -> np.ndarray:
    names = search.candidate_names(effect)
    return np.array([f.std for f in search.by_effect[effect] if f.name in names])


def _nats(search: Search, quadratic: Quadratic, effect: str) -> float:
    """Evidence expected of an effect, every parameter at its usual size, Occam factor deducted."""
    own, rest = search.candidate_names(effect), search.base_names([effect])
    information, _ = quadratic.projected(own, rest)
    worth = 0.5 * float(_usual(search, effect) ** 2 @ np.diag(information))
    return worth - quadratic.occam(own, rest)


def _stds(search: Search, quadratic: Quadratic, effect: str) -> list[float]:
    """Std expected of an effect's parameters, no prior on them; infinite where nothing is told."""
    own = search.candidate_names(effect)
    usual = _usual(search, effect)
    information, _ = quadratic.projected(own, search.base_names([effect]))
    shares, vectors = np.linalg.eigh(information * np.outer(usual, usual))
    told = shares > NOTHING
    variance = vectors[:, told] ** 2 @ (1.0 / shares[told])
    variance[(np.abs(vectors[:, ~told]) > NOTHING).any(axis=1)] = np.inf
    return (usual * np.sqrt(variance)).tolist()


def _ties(search: Search, quadratic: Quadratic, shown: Sequence[str]) -> dict[str, set[str]]:
    """Effects of usual size that another one's fit would leave less than TIE nats of."""
    usual = {e: _usual(search, e) for e in shown}

    def left(truth: str, other: str) -> float:
        rest = search.base_names([truth, other]) + search.candidate_names(other)
        information, _ = quadratic.projected(search.candidate_names(truth), rest)
        return 0.5 * float(usual[truth] ** 2 @ np.diag(information))

    found: dict[str, set[str]] = {e: set() for e in shown}
    for a, b in combinations(shown, 2):
        if min(left(a, b), left(b, a)) < TIE:
            found[a].add(b)
            found[b].add(a)
    return found


# --- what to do -------------------------------------------------------------------------------------


def _next_step(where: str, vehicle: str, suspect: bool, found: Sequence[EffectCheck]) -> str:
    shown = [e.effect for e in found if e.verdict == "shows"]
    hidden = [e.effect for e in found if e.verdict == "hidden"]
    plan = f"scripts/plan_flight.py --vehicle {vehicle} --learn {','.join(hidden[:6])}"
    if suspect:
        return f"mend what is suspicious (card.toml), then scripts/check_flight.py {where} again"
    if not shown:
        return f"these flights tell too little; plan others: {plan}"
    diagnose = f"scripts/diagnose.py {where} --vehicle {vehicle}"
    return f"{diagnose}" + (f"; for what stays hidden, {plan}" if hidden else "")
