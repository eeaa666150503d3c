"""Exported C as compiled here: its size, its time per step, and as a controller that flies the env."""

import ctypes
import os
import re
import shutil
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode

from coax_env.env import hover
from coax_env.env.vector_env import CoaxVectorEnv
from coax_env.errors import InputError
from coax_env.model.vehicle import Vehicle
from controllers.export import c_numbers
from controllers.feedback import Feedback
from controllers.loading import Controller

FLAGS = ("-std=c99", "-O2", "-pedantic", "-Wall", "-Wextra", "-Wdouble-promotion", "-Werror")
_MEMORY = """
#include "coax_controller.h"
#include <stddef.h>
size_t coax_memory(void);
size_t coax_memory(void) { return sizeof(coax_controller); }
"""
_floats = ctypes.POINTER(ctypes.c_float)


def compiler() -> str | None:
    """The C compiler of this machine: $CC, else cc or gcc; None where there is none."""
    found = (shutil.which(name) for name in (os.environ.get("CC"), "cc", "gcc") if name)
    return next((path for path in found if path), None)


def build(sources: Sequence[Path], out: Path, *flags: str) -> Path:
    """Compile C files; what the compiler warns of is an error.

    Args:
        sources: what is compiled.
        out: what is made.
        flags: after FLAGS.
    """
    found = compiler()
    if found is None:
        raise InputError("no C compiler: neither $CC nor cc nor gcc")
    words = [found, *FLAGS, *flags, *map(str, sources), "-o", str(out), "-lm"]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"the exported C does not compile: {done.stderr}")
    return out


@dataclass(frozen=True)
class Cost:
    """What a controller takes."""

    microseconds: float  # per step, on this machine
    memory: int  # bytes of RAM
    code: int | None  # bytes of code and numbers; None where there is no `size`


def cost(folder: Path, work: Path) -> Cost:
    """Measure an export.

    Args:
        folder: of the export.
        work: where the program is built.
    """
    code_file = folder / "coax_controller.c"
    program = build([code_file, folder / "step_time.c"], work / "step_time")
    said = subprocess.run([str(program)], capture_output=True, text=True, check=True).stdout
    found = re.match(r"(\S+) us per step, (\d+) bytes", said)
    assert found is not None, said
    code = None
    if shutil.which("size"):
        part = build([code_file], work / "coax_controller.o", "-c")
        table = subprocess.run(["size", str(part)], capture_output=True, text=True, check=True)
        code = int(table.stdout.splitlines()[1].split()[0])
    return Cost(float(found[1]), int(found[2]), code)


class Compiled(Feedback):
    """The exported C as a controller of the env; the memory of each helicopter is its own."""

    def __init__(self, controller: Controller, folder: Path, work: Path) -> None:
        """Compile an export.

        Args:
            controller: what was exported.
            folder: the files.
            work: where the library is built.
        """
        size = work / "coax_memory.c"
        size.write_text(_MEMORY)
        library = build(
            [folder / "coax_controller.c", size], work / "controller.so",
            "-shared", "-fPIC", f"-I{folder}",
        )  # fmt: skip
        self._c = ctypes.CDLL(str(library))
        self._c.coax_memory.restype = ctypes.c_size_t
        self.kind, self.sensors = controller.kind, controller.sensors
        self.action_trim, self.action_scale = controller.nominal
        self._width = c_numbers.observed(self.sensors)
        self.commands = np.zeros((0, 4), dtype=np.float32)

    def begin(self) -> None:
        """New flights of `count` helicopters."""
        size = self._c.coax_memory()
        self._memory = [ctypes.create_string_buffer(size) for _ in range(self.count)]
        self.commands = np.zeros((self.count, 4), dtype=np.float32)
        for memory in self._memory:
            self._c.coax_reset(memory)

    def compute_actions(self, observations: np.ndarray) -> np.ndarray:
        """Actions (count, 4) to observations (count, n_obs)."""
        seen = np.ascontiguousarray(observations, dtype=np.float32)
        actions = np.zeros((self.count, 4), dtype=np.float32)
        for k, memory in enumerate(self._memory):
            way = seen[k, self._width :]
            self._c.coax_step(
                memory, seen[k].ctypes.data_as(_floats),
                way.ctypes.data_as(_floats) if len(way) else None,
                actions[k].ctypes.data_as(_floats), self.commands[k].ctypes.data_as(_floats),
            )  # fmt: skip
        return actions


def command_difference(
    controller: Controller,
    exported: Compiled,
    vehicle: Vehicle,
    seconds: float = 20.0,
    flights: int = 3,
    seed: int = 0,
    env_arguments: Mapping[str, Any] | None = None,
) -> float:
    """The largest difference of a command in flights of the same seeds, as a share of its range.

    Each flies for itself: a difference also grows by what it makes of the flight.

    Args:
        controller: what was exported.
        exported: the same, compiled.
        vehicle: what flies.
        seconds: of each flight.
        flights: how many.
        seed: of the first.
        env_arguments: further ones of CoaxVectorEnv.
    """
    flown = [
        _actions(one, vehicle, seconds, flights, seed, env_arguments or {})
        for one in (controller, exported)
    ]
    return float(np.abs(flown[0] - flown[1]).max() / 2.0)  # an action runs from -1 to 1


def _actions(
    controller: Controller,
    vehicle: Vehicle,
    seconds: float,
    flights: int,
    seed: int,
    env_arguments: Mapping[str, Any],
) -> np.ndarray:
    """Actions (periods, flights, 4) of whole flights."""
    env = CoaxVectorEnv(
        flights, vehicle, controller.nominal, controller.sensors,
        autoreset_mode=AutoresetMode.DISABLED, **env_arguments,
    )  # fmt: skip
    observations, _ = env.reset(seed=seed)
    controller.reset(flights)
    found = []
    for _ in range(round(seconds / hover.CONTROL_PERIOD)):
        found.append(np.array(controller.act(observations), dtype=float))
        observations = env.step(found[-1])[0]
    return np.stack(found)
