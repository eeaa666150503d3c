"""What an effect is, how it enters the catalogue, and its places in the parameter vector.

The effects themselves are in effects.py.
"""

import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from functools import cache
from types import FunctionType
from typing import Any

import numpy as np

from coax_env.errors import InputError
from coax_env.kernel.compilation import BORROWING, name_apart
from coax_env.kernel.numba_internals import njit_for_compiled
from coax_env.model import generic_terms
from coax_env.model import parameters as P
from coax_env.model.layout import CHANNELS

STAGES = ("PROPERTY", "AIR", "SWASH", "ROTOR", "LOAD", "UNLISTED", "SENSOR")
PROPERTY, AIR, SWASH, ROTOR, LOAD, UNLISTED, SENSOR = (P.N_FIXED + i for i in range(len(STAGES)))
SWITCHES = slice(P.N_FIXED, P.N_FIXED + len(STAGES))
"""Places in a parameter vector of the stages' switches: 1 where the stage has an effect, else 0."""

INFINITY = math.inf

GUST_MEMORY = 0.5
"""Correlation time of gusts [s] where nothing else is said: the usual one at this size, ours."""


@dataclass(frozen=True)
class EffectParameter:
    """One parameter of an effect.

    ``usual`` is the usual size and the std of the prior about ``off``; ``smallest`` the size under
    which it does not matter in prediction and is never named; a ``shape`` parameter (a decay, say)
    acts only once the effect itself does; ``timing``: a lag or delay, of commands or readings;
    ``probe``: finite step for the signature where the effect has no slope at its off-value; ``held``:
    is stated, never fitted, and does not act alone.

    Sizes, bounds and probe are lama400d's. ``scale`` says with what of the vehicle they grow on
    another machine, ``"weight * arm / rotor_speed"`` say (usual_sizes.py); empty: they do not.
    """

    name: str
    unit: str
    usual: float
    smallest: float
    off: float = 0.0
    lower: float = -INFINITY
    upper: float = INFINITY
    shape: bool = False
    timing: bool = False
    probe: float = 0.0
    held: bool = False
    scale: str = ""

    def at(self, share: float) -> float:
        """The value so many usual sizes from the off-value, on the side that the bounds leave."""
        step = share * self.usual
        return self.off + step if self.off + step <= self.upper else self.off - step


@dataclass(frozen=True)
class Effect:
    """One group of parameters with the function that acts on them.

    ``replaces`` names base parameters that are the same column. ``input_shift``: acts on the input,
    not in the kernel. ``line``: found by its line in the spectrum (vibration.py), not by a signature.
    ``generic``: unlisted terms, of which a vehicle file holds those that are not zero. ``damps``: its
    one parameter damps the motion, and so changes what a filter makes of gusts. ``named_as``: the
    effect by whose name it is found, where it acts in jumps that no filter can follow. ``users``:
    from a user's file.
    """

    name: str
    stage: int
    parameters: tuple[EffectParameter, ...]
    channels: tuple[str, ...]
    source: str
    summary: str
    function: Any  # compiled
    replaces: tuple[str, ...] = ()
    input_shift: bool = False
    line: bool = False
    generic: bool = False
    damps: bool = False
    named_as: str = ""
    users: bool = False
    index: int = -1

    def names(self) -> tuple[str, ...]:
        """Full names of the parameters, ``effect.parameter``."""
        return tuple(f"{self.name}.{p.name}" for p in self.parameters)

    @property
    def fitted(self) -> tuple[EffectParameter, ...]:
        """The parameters that a fit may move: all that are not held."""
        return tuple(p for p in self.parameters if not p.held)


CATALOGUE: dict[str, Effect] = {}
"""The effects that have a name: what can be found, excluded and listed as a cause."""
GROUPS: dict[str, Effect] = {}
"""Those and the generic groups: everything that a vehicle file and the kernel know."""
_FIRST = P.N_FIXED + len(STAGES)


def effect(
    stage: int,
    *parameters: EffectParameter,
    channels: str,
    source: str,
    replaces: tuple[str, ...] = (),
    input_shift: bool = False,
    line: bool = False,
    generic: bool = False,
    damps: bool = False,
    named_as: str = "",
    name: str = "",
) -> Callable[[Callable], Callable]:
    """Enter a function into the catalogue; its docstring is the effect's summary.

    Args:
        stage: where in the kernel it runs. parameters: in the order of the parameter vector.
        channels: names, with spaces, of those that show it most. source: book or paper, and equation.
        replaces, input_shift, line, generic, damps, named_as: see Effect.
        name: in the catalogue; that of the function where empty.

    Raises:
        InputError: the name is taken, a channel does not exist, or the stage or parameters are none.
    """

    def enter(function: Callable) -> Callable:
        own = name or function.__name__
        if not isinstance(stage, int) or not parameters:
            raise InputError(f"effect {own!r}: @effect(stage, EffectParameter(...), ...) is wanted")
        if own in GROUPS:
            raise InputError(f"the catalogue of effects has {own!r} already")
        if damps and sum(not (p.shape or p.held) for p in parameters) != 1:
            raise InputError(f"effect {own!r}: damps=True is for an effect of one parameter")
        for channel in channels.split():
            if channel not in CHANNELS:
                raise InputError(f"effect {own!r}: no channel {channel!r}")
        own_code = function.__module__.startswith("coax_env.")  # a user's may make arrays
        settings = {**BORROWING, "_nrt": not own_code}
        function_compiled = njit_for_compiled(**settings)(name_apart(function))
        entry = Effect(
            name=own,
            stage=stage,
            parameters=parameters,
            channels=tuple(channels.split()),
            source=source,
            summary=(function.__doc__ or "").strip(),
            function=function_compiled,
            replaces=replaces,
            input_shift=input_shift,
            line=line,
            generic=generic,
            damps=damps,
            named_as=named_as,
            users=not own_code,
            index=n_parameters(),
        )
        GROUPS[own] = entry
        if not generic:
            CATALOGUE[own] = entry
        _forget_tables()
        return function_compiled

    return enter


def found_by_the_name_of(name: str) -> list[str]:
    """Effects that are found by another one's name."""
    return [own for own, entry in CATALOGUE.items() if entry.named_as == name]


def forget(names: Collection[str]) -> None:
    """Take the latest entries out again (a user's file that turned out faulty)."""
    for name in names:
        GROUPS.pop(name)
        CATALOGUE.pop(name, None)
    _forget_tables()


def _forget_tables() -> None:
    """What is looked up in the catalogue is looked up anew."""
    for table in (_offs, _places, _off_vector):
        table.cache_clear()


def n_parameters() -> int:
    """Length of the parameter vector."""
    return _FIRST + sum(len(e.parameters) for e in GROUPS.values())


@cache
def _offs() -> tuple[np.ndarray, np.ndarray]:
    """Off-values of all effects' parameters, (k,), and which switch each one throws, (k, stages)."""
    every = [(p, e.stage) for e in GROUPS.values() for p in e.parameters]
    throws = [
        [not (p.shape or p.held) and stage == switch for switch in range(P.N_FIXED, _FIRST)]
        for p, stage in every
    ]
    return np.array([p.off for p, _ in every]), np.array(throws, dtype=float)


# --- what the kernel and the vehicle files read -----------------------------------------------------


@cache
def _places() -> dict[str, int]:
    """Place of every parameter in the parameter vector, by full name."""
    places = {name: i for i, name in enumerate(P.BASE)}
    places |= {name: P.COMMAND_GAIN + i for i, name in enumerate(P.COMMAND_GAINS)}
    for entry in GROUPS.values():
        places |= {name: entry.index + i for i, name in enumerate(entry.names())}
    return places


def parameter_index(name: str) -> int:
    """Place of ``"mass"`` or ``"ground_effect.gain"`` in the parameter vector."""
    return _places()[name]


def off_vector() -> np.ndarray:
    """Parameter vector with every effect off and the base parameters NaN."""
    return _off_vector().copy()


@cache
def _off_vector() -> np.ndarray:
    vector = np.full(n_parameters(), np.nan)
    vector[P.GUST_MEMORIES] = GUST_MEMORY
    vector[P.AIR_DOWN : P.N_FIXED] = 0.0
    vector[_FIRST:] = _offs()[0]
    set_switches(vector)
    return vector


def pack(values: Mapping[str, float]) -> np.ndarray:
    """The kernel's parameter vector from full names and values; effects not named are off."""
    vector = off_vector()
    places = _places()
    vector[[places[name] for name in values]] = list(values.values())
    for reference, own in P.GUST_REFERENCE.items():
        vector[reference] = vector[own]
    set_switches(vector)
    return vector


def set_switches(vector: np.ndarray) -> None:
    """Switch on, in place, the stages that have an effect away from its off-value.

    Of one parameter vector, or of many at once, shape (..., n_parameters()).
    """
    vector[..., SWITCHES] = switched_on(vector[..., _FIRST:], np.arange(_FIRST, n_parameters()))


def switched_on(numbers: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Which stages have an effect away from its off-value among some parameters, (..., stages) bool.

    Args:
        numbers: values of effects' parameters, (..., k). places: theirs in a parameter vector, (k,).
    """
    off, throws = _offs()
    return np.asarray((numbers != off[places - _FIRST]) @ throws[places - _FIRST] > 0.0)


def acting(vectors: np.ndarray, places: Collection[int] = ()) -> tuple[str, ...]:
    """Full names of the parameters of every effect that may be on; of a generic group, its terms.

    Args:
        vectors: parameter vectors, (m, n_parameters()). places: of parameters that may be others.
    """
    names = []
    for entry in GROUPS.values():
        own = range(entry.index, entry.index + len(entry.parameters))
        away = [
            k in places or bool((vectors[:, k] != p.off).any())
            for k, p in zip(own, entry.parameters, strict=True)
        ]
        if entry.generic:
            names += [name for name, is_away in zip(entry.names(), away, strict=True) if is_away]
        elif any(
            a and not (p.shape or p.held) for a, p in zip(away, entry.parameters, strict=True)
        ):
            names += entry.names()
    return tuple(names)


def completed(effect_name: str, table: Mapping[str, Any], make: Callable) -> dict[str, Any]:
    """An effect's parameters in catalogue order, absent ones at their off-value.

    Of a generic group only what is not zero.

    Args:
        effect_name: in the catalogue. table: name -> parameter, of those that are given.
        make: ``make(value, std, unit, source)``, a parameter that is not.
    """
    entry = GROUPS[effect_name]
    if entry.generic:
        names = [p.name for p in entry.parameters if p.name in table and table[p.name].value != 0.0]
        return {name: table[name] for name in names}
    return {
        p.name: table.get(p.name) or make(p.off, 0.0, p.unit, "off-value") for p in entry.parameters
    }


def stage_function(stage: int) -> Callable:
    """One function that runs all effects of a stage in the catalogue's order, for compiled code."""
    return njit_for_compiled(**BORROWING)(stage_source(stage))


def stage_source(stage: int, used: Collection[str] | None = None) -> FunctionType:
    """As `stage_function`, not compiled, and of some effects only.

    Written out as source, one call a line: a chain of closures takes numba three times as long.

    Args:
        stage: one of STAGES. used: full names of parameters; an effect is called where one of its
            own is among them, of a generic group those terms alone. None: all.
    """
    calls, names = [], {"__name__": __name__}
    for entry in GROUPS.values():
        own = [n for n in entry.names() if used is None or n in used]
        if entry.stage != stage or not own:
            continue
        if entry.generic and used is not None:
            numbers = [entry.names().index(name) for name in own]
            calls += [
                f"    {line}" for line in generic_terms.sum_of(entry.name, numbers, entry.index)
            ]
            names["term_value"] = generic_terms.term_value
        else:
            calls.append(f"    {entry.name}(x, f, p, {entry.index})")
            names[entry.name] = entry.function
    exec("\n".join(["def run(x, f, p):", *calls, "    pass"]), names)
    run: Any = names["run"]
    run.__qualname__ = f"stage_{stage}"
    return run
