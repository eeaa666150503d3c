"""A card's [columns]: where a channel is in somebody else's file, and what makes its numbers ours."""

from dataclasses import dataclass

import numpy as np

from coax_env.logs.units import LOG_UNITS, PLACE_UNITS

SMALLEST_SCALE, LARGEST_SCALE = 1e-12, 1e12
"""Between them lies the size of any factor that a card may ask for."""
COLUMN_KEYS = ("name", "unit", "sign", "offset", "scale", "calibration", "hold", "late")
LATEST = 1.0
"""s by which a column may be written late: more is another log's clock; ours."""


@dataclass(frozen=True)
class Column:
    """A log's column, and what makes its numbers the channel's: sign * scale * (raw + offset) in
    `unit`.

    Attributes:
        name: in the files.
        unit: in which the numbers are, then.
        factor: of that unit to the channel's own.
        sign: -1 turns an axis round.
        scale: a factor beside the unit's.
        offset: added to the raw number first.
        calibration: points (raw, value in `unit`) in place of scale and offset; straight lines
            between them and beyond.
        hold: whether a repeat is no new reading; None: as the pattern of repeats says (held.py).
        late: by which it is written later than it happened [s] (late.py).
    """

    name: str
    unit: str
    factor: float = 1.0
    sign: int = 1
    scale: float = 1.0
    offset: float = 0.0
    calibration: tuple[tuple[float, float], ...] = ()
    hold: bool | None = None
    late: float = 0.0

    @classmethod
    def own(cls, channel: str) -> "Column":
        """That of a channel which the card does not name."""
        return cls(channel, {**LOG_UNITS, **PLACE_UNITS}[channel])

    def read(self, raw: np.ndarray) -> np.ndarray:
        """Raw numbers (n,) in the channel's canonical unit."""
        if self.calibration:
            return self.sign * self.factor * self._calibrated(raw)
        return self.sign * self.scale * self.factor * (raw + self.offset)

    def _calibrated(self, raw: np.ndarray) -> np.ndarray:
        x, y = np.array(self.calibration).T
        k = np.clip(np.searchsorted(x, raw) - 1, 0, x.size - 2)
        found: np.ndarray = y[k] + (raw - x[k]) * (y[k + 1] - y[k]) / (x[k + 1] - x[k])
        return found

    def entry(self, channel: str) -> str:
        """The line of a card that says all this."""
        own = {**LOG_UNITS, **PLACE_UNITS}[channel]
        words = [f"name = {quoted(self.name)}"] if self.name != channel else []
        if self.unit != own:
            words.append(f"unit = {quoted(self.unit)}")
        if self.sign != 1:
            words.append(f"sign = {self.sign}")
        if self.scale != 1.0:
            words.append(f"scale = {self.scale:.6g}")
        if self.offset != 0.0:
            words.append(f"offset = {self.offset:.6g}")
        if self.calibration:
            points = ", ".join(f"[{x:g}, {y:g}]" for x, y in self.calibration)
            words.append(f"calibration = [{points}]")
        if self.hold is not None:
            words.append(f"hold = {str(self.hold).lower()}")
        if self.late:
            words.append(f"late = {self.late:g}")
        return f"{channel} = {{ {', '.join(words) or f'name = {quoted(self.name)}'} }}"


@dataclass(frozen=True)
class Quaternion:
    """Attitude logged as a quaternion: columns of w, x, y, z, and what it turns into what
    (frames.py)."""

    names: tuple[str, str, str, str]
    frames: str

    def entry(self) -> str:
        """The line of a card that says it."""
        names = ", ".join(quoted(name) for name in self.names)
        return f"quaternion = {{ names = [{names}], from = {quoted(self.frames)} }}"


def quoted(text: str) -> str:
    """Text as TOML quotes it."""
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'
