"""The injector's sensors: what a log has, how often, how exactly, and what its card says of it."""

import math
from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np
from injector_air import remembered
from scipy.signal import butter, filtfilt, lfilter, lfilter_zi
from scipy.spatial.transform import Rotation

NOISE = {
    "rpm_upper": 2.0, "rpm_lower": 2.0, "p": 0.0349, "q": 0.0349, "r": 0.0349,
    "ax": 0.1, "ay": 0.1, "az": 0.1, "phi": 0.0087, "theta": 0.0087, "psi": 0.0087,
    "h": 0.05, "vn": 0.5, "ve": 0.5, "vd": 0.5,
}  # fmt: skip
"""The paper's Table V."""

FAST = ("rpm_upper", "rpm_lower", "p", "q", "r", "ax", "ay", "az")
"""What is read in every row of a fast log."""

POSE = {"phi": 1.4e-3, "theta": 1.6e-3, "psi": 8e-4, "pn": 1e-4, "pe": 1e-4, "h": 2e-4}
"""What third differences of the real CoaX flights show: rad and m."""
LAB_POSE = {channel: 5.0 * std for channel, std in POSE.items()}
"""Of a motion capture that is coarser."""

FLICKERS = (0.03, 0.3, 3.0, 30.0)
"""s, memories of an error that is equal in each decade."""

TELEMETRY = {
    "p": 0.3, "q": 0.3, "r": 0.1, "ax": 0.5, "ay": 0.5, "az": 0.8,
    "phi": 1e-3, "theta": 1e-3, "psi": 2e-3, "h": 0.005,
}  # fmt: skip
"""What second differences of the second CoaX's telemetry show: gyros and accelerometers are shaken by
the rotors."""


class Sensors(NamedTuple):
    """One set of sensors.

    noise: channel -> std. every: channel -> logged rows between readings where more than one.
    step: s between rows, as the pilot commands. unrest: std of a row's time, share of the step.
    every_row: rows from one that is logged to the next, in turn. lost: share of rows lost in bursts
        of 2 to 5. gap: s, one gap in a flight's first run.
    wander: channel -> std and memory [s] of an error that lasts, beside the noise. smooth: channel ->
        cut-off [Hz] of a Butterworth low-pass that reading and noise went through, and its order.
    flicker: channel -> std of an error with memories of 0.03 to 30 s, equal in each decade, beside the
        noise. common: channels that have half the variance of their noise in common.
    fused: s, memory of an onboard filter whose attitudes, velocities and height are logged: gyros and
        accelerometers carry them on, and they go back in it to what `noise` is of. 0: as they are read.
    stamps: s, std of the error of a row's logged time.
    between: channel -> rows between readings, of which straight lines are logged. held: the same of
        readings that are logged until the next. steadied: channel -> cut-off [Hz] of a Butterworth
        low-pass of second order that readings and noise went through forwards and back.
    outliers: share of rows on which all channels are off by up to 12 std. quanta: channel -> step
        of its readings. formats: channel -> how it is written.
    """

    noise: Mapping[str, float]
    every: Mapping[str, int] = {}
    step: float = 0.01
    unrest: float = 0.0
    every_row: tuple[int, ...] = (1,)
    lost: float = 0.0
    gap: float = 0.0
    wander: Mapping[str, tuple[float, float]] = {}
    smooth: Mapping[str, tuple[float, int]] = {}
    flicker: Mapping[str, float] = {}
    common: tuple[str, ...] = ()
    fused: float = 0.0
    stamps: float = 0.0
    between: Mapping[str, int] = {}
    held: Mapping[str, int] = {}
    steadied: Mapping[str, float] = {}
    outliers: float = 0.0
    quanta: Mapping[str, float] = {}
    formats: Mapping[str, str] = {}


SENSORS = {
    "full": Sensors(NOISE),
    "onboard": Sensors(
        NOISE | {"vn": 0.2, "ve": 0.2, "vd": 0.2},
        {"h": 5, "phi": 2, "theta": 2, "psi": 2, "vn": 10, "ve": 10, "vd": 10},
    ),
    "fast": Sensors(  # the inertial sensors in each of 500 rows a second, as noisy in 10 ms as above
        {c: std * (math.sqrt(5.0) if c in FAST else 1.0) for c, std in NOISE.items()},
        {c: 5 for c in NOISE if c not in FAST}, step=0.002, formats={"t": "%.3f"},
    ),
    "wandering": Sensors(  # attitudes of a filter, velocities of GNSS, biases that drift
        NOISE,
        wander={
            "phi": (0.01, 2.0), "theta": (0.01, 2.0), "psi": (0.02, 5.0), "h": (0.04, 1.0),
            "vn": (0.2, 1.0), "ve": (0.2, 1.0), "vd": (0.2, 1.0),
            **dict.fromkeys(("p", "q", "r"), (0.005, 10.0)),
            **dict.fromkeys(("ax", "ay", "az"), (0.05, 10.0)),
        },
    ),
    "flicker": Sensors(
        NOISE, flicker={c: 0.4 * std for c, std in NOISE.items() if not c.startswith("rpm")}
    ),
    "common": Sensors(NOISE, common=("p", "q", "r", "ax", "ay", "az", "phi", "theta", "psi")),
    "fused": Sensors(NOISE | {"phi": 0.03, "theta": 0.03, "psi": 0.05}, fused=1.0),
    "stamped": Sensors(NOISE, stamps=0.002, formats={"t": "%.5f"}),
    "resampled": Sensors(  # all on the clock of the fastest, by straight lines
        NOISE,
        between={"phi": 2, "theta": 2, "psi": 2, "h": 5, "vn": 10, "ve": 10, "vd": 10},
    ),
    "held": Sensors(  # the last one written again
        NOISE, held={"phi": 2, "theta": 2, "psi": 2, "h": 5, "vn": 10, "ve": 10, "vd": 10}
    ),
    "fifty": Sensors(NOISE, every_row=(2,)),
    "twenty_five": Sensors(NOISE, every_row=(4,)),
    "lab_twenty_five": Sensors(
        {c: std for c, std in NOISE.items() if c in FAST} | LAB_POSE, every_row=(4,),
        formats=dict.fromkeys(("h", "pn", "pe"), "%.5f"),
    ),
    "pose_steadied": Sensors(  # by the motion capture's own software
        LAB_POSE, step=0.01,
        steadied=dict.fromkeys(POSE, 10.0), formats=dict.fromkeys(("h", "pn", "pe"), "%.5f"),
    ),
    "lab": Sensors(  # poses of a motion capture, and what is on board
        {c: std for c, std in NOISE.items() if c in FAST} | LAB_POSE,
        formats=dict.fromkeys(("h", "pn", "pe"), "%.5f"),
    ),
    "inertial": Sensors({c: std for c, std in NOISE.items() if c in (*FAST, "h")}),
    "camera": Sensors(
        {"phi": 0.01, "theta": 0.01, "psi": 0.01, "pn": 0.003, "pe": 0.003, "h": 0.004}, step=0.01,
        every_row=(3,), formats=dict.fromkeys(("h", "pn", "pe"), "%.5f"),
    ),
    "two_hundred": Sensors(NOISE, step=0.005, formats={"t": "%.5f"}),
    "pose_two_hundred": Sensors(
        LAB_POSE, step=0.005, formats=dict.fromkeys(("t", "h", "pn", "pe"), "%.5f")
    ),
    "coarse": Sensors(NOISE, quanta={c: 2.0 * std for c, std in NOISE.items()}),
    "spiky": Sensors(NOISE, outliers=0.003),
    "smooth": Sensors(  # as the low-pass of an inertial sensor is often set
        NOISE, smooth=dict.fromkeys(("p", "q", "r", "ax", "ay", "az"), (20.0, 1))
    ),
    "autopilot": Sensors(  # and those of a flight controller's software
        NOISE,
        smooth=dict.fromkeys(("p", "q", "r"), (35.0, 2)) | dict.fromkeys(("ax", "ay", "az"), (25.0, 2)),
    ),
    "filtered_speeds": Sensors(  # averaged over a turn or two, as a motor controller reports them
        NOISE, smooth=dict.fromkeys(("rpm_upper", "rpm_lower"), (8.0, 1))
    ),
    "pose": Sensors(
        POSE, step=1.0 / 150.0, unrest=0.2, lost=0.01, outliers=0.002,
        formats=dict.fromkeys(("t", "h", "pn", "pe"), "%.5f"),
    ),
    "telemetry": Sensors(
        TELEMETRY, {"h": 2}, every_row=(4, 4, 4, 3), lost=0.01, gap=1.3,
        quanta={"phi": 0.001745, "theta": 0.001745, "psi": 0.001745, "h": 0.01},
    ),
}  # fmt: skip


MIXED, MIXED_POSES = "mixed", "mixed_poses"
"""Names of sensors that are drawn, with several of the faults above at once: with each channel of
`NOISE`, and with those of `POSE`."""
INERTIAL = ("p", "q", "r", "ax", "ay", "az")
GROUPS = (
    ("rpm_upper", "rpm_lower"), ("p", "q", "r"), ("ax", "ay", "az"), ("phi", "theta", "psi"), ("h",),
    ("vn", "ve", "vd"),
)  # fmt: skip
"""Channels of one sensor."""


def kit(name: str, seed: int) -> Sensors:
    """A set of sensors by its name; `MIXED` and `MIXED_POSES` are drawn from the seed."""
    drawn = {MIXED: mixed, MIXED_POSES: mixed_poses}
    return drawn[name](np.random.default_rng([seed, 1])) if name in drawn else SENSORS[name]


def _between(rng: np.random.Generator, low: float, high: float) -> float:
    """Log-uniform."""
    return math.exp(rng.uniform(math.log(low), math.log(high)))


def mixed_poses(rng: np.random.Generator) -> Sensors:
    """A motion capture of 60 to 240 Hz, up to ten times as coarse as `POSE`, other faults by chance."""
    turned, placed = _between(rng, 1.0, 10.0), _between(rng, 1.0, 10.0)
    noise = {c: std * (placed if c in ("pn", "pe", "h") else turned) for c, std in POSE.items()}
    formats = dict.fromkeys(("t", "phi", "theta", "psi", "h", "pn", "pe"), "%.5f")
    drawn = Sensors(noise, step=1.0 / rng.choice([60.0, 100.0, 150.0, 240.0]), formats=formats)
    if rng.random() < 0.4:
        drawn = drawn._replace(unrest=rng.uniform(0.05, 0.25))
    elif rng.random() < 0.3:
        drawn = drawn._replace(stamps=rng.uniform(0.05, 0.2) * drawn.step)
    if rng.random() < 0.5:
        drawn = drawn._replace(lost=rng.uniform(0.002, 0.02))
    if rng.random() < 0.5:
        drawn = drawn._replace(outliers=rng.uniform(0.0005, 0.004))
    if rng.random() < 0.25:
        drawn = drawn._replace(steadied=dict.fromkeys(noise, _between(rng, 6.0, 25.0)))
    if rng.random() < 0.3:
        share, memory = _between(rng, 0.3, 3.0), _between(rng, 0.5, 20.0)
        drawn = drawn._replace(wander={c: (share * std, memory) for c, std in noise.items()})
    return drawn


def mixed(rng: np.random.Generator) -> Sensors:
    """Sensors as real ones are: the faults above by chance, three at once in the mean.

    Noise between a third and three times `NOISE`, each sensor its own; slower sensors at 10 to 50 Hz in
    three of five; errors that last 0.5 to 20 s, up to twice the noise.
    """

    def some(share: float) -> list[tuple[str, ...]]:
        return [group for group in GROUPS[1:] if rng.random() < share]

    noise = dict(NOISE)
    for group in GROUPS:
        factor = _between(rng, 1.0 / 3.0, 3.0)
        noise |= {channel: factor * noise[channel] for channel in group}
    slow = dict.fromkeys(("phi", "theta", "psi"), 2) | dict.fromkeys(("vn", "ve", "vd"), 10)
    slow["h"] = int(rng.integers(2, 6))
    put = rng.choice(["each row", "every", "held", "between"], p=[0.4, 0.4, 0.1, 0.1])
    drawn = Sensors(noise, **({} if put == "each row" else {str(put): slow}))
    if rng.random() < 0.4:
        lasting = {}
        for group in some(0.5):
            share, memory = _between(rng, 0.2, 2.0), _between(rng, 0.5, 20.0)
            lasting |= {channel: (share * noise[channel], memory) for channel in group}
        drawn = drawn._replace(wander=lasting)
    if rng.random() < 0.15:
        flickering = sum(some(0.5), ())
        drawn = drawn._replace(flicker={c: _between(rng, 0.1, 0.5) * noise[c] for c in flickering})
    if rng.random() < 0.4:
        cut_off = _between(rng, 12.0, 80.0)
        order = int(rng.integers(1, 3))
        channels = INERTIAL if rng.random() < 0.7 else INERTIAL[:3]
        drawn = drawn._replace(smooth=dict.fromkeys(channels, (cut_off, order)))
    if rng.random() < 0.15:
        drawn = drawn._replace(common=(*INERTIAL, "phi", "theta", "psi"))
    if rng.random() < 0.15 and not drawn.wander:
        drawn = drawn._replace(fused=_between(rng, 0.5, 3.0))
    if rng.random() < 0.2:
        drawn = drawn._replace(stamps=rng.uniform(0.0005, 0.003))
    if rng.random() < 0.25:
        drawn = drawn._replace(outliers=rng.uniform(0.001, 0.005))
    if rng.random() < 0.3:
        stepped = sum(some(0.5), ())
        drawn = drawn._replace(quanta={c: rng.uniform(0.5, 2.0) * noise[c] for c in stepped})
    if rng.random() < 0.25:
        drawn = drawn._replace(lost=rng.uniform(0.002, 0.02))
    return drawn._replace(formats={"t": "%.5f"} if drawn.stamps else {})


# --- when ---------------------------------------------------------------------------------------------


def clock(sensors: Sensors, settle: float, length: float, rng: np.random.Generator) -> np.ndarray:
    """Times of the pilot's commands [s], the log beginning at 0, and one more.

    Where the clock is even no number is drawn.
    """
    before, after = round(settle / sensors.step), round(length / sensors.step)
    times = sensors.step * np.arange(-before, after + 1)
    if sensors.unrest > 0.0:
        late = sensors.unrest * sensors.step * rng.standard_normal(len(times))
        times = times + np.clip(late, -0.45 * sensors.step, 0.45 * sensors.step)
        times = times - times[before]
    return times


def thin(
    columns: dict[str, np.ndarray],
    sensors: Sensors,
    rng: np.random.Generator,
    *,
    lost_echoes: bool,
    radio_gaps: bool,
    first: bool,
) -> dict[str, np.ndarray]:
    """The readings and rows that a real log would have; NaN where a reading is missing."""
    kept = _logged(columns["t"], sensors, rng, first)
    columns = {channel: values[kept] for channel, values in columns.items()}
    n = len(columns["t"])
    if lost_echoes:
        columns["h"] = np.where(rng.random(n) < 0.005, 6.5, columns["h"])
    for channel, step in sensors.every.items():
        columns[channel] = np.where(np.arange(n) % step == 0, columns[channel], np.nan)
    if radio_gaps:
        for _ in range(2):
            start = int(rng.integers(200, n - 100))
            gap = slice(start, start + int(rng.integers(5, 25)))
            for channel in sensors.noise:
                columns[channel][gap] = np.nan
    return columns


def _logged(
    t: np.ndarray, sensors: Sensors, rng: np.random.Generator, first: bool
) -> np.ndarray | slice:
    """Which rows are in the log."""
    if sensors.every_row == (1,) and sensors.lost == 0.0:
        return slice(None)
    n = len(t)
    kept = np.zeros(n, dtype=bool)
    at = np.cumsum([0, *np.resize(sensors.every_row, n)])
    kept[at[at < n]] = True
    for _ in range(round(sensors.lost * n / 3.5)):
        start = int(rng.integers(n))
        kept[start : start + int(rng.integers(2, 6)) * sensors.every_row[0]] = False
    if first and sensors.gap > 0.0:
        start = float(rng.uniform(0.3, 0.8)) * t[-1]
        kept[(t > start) & (t < start + sensors.gap)] = False
    return kept


def err(columns: dict[str, np.ndarray], sensors: Sensors, rng: np.random.Generator) -> None:
    """Errors that last, in place, after the noise."""
    lasting = [(channel, *own) for channel, own in sensors.wander.items()]
    lasting += [(c, std, memory) for c, std in sensors.flicker.items() for memory in FLICKERS]
    for channel, std, memory in lasting:
        white = rng.standard_normal(len(columns[channel]))
        # so before the log began
        white[0] /= math.sqrt(1.0 - math.exp(-2.0 * sensors.step / memory))
        columns[channel] = columns[channel] + remembered(white, std, memory, sensors.step)
    if sensors.common:
        shared = rng.standard_normal(len(columns["t"]))
        for channel in sensors.common:
            columns[channel] = columns[channel] + math.sqrt(0.5) * sensors.noise[channel] * shared
    rows = np.arange(len(columns["t"]))
    for channel, every in sensors.between.items():
        values = columns[channel][::every]
        values = np.unwrap(values) if channel == "psi" else values
        columns[channel] = np.interp(rows, rows[::every], values)
    for channel, every in sensors.held.items():
        columns[channel] = columns[channel][rows // every * every]
    for channel, cut_off in sensors.steadied.items():
        b, a = butter(2, cut_off, fs=1.0 / sensors.step)
        values = np.unwrap(columns[channel]) if channel == "psi" else columns[channel]
        columns[channel] = filtfilt(b, a, values)
    if sensors.fused > 0.0:
        fuse(columns, sensors)
    if sensors.stamps > 0.0:
        late = sensors.stamps * rng.standard_normal(len(columns["t"]))
        columns["t"] = columns["t"] + np.clip(late, -0.45 * sensors.step, 0.45 * sensors.step)
        columns["t"] -= columns["t"][0]


def fuse(columns: dict[str, np.ndarray], sensors: Sensors) -> None:
    """Attitudes, velocities and height as an onboard filter says them, in place.

    A complementary filter: the noisy gyros and accelerometers carry its state from row to row, and
    in `sensors.fused` s it goes back to the noisy angles, velocities and heights.
    """
    rates = np.stack([columns[c] for c in "pqr"], axis=-1)
    force = np.stack([columns[c] for c in ("ax", "ay", "az")], axis=-1)
    angles = np.stack([columns[c] for c in ("psi", "theta", "phi")], axis=-1)
    speeds = np.stack([columns[c] for c in ("vn", "ve", "vd")], axis=-1)
    back = sensors.step / sensors.fused
    attitude, speed, height = Rotation.from_euler("ZYX", angles[0]), speeds[0], columns["h"][0]
    for k in range(len(rates)):
        off = attitude.inv() * Rotation.from_euler("ZYX", angles[k])
        attitude = attitude * Rotation.from_rotvec(back * off.as_rotvec())
        speed = speed + back * (speeds[k] - speed)
        height = height + back * (columns["h"][k] - height)
        columns["psi"][k], columns["theta"][k], columns["phi"][k] = attitude.as_euler("ZYX")
        columns["vn"][k], columns["ve"][k], columns["vd"][k] = speed
        columns["h"][k] = height
        height = height - sensors.step * speed[2]
        speed = speed + sensors.step * (attitude.apply(force[k]) + [0.0, 0.0, 9.81])
        attitude = attitude * Rotation.from_rotvec(sensors.step * rates[k])


def smoothed(
    true: np.ndarray,
    std: float,
    sensors: Sensors,
    kind: tuple[float, int],
    rng: np.random.Generator,
) -> np.ndarray:
    """Readings behind a Butterworth low-pass that runs at about 1 kHz and is read once a row.

    Args:
        true: as the rows begin, by straight lines between them. std: white noise of the same density,
            were it in the rows. kind: cut-off [Hz] and order.
    """
    times = max(round(sensors.step / 0.001), 1)
    n = len(true)
    fine = np.interp(np.arange((n - 1) * times + 1) / times, np.arange(n), true)
    fine += math.sqrt(times) * std * rng.standard_normal(fine.size)
    b, a = butter(kind[1], kind[0], fs=times / sensors.step)
    return lfilter(b, a, fine, zi=true[0] * lfilter_zi(b, a))[0][::times]


def blunt(columns: dict[str, np.ndarray], sensors: Sensors, rng: np.random.Generator) -> None:
    """Outliers and steps of the readings, in place."""
    n = len(columns["t"])
    for row in np.flatnonzero(rng.random(n) < sensors.outliers) if sensors.outliers else ():
        for channel, std in sensors.noise.items():
            columns[channel][row] += std * rng.uniform(-12.0, 12.0)
    for channel, quantum in sensors.quanta.items():
        columns[channel] = quantum * np.round(columns[channel] / quantum)


# --- what --------------------------------------------------------------------------------------------

_FORMATS = {
    "t": "%.2f",
    "battery_v": "%.2f",
    "h": "%.3f",
    "vn": "%.3f",
    "ve": "%.3f",
    "vd": "%.3f",
} | dict.fromkeys(("rpm_upper_cmd", "rpm_lower_cmd", "rpm_upper", "rpm_lower"), "%.1f")


def csv_text(columns: Mapping[str, np.ndarray], sensors: Sensors) -> str:
    """The log of a run."""
    formats = _FORMATS | dict(sensors.formats)
    texts = []
    for channel, values in columns.items():
        form = formats.get(channel, "%.5f")
        texts.append(["" if x != x else form % x for x in values.tolist()])
    rows = [",".join(columns), *(",".join(row) for row in zip(*texts, strict=True))]
    return "\n".join(rows) + "\n"


def card_text(
    names: Iterable[str], vehicle: str, air: tuple[float, float], noise: Mapping[str, float]
) -> str:
    """A flight's test card.

    Args:
        names: of the runs. vehicle: name or path of its file. air: density and gravity.
        noise: what the card says of the sensors; empty: nothing.
    """
    lines = ["[vehicle]", f'name = "{vehicle}"', "[air]"]
    lines += [f"density = {air[0]}", f"gravity = {air[1]}"]
    if noise:
        lines += ["[noise]", *(f"{channel} = {std}" for channel, std in noise.items())]
    for name in names:
        lines += ["[[run]]", f'name = "{name}"', f'file = "{name}.csv"', f'maneuver = "{name}"']
    return "\n".join(lines) + "\n"
