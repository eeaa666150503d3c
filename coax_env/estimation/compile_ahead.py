"""What a diagnosis calls, compiled before it does: in two processes, which fill one cache on disk.

numba compiles one function at a time in a process. In a new checkout that is most of the time that a
first diagnosis takes.
"""

import os
import subprocess
import sys

from coax_env.estimation import beginnings, compiled_model, frozen_gains, kalman, noise_score
from coax_env.estimation.helicopter import HeliModel
from coax_env.kernel import compilation
from coax_env.model.dynamics import hover_trim
from coax_env.model.vehicle_file import load_vehicle

PASSES = (
    kalman.filter_pass,
    frozen_gains.signature_pass,
    noise_score.score_pass,
    frozen_gains.mean_pass,
    frozen_gains.mean_passes,
    compiled_model.fly_open_loop,
    compiled_model.read,
    beginnings.beginnings_pass,
)


def is_filled() -> bool:
    """Whether a filter pass has been compiled from the sources as they are."""
    return any(compilation.CACHE_DIR.rglob("kalman.filter_pass*"))


def compile_passes() -> None:
    """The passes over a run: one half of the time."""
    for one in PASSES:
        one.prepare()


def compile_model() -> None:
    """The model with all effects, of registers and of numbers: the other half."""
    lama = load_vehicle("lama400d")
    model = HeliModel(lama)
    assert model.step and model.side_by_side is not None
    hover_trim(
        lama.with_effect("motor_lag", upper=0.05).with_effect("rotor_drag", coefficient=1e-4)
    )


def fill_cache() -> None:
    """Compile both, where nothing is compiled yet and there are two processors for it."""
    if is_filled() or (os.cpu_count() or 1) < 2:
        return
    with subprocess.Popen([sys.executable, "-m", __name__], stdin=subprocess.DEVNULL):
        compile_passes()


if __name__ == "__main__":
    compile_model()
