"""What sensors write down of a simulated run: the env's rules (model/sampling.py), NumPy's chance."""

from collections.abc import Sequence

import numpy as np

from coax_env.kernel.compilation import compiled
from coax_env.model.sampling import (
    DELAY,
    DROPOUT,
    HIGH,
    INDEX,
    LOW,
    RATE,
    WRAPS,
    delay_slots,
    delayed,
    new_samples,
    received,
    sensor_table,
    within_a_turn,
)
from coax_env.model.sensors import BASE_RATE, Sensor


def log_readings(
    truth: np.ndarray, time: np.ndarray, sensors: Sequence[Sensor], rng: np.random.Generator
) -> dict[str, np.ndarray]:
    """Noisy log of true readings; NaN where a sensor has no new sample, or has lost it.

    Args:
        truth: readings of every canonical channel, shape (n, 18).
        time: since the start of the run, in even steps [s], shape (n,).
        sensors: from `log_suite`.

    Returns:
        channel -> shape (n,), in the channel's unit.
    """
    n = len(time)
    dt = float(time[1] - time[0]) if n > 1 else 1.0 / BASE_RATE
    table = sensor_table(sensors, dt=dt)
    noise, chance = np.empty((n, len(sensors))), np.ones((n, len(sensors)))
    bias = np.empty(len(sensors))
    lost: dict[str, np.ndarray] = {}
    for k, sensor in enumerate(sensors):
        noise[:, k] = sensor.noise * rng.standard_normal(n)
        bias[k] = sensor.bias
        if sensor.bias_std > 0.0:
            bias[k] += sensor.bias_std * rng.standard_normal()
        if sensor.dropout > 0.0:
            if sensor.instrument not in lost:
                lost[sensor.instrument] = rng.random(n)
            chance[:, k] = lost[sensor.instrument]
    past = np.empty((delay_slots(table[:, DELAY].max()), len(sensors)))
    log = np.empty((n, len(sensors)))
    _log_rows(np.ascontiguousarray(truth, float), table, bias, noise, chance, past, log)
    return {sensor.name: log[:, k].copy() for k, sensor in enumerate(sensors)}


@compiled()
def _log_rows(
    truth: np.ndarray, sensors: np.ndarray, bias: np.ndarray, noise: np.ndarray,
    chance: np.ndarray, past: np.ndarray, log: np.ndarray,
) -> None:  # fmt: skip
    """`log_readings` with its random numbers drawn: truth (n, 18) to the log (n, n_sensors).

    Args:
        truth: (n, 18). sensors: `sampling.sensor_table`. bias: (n_sensors,).
        noise, chance: of every reading, (n, n_sensors). past: ring for `delayed`. log: put here.
    """
    for row in range(len(truth)):
        for k in range(len(sensors)):
            value = truth[row, int(sensors[k, INDEX])]
            if len(past) > 0:
                value = delayed(value, past, row, k, sensors[k, DELAY])
            value = within_a_turn(value + bias[k] + noise[row, k], sensors[k, WRAPS])
            new = new_samples(row, sensors[k, RATE])
            new = received(new, row, chance[row, k], sensors[k, DROPOUT])
            log[row, k] = (
                min(max(value, sensors[k, LOW]), sensors[k, HIGH]) if new >= 1.0 else np.nan
            )
