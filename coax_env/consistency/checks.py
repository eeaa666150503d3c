"""The checks of a log with itself, and what each that fails has found, in words."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from coax_env.consistency.even_rows import EvenRows
from coax_env.consistency.relations import (
    Coefficient,
    Machine,
    Relation,
    Signals,
    coefficients,
    relations,
)
from coax_env.logs.units import BATTERY, LOG_UNITS, ROTOR_COMMANDS, SWASH_COMMANDS
from coax_env.model.layout import CHANNELS, ROTOR_SPEEDS

# --- when a coefficient speaks, all ours --------------------------------------------------------

LEAST_STRENGTH = 4.0
"""Std from 0 at which a coefficient is seen: its sign..."""
LEAST_CONTRAST = 6.0
"""...if it is so many std from 1..."""
LEAST_SHARE = 0.25
"""...has this partial correlation..."""
LEAST_OPPOSITE = 0.25
"""...and this size: no sign error is small. A machine's own faults turn no sign: a swash plate
with half a
radian of phase still answers 0.88 times."""
LEAST_OPPOSITE_UNFELT = 0.6
"""The same where no accelerometer feels the gusts: a pilot who leans into them leaves less."""
MOST, LEAST = 1.6, 0.25
"""An exact coefficient beyond these is a unit. Filtered attitude makes 0.5 of 1; no unit lies
between."""
LEAST_SHARE_OF_SMALL = LEAST**0.5
"""Partial correlation from which a small coefficient is a unit: noise in what it multiplies makes a
coefficient of 1 small by a factor (attenuation), and the correlation to the root of it at most."""
MOST_OF_A_MACHINE = 6.0
"""The same where only the vehicle says how large it is: a file may be off by a factor."""
CLEAR_OF = 4.0
"""Std by which it is beyond."""

# --- what can be flown, all ours ------------------------------------------------------------------

HOVER_SPEEDS = (0.78, 1.28)
"""Usual speed of a rotor over that in hover: 0.61 to 1.64 of the weight is carried."""
FELT_GRAVITY = (0.7, 1.4)
"""Median of -az over g."""
MOST_SWASH = 0.7
"""Tilt [rad] that no swash plate has, as the 99 % quantile of a run."""
LARGEST = {
    "phi": 1.6, "theta": 1.6, "p": 15.0, "q": 15.0, "r": 35.0,
    "vn": 40.0, "ve": 40.0, "vd": 40.0, "v": 40.0, "ax": 60.0, "ay": 60.0,
}  # fmt: skip
"""What a small helicopter that flies on stays under, as the 99 % quantile, in the channel's unit.
About its rotors' axis it may turn as fast as a gyro of 2,000 deg/s reads: a sound **synthetic** log
had 16.6 rad/s."""
BATTERIES = (2.5, 100.0)  # V
GRAVITIES = (9.7, 9.9)
"""On the ground of this planet [m/s2]."""
DENSITIES = (0.6, 1.5)
"""From 6 km of altitude to a cold day at the sea [kg/m3]."""

PULSES = (800.0, 2200.0)
"""Widths of a servo's pulse [us]."""
RANGED = (*ROTOR_COMMANDS, *SWASH_COMMANDS, *LARGEST, "az", "h", BATTERY)
"""Channels whose readings themselves are asked, in the order in which their faults are told."""


@dataclass(frozen=True)
class Fault:
    """A check that failed.

    Attributes:
        check: its name, by which it can be waived.
        words: what was found.
        channels: that are at odds.
        hint: what to do, where no change of the card's columns would put it right.
    """

    check: str
    words: str
    channels: frozenset[str]
    hint: str = ""


@dataclass(frozen=True)
class Found:
    """What all checks say of a log: `faults`, those `waived`, and all `coefficients` that could be
    formed."""

    faults: tuple[Fault, ...]
    coefficients: tuple[Coefficient, ...]
    waived: tuple[Fault, ...] = ()

    @property
    def badness(self) -> float:
        """How far the log is from agreeing with itself: a fault counts most, then each coefficient."""
        return FAULT_COUNTS * len(self.faults) + sum(_distance(c) for c in self.coefficients)

    def silenced(self, checks: Mapping[str, float]) -> int:
        """How many checks that spoke are silent, or nearly; checks: name -> partial correlation
        then."""
        now = {c.check: c.share for c in self.coefficients}
        return sum(now.get(name, 0.0) < STILL_SPEAKS * abs(share) for name, share in checks.items())


FAULT_COUNTS = 100.0  # in badness; of a coefficient's distance the most is 50
AGREEMENT_COUNTS = 20.0
STILL_SPEAKS = 0.5


def _distance(c: Coefficient) -> float:
    """Squared distance from what is expected, in std and 0.3 of slack, 50 at most; and what it
    leaves open."""
    slack = float(np.hypot(c.std, 0.3))
    if c.exact:
        off = ((c.value - 1.0) / slack) ** 2
    else:
        off = (min(c.value, 0.0) / slack) ** 2 + max(abs(c.value) / 3.0, 1.0) - 1.0
    return min(off, 50.0) + AGREEMENT_COUNTS * (1.0 - _agreement(c))


def names() -> tuple[str, ...]:
    """Names of all checks, by which each can be waived."""
    everything = frozenset((*CHANNELS, *LOG_UNITS))
    pairs = []
    for left in (everything, everything - {"vn", "ve", "vd"}, everything - {"p", "q", "r"}):
        for relation in relations(left, (0, BLANK.size)):
            pairs += [f"{relation.left}-{part}" for part in _parts_of(relation)]
    ranges = [f"{c}-range" for c in RANGED]
    swaps = [f"{a}-{b}-swapped" for a, b in PAIRS]
    return tuple(dict.fromkeys([*pairs, *ranges, *swaps, *AIR_CHECKS, "swash-logged"]))


AIR_CHECKS = ("gravity-range", "density-range")


BLANK = np.zeros(100)
"""A signal in which nothing happens."""


def _parts_of(relation: Relation) -> list[str]:
    signals = dict.fromkeys(relation.channels, BLANK)
    blank = Machine(
        9.81, (1.0, 1.0), (1.0, 1.0), -np.diag([1.0, 2.0, 3.0, 4.0]), np.zeros((4, 2)),
        np.zeros((4, 2)), np.zeros((2, 4)), np.zeros((2, 2)),
    )  # fmt: skip
    return [n for n in relation.parts(signals, blank) if n and not n.startswith(" ")]


class Checker:
    """All checks of one machine's logs; what a change of some channels leaves alone is kept."""

    def __init__(self, rows: EvenRows, machine: Machine, waived: Collection[str] = ()) -> None:
        self.waived = frozenset(waived)
        self.rows = rows
        self.machine = machine
        self.channels = frozenset(rows.signals)
        self._relations = relations(self.channels, rows.edges)
        self._known = [coefficients(one, rows, machine) for one in self._relations]
        self._windows = [tuple({c.window for c in known}) for known in self._known]
        self._ranges = {c: _range_fault(c, rows, machine) for c in RANGED}

    def found(self) -> Found:
        """What the checks say of the log as it is."""
        each = tuple(c for known in self._known for c in known)
        swaps = self._swapped(self.rows, self._known)
        faults = self._faults(self.rows, each, self._ranges)
        return self._without_waived([*faults, *swaps], each)

    def after(
        self, change: Callable[[Signals], Signals], changed: frozenset[str], swaps: bool = False
    ) -> Found:
        """What they say when a change has been made to the signals.

        Args:
            change: of signals.
            changed: channels that it changes.
            swaps: whether pairs that would agree once exchanged are asked too: that takes longest.
        """
        rows = replace(self.rows, signals=change(self.rows.signals))
        known = self._anew(rows, changed)
        each = tuple(c for few in known for c in few)
        beyond = {c: _range_fault(c, rows, self.machine) for c in changed & self._ranges.keys()}
        faults = self._faults(rows, each, self._ranges | beyond)
        if swaps:
            faults += self._swapped(rows, known)
        return self._without_waived(faults, each)

    def _without_waived(self, faults: Sequence[Fault], each: tuple[Coefficient, ...]) -> Found:
        return Found(
            tuple(f for f in faults if f.check not in self.waived),
            each,
            tuple(f for f in faults if f.check in self.waived),
        )

    def _anew(self, rows: EvenRows, changed: frozenset[str]) -> list[list[Coefficient]]:
        """Coefficients of each relation, at the windows at which they were seen best."""
        return [
            coefficients(replace(one, windows=windows or one.windows), rows, self.machine)
            if changed & one.channels
            else known
            for one, known, windows in zip(self._relations, self._known, self._windows, strict=True)
        ]

    def _faults(
        self, rows: EvenRows, each: Sequence[Coefficient], ranges: Mapping[str, Fault | None]
    ) -> list[Fault]:
        felt = {"vn": "ax", "ve": "ay", "pn": "ax", "pe": "ay"}
        faults = [
            fault
            for c in each
            if (fault := _fault_of(c, felt.get(c.left, c.left) in self.channels, rows))
        ]
        return [*faults, *filter(None, ranges.values())]

    def of_runs(self, names: Sequence[str]) -> list[Fault]:
        """Faults of single runs: a file that was written otherwise than the others; names: of the
        runs."""
        found: dict[str, Fault] = {}
        for number, name in enumerate(names):
            rows = self.rows.run(number)
            alone = relations(frozenset(rows.signals), rows.edges)
            each = [c for one in alone for c in coefficients(one, rows, self.machine)]
            against = [c for c in each if _speaks_against_a_run(c)]
            faults = [f for c in against if (f := _fault_of(c, True, rows))]
            ranges = (_range_fault(c, rows, self.machine) for c in RANGED)
            for fault in (*faults, *filter(None, ranges)):
                words = f"in run {name} {fault.words}"
                found.setdefault(fault.check, replace(fault, words=words, hint=HINT_FOR_A_RUN))
        return [fault for check, fault in found.items() if check not in self.waived]

    def _swapped(self, rows: EvenRows, known: Sequence[Sequence[Coefficient]]) -> list[Fault]:
        """Pairs of columns that agree with the rest once they are exchanged, and not before."""
        found = []
        for a, b in PAIRS:
            if not {a, b} <= self.channels:
                continue
            both = frozenset((a, b))
            other = replace(rows, signals=swapped(rows.signals, (a, b)))
            touched = [k for k, one in enumerate(self._relations) if both & one.channels]
            anew = self._anew(other, both)
            as_they_are, exchanged = (
                [c for k in touched for c in some[k] if both & {c.left, c.part}]
                for some in (known, anew)
            )
            before = sum(map(_agreement, as_they_are))
            after = sum(_agreement(c) for c in exchanged if c.strength > SWAP_STRENGTH)
            if after - before > SWAP_GAIN and before < SWAP_LEFT * after:
                words = f"{a} and {b} agree with the other channels only once they are exchanged"
                found.append(Fault(f"{a}-{b}-swapped", words, both))
        return found


HINT_FOR_A_RUN = (
    "the other runs are sound, and [columns] holds for all of them: correct the file of that run, or"
    " leave it out of the card"
)
OF_A_RUN = (8.0, 0.5)
"""Std from 0, and partial correlation, from which on a single run speaks against itself; ours."""


def _speaks_against_a_run(c: Coefficient) -> bool:
    return c.value < 0.0 and c.strength > OF_A_RUN[0] and -c.share > OF_A_RUN[1]


PAIRS = (
    ("p", "q"), ("phi", "theta"), ("ax", "ay"), ("vn", "ve"), ("pn", "pe"),
    ("delta_lon", "delta_lat"), ROTOR_COMMANDS, ROTOR_SPEEDS,
)  # fmt: skip
"""Columns that may have been taken for each other."""
SWAP_GAIN, SWAP_LEFT = 0.7, 0.5
"""Sum of partial correlations that exchanging a pair must gain, and the share of it that may have been
there before; ours."""
SWAP_STRENGTH = 2.0
"""Std from 0 at which a coefficient counts in that sum; ours. Of a few windows it comes by chance: a
sound **synthetic** log of 27 s in still air was refused for its accelerometers, by two of less than one
std; of those that had been exchanged the least was 2.4."""


def swapped(signals: Signals, names: Sequence[str]) -> Signals:
    """Signals with the first for the second, the third for the fourth."""
    if not set(names) <= signals.keys():
        return signals
    other = swapped_names(names)
    return {**signals, **{name: signals[other[name]] for name in names}}


def swapped_names(names: Sequence[str]) -> dict[str, str]:
    """Each name's other one: of the first the second, of the third the fourth."""
    pairs = list(zip(names[::2], names[1::2], strict=True))
    return {**dict(pairs), **{b: a for a, b in pairs}}


def _agreement(c: Coefficient) -> float:
    """Partial correlation where the coefficient is about what is expected, else 0."""
    fits = 0.3 < c.value < 2.0 if c.exact else 0.05 < c.value < MOST_OF_A_MACHINE
    return c.share if fits else 0.0


def _fault_of(c: Coefficient, gusts_felt: bool, rows: EvenRows) -> Fault | None:
    channels = frozenset((c.left, *({c.part} & {*LOG_UNITS})))
    if c.left in ("vn", "ve", "pn", "pe") and c.part in ("phi", "theta", "ax", "ay"):
        channels |= {"psi"}
    if c.part == "rotors":
        channels = frozenset((c.left, *ROTOR_COMMANDS, *ROTOR_SPEEDS))
    measured = f"{c.value:.3g} +- {c.std:.2g}"
    opposite = LEAST_OPPOSITE if gusts_felt else LEAST_OPPOSITE_UNFELT
    if (
        c.value < -opposite
        and c.strength > LEAST_STRENGTH
        and (1.0 - c.value) / c.std > LEAST_CONTRAST
        and -c.share > LEAST_SHARE
    ):
        return Fault(c.check, f"{c.left} goes {measured} times as {c.part} says", channels)
    most = MOST if c.exact else MOST_OF_A_MACHINE
    large = c.value - CLEAR_OF * c.std > most and c.share > LEAST_SHARE
    # a small one is a unit only where no gust, unfelt, and no noise can have made it so
    small = (
        c.exact
        and gusts_felt
        and c.share > LEAST_SHARE_OF_SMALL
        and c.strength > LEAST_STRENGTH  # of a few windows some such share is by chance
        and c.value + CLEAR_OF * c.std < LEAST
    )
    if (large or small) and not _are_at_one_level(c, rows):
        return Fault(c.check, f"{c.left} goes {measured} times as far as {c.part} says", channels)
    return None


def _are_at_one_level(c: Coefficient, rows: EvenRows) -> bool:
    """Whether a rotor turns about as fast as it is told to, however far it follows: no unit does that.

    One of a soft motor, which goes 0.155 times as far about the speed of hover, was refused as though
    it were in rad/s (**synthetic**).
    """
    if c.left not in ROTOR_SPEEDS:
        return False
    turns, told = (float(np.median(_all(rows, name))) for name in (c.left, c.part))
    return 1.0 / MOST < turns / told < MOST if told > 0.0 else False


# --- ranges ---------------------------------------------------------------------------------------


def _range_fault(channel: str, rows: EvenRows, machine: Machine) -> Fault | None:
    """What is said of a channel whose readings nothing that flies has."""
    values = _all(rows, channel)
    if channel in ROTOR_COMMANDS:
        return _speed(channel, values, machine.hover[ROTOR_COMMANDS.index(channel)])
    if channel in SWASH_COMMANDS:
        return _tilt(channel, values)
    if not values.size:
        return None
    if channel in LARGEST:
        return _size(channel, values)
    return {"az": _gravity, "h": _height, BATTERY: _battery}[channel](values, machine)


def _speed(channel: str, values: np.ndarray, hover: float) -> Fault | None:
    usual = float(np.median(values))
    low, high = (share * hover for share in HOVER_SPEEDS)
    if usual <= 0.0:
        words = f"{channel} is 0 most of the time: nothing flies"
    elif not low < usual < high:
        usually = f"{channel} is {usual:.4g} rev/min most of the time"
        words = f"{usually}, and the vehicle hovers at {hover:.4g}"
    else:
        return None
    return Fault(f"{channel}-range", words, frozenset([channel]), _pulse_hint(channel, usual))


def _tilt(channel: str, values: np.ndarray) -> Fault | None:
    most = float(np.quantile(np.abs(values), 0.99))
    if most <= MOST_SWASH:
        return None
    words = f"{channel} reaches {most:.3g} rad, which no swash plate does"
    hint = _pulse_hint(channel, float(np.median(values)))
    return Fault(f"{channel}-range", words, frozenset([channel]), hint)


def _size(channel: str, values: np.ndarray) -> Fault | None:
    most = float(np.quantile(np.abs(values), 0.99))
    if most <= LARGEST[channel]:
        return None
    words = f"{channel} reaches {most:.3g} {LOG_UNITS[channel]}"
    return Fault(f"{channel}-range", words, frozenset([channel]))


def _gravity(felt: np.ndarray, machine: Machine) -> Fault | None:
    usual, g = float(np.median(felt)), machine.gravity
    if FELT_GRAVITY[0] < -usual / g < FELT_GRAVITY[1]:
        return None
    words = (
        f"az is {usual:.3g} m/s2 most of the time, and -{g:.3g} in hover (specific force, z down)"
    )
    hint = "gravity has been taken out of it, and is needed" if abs(usual) < 0.05 * g else ""
    return Fault("az-range", words, frozenset(["az"]), hint)


def _height(height: np.ndarray, machine: Machine) -> Fault | None:
    usual = float(np.median(height))
    if usual >= 0.0:
        return None
    words = f"h is {usual:.3g} m most of the time: it is height, up"
    return Fault("h-range", words, frozenset(["h"]))


def _battery(voltage: np.ndarray, machine: Machine) -> Fault | None:
    usual = float(np.median(voltage))
    if BATTERIES[0] < usual < BATTERIES[1]:
        return None
    words = f"{BATTERY} is {usual:.3g} V most of the time"
    return Fault(f"{BATTERY}-range", words, frozenset([BATTERY]))


def _pulse_hint(channel: str, usual: float) -> str:
    """What to write where a command is the width of a servo's pulse."""
    if not PULSES[0] < abs(usual) < PULSES[1]:
        return ""
    ends = (
        "[1100, 0.0], [1900, 3000.0]" if channel in ROTOR_COMMANDS else "[1000, -0.2], [2000, 0.2]"
    )
    what = "rev/min" if channel in ROTOR_COMMANDS else "rad"
    return (
        f"if these are pulse widths, say what two of them make:"
        f" calibration = [{ends}] (pulse, {what}; your own numbers)"
    )


def _all(rows: EvenRows, channel: str) -> np.ndarray:
    if channel not in rows.signals:
        return np.empty(0)
    found: np.ndarray = rows.signals[channel][rows.known[channel]]
    return found
