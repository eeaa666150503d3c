"""Several flights under one set of numbers, each with noise, and some numbers, of its own.

``wind.north`` is the number of all parts; ``wind.north@B`` is what part B has on top of it, and a noise
level ``force_xy@B`` is that of part B alone. The log-likelihood is the parts' sum. So is its quadratic:
a part's column stands in every joint column that moves it there.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from coax_env.estimation.engine import Engine, NoiseScore
from coax_env.estimation.quadratic import Linearised, penalty
from coax_env.estimation.run_passes import RunPass
from coax_env.estimation.state_space import FreeParameter, Noise

AT = "@"


def of_part(name: str, part: str) -> str:
    """Name of a number or level that one part alone has."""
    return f"{name}{AT}{part}"


@dataclass(frozen=True)
class Part:
    """One flight.

    Attributes:
        name: after the ``@``.
        engine: over its records, with its own model.
        own: values that are this flight's whatever the joint ones are: the air's.
        limits: name -> (least, most) of a number, where physics has them.
    """

    name: str
    engine: Engine
    own: Mapping[str, float] = field(default_factory=dict)
    limits: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    def values(self, joint: Mapping[str, float]) -> dict[str, float]:
        """The part's numbers by their plain names."""
        values = {n: v for n, v in joint.items() if AT not in n} | dict(self.own)
        for name, value in joint.items():
            plain, _, part = name.partition(AT)
            if part == self.name:
                values[plain] = values.get(plain, 0.0) + value
                if plain in self.limits:
                    values[plain] = float(np.clip(values[plain], *self.limits[plain]))
        return values

    def levels(self, joint: Sequence[str]) -> tuple[str, ...]:
        """Plain names of the part's noise levels."""
        return tuple(n.partition(AT)[0] for n in joint if n.partition(AT)[2] == self.name)

    def noise(self, joint: Noise) -> Noise:
        """The part's noise by its plain names."""

        def own(levels: Mapping[str, Any]) -> dict[str, Any]:
            return {plain: levels[of_part(plain, self.name)] for plain in self.levels(list(levels))}

        return Noise(*(own(levels) for levels in _tables(joint)))


def _tables(noise: Noise) -> tuple[Mapping[str, Any], ...]:
    return noise.process, noise.reading, noise.floor, noise.ceiling, noise.prior


def joint_noise(parts: Mapping[str, Noise]) -> Noise:
    """The noise of all parts, level by level with the part's name."""
    joint: list[dict[str, Any]] = [{}, {}, {}, {}, {}]
    for part, noise in parts.items():
        for table, levels in zip(joint, _tables(noise), strict=True):
            table.update({of_part(name, part): value for name, value in levels.items()})
    return Noise(*joint)


class PartedEngine(Engine):
    """An engine over several parts: what `Engine` does, on joint numbers and noise levels."""

    def __init__(self, parts: Sequence[Part]) -> None:
        self.parts = tuple(parts)
        first = parts[0].engine
        records = [record for part in parts for record in part.engine.records]
        super().__init__(first.model, records, first.threads)

    def _indices(self) -> list[tuple[Part, range]]:
        """Parts, and where their records stand among all."""
        found, end = [], 0
        for part in self.parts:
            count = len(part.engine.records)
            found.append((part, range(end, end + count)))
            end += count
        return found

    def filter(
        self,
        values: Mapping[str, float],
        noise: Noise,
        keep: bool = False,
        which: Sequence[int] | None = None,
        start_rows: Sequence[np.ndarray] | None = None,
    ) -> list[RunPass]:
        """As `Engine.filter`, with joint values and noise."""
        passes: list[RunPass] = []
        for part, indices in self._indices():
            chosen = None if which is None else [i - indices.start for i in which if i in indices]
            rows = None if start_rows is None else [start_rows[i] for i in indices]
            passes += part.engine.filter(part.values(values), part.noise(noise), keep, chosen, rows)
        return passes

    def remember(
        self, values: Mapping[str, float], noise: Noise, passes: Sequence[RunPass]
    ) -> None:
        """As `Engine.remember`, by each part's engine."""
        for part, indices in self._indices():
            own = [passes[i] for i in indices]
            part.engine.remember(part.values(values), part.noise(noise), own)

    def linearise(
        self,
        values: Mapping[str, float],
        noise: Noise,
        free: Sequence[FreeParameter],
        gains: bool = True,
    ) -> tuple[list[RunPass], Linearised]:
        """As `Engine.linearise`, with joint values and noise."""
        passes: list[RunPass] = []
        found = []
        for part in self.parts:
            plain, columns = _plain_of(free, part.name)
            own, lin = part.engine.linearise(part.values(values), part.noise(noise), plain, gains)
            passes += own
            found.append(_spread(lin, columns))
        names = tuple(f.name for f in free)
        return passes, Linearised(names, *(np.concatenate(t) for t in zip(*found, strict=True)))

    def frozen_cost(
        self,
        passes: Sequence[RunPass],
        free: Sequence[FreeParameter],
        values: Mapping[str, float],
        noise: Noise,
    ) -> float:
        """As `Engine.frozen_cost`, with joint values and noise."""
        return penalty(free, values) + sum(
            part.engine.frozen_cost(
                [passes[i] for i in indices], (), part.values(values), part.noise(noise)
            )
            for part, indices in self._indices()
        )

    def noise_score(self, values: Mapping[str, float], noise: Noise) -> NoiseScore:
        """Not of all parts at once: each has levels of its own."""
        raise NotImplementedError("ask the parts' engines")


def _plain_of(free: Sequence[FreeParameter], part: str) -> tuple[list[FreeParameter], np.ndarray]:
    """A part's parameters by plain names, and which of them each joint one moves there (-1: none)."""
    plain: dict[str, FreeParameter] = {}
    columns = np.full(len(free), -1)
    for j, f in enumerate(free):
        name, _, of = f.name.partition(AT)
        if of in ("", part):
            if name not in plain or not of:
                plain[name] = replace(f, name=name)
            columns[j] = list(plain).index(name)
    return list(plain.values()), columns


def _spread(lin: Linearised, columns: np.ndarray) -> tuple[np.ndarray, ...]:
    """A part's linearisation over the joint parameters: information, slope, by_channel, blocks."""
    there = columns >= 0
    at = np.where(there, columns, 0)
    return (
        lin.information[:, at][:, :, at] * np.outer(there, there),
        lin.slope[:, at] * there,
        lin.by_channel[:, at] * there[:, None],
        lin.blocks[:, at] * there,
    )
