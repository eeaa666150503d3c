"""Other simulators, each in a venv of its own, pinned; never in the project's."""

import os
import re
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

INSTALL_LIMIT = 1800.0  # [s]
TORCH = "torch==2.13.0"  # has a build for processors only


class Unavailable(Exception):
    """A peer that cannot be installed here, with the reason."""


@dataclass(frozen=True)
class Peer:
    """One simulator. ``steps``: the arguments of pip, call by call. ``plays``: the modes of timing.py.

    ``source``: its repository, where PyPI does not have it; a step's ``{source}`` is that, or the
    checkout that the user has.
    """

    name: str
    program: str
    steps: tuple[tuple[str, ...], ...]
    plays: tuple[str, ...] = ("many", "one", "start")
    source: str = ""


PEERS = (
    Peer(
        "crazyflow", "fly_crazyflow.py",
        (("crazyflow==0.4.0", "jax==0.10.1", "mujoco==4.0.0", "mujoco-mjx==3.17.0",
          "flax==0.12.8", "gymnasium==1.4.0", "numpy==2.4.6"),),
    ),
    Peer(
        "rotorpy", "fly_rotorpy.py",
        ((TORCH,), ("rotorpy[batched,learning]==3.0.0", TORCH, "stable-baselines3==2.9.2",
                    "gymnasium==1.4.0", "numpy==2.4.6")),
    ),
    Peer(
        "pyflyt", "fly_pyflyt.py",
        (("pyflyt==0.29.0", "pybullet==3.2.7", "gymnasium==1.4.0", "numpy==1.26.4"),),
    ),
    Peer(
        "gym-pybullet-drones", "fly_gym_pybullet_drones.py",
        (("pybullet==3.2.7", "gymnasium==1.4.0", "numpy==2.4.6", "scipy==1.17.1",
          "transforms3d==0.4.2", "matplotlib", "pillow", "control==0.10.2", "setuptools<81"),
         ("--no-deps", "{source}")),
        plays=("one", "start"),
        source="git+https://github.com/utiasDSL/gym-pybullet-drones"
               "@90b178aba69b09085dd70e7a1e88bb58ca00b4c9",
    ),
    Peer(
        "pufferlib", "",  # its build fetches raylib and Box2D; see `install`
        ((TORCH, "numpy<2", "setuptools<81", "wheel", "Cython"),
         ("--no-build-isolation", "--no-deps", "pufferlib==3.0.0")),
        plays=("many",),
    ),
)  # fmt: skip


def install(peer: Peer, folder: Path, sources: Path | None) -> Path:
    """Install a peer into ``folder/NAME`` unless it is there already, and return its Python.

    Args:
        sources: a folder with checkouts of peers that PyPI does not have, by name.

    Raises:
        Unavailable: with pip's reason; the whole story is in ``folder/NAME.log``.
    """
    home = folder / peer.name
    python = home / "bin" / "python"
    wanted = repr(peer.steps)
    done = home / "installed"
    if done.exists() and done.read_text() == wanted:
        return python
    own = sources / peer.name if sources else None
    source = str(own) if own and own.is_dir() else peer.source
    folder.mkdir(parents=True, exist_ok=True)
    log = folder / f"{peer.name}.log"
    with log.open("w") as out:
        calls = [[sys.executable, "-m", "venv", "--clear", str(home)]]
        for step in peer.steps:
            words = [word.format(source=source) for word in step]
            calls.append([str(python), "-m", "pip", "install", "--quiet", *words])
        for call in calls:
            try:
                failed = subprocess.run(
                    call, stdout=out, stderr=out, timeout=INSTALL_LIMIT, env=clean_environment()
                ).returncode
            except subprocess.TimeoutExpired:
                raise Unavailable(f"not installed after {INSTALL_LIMIT:.0f} s") from None
            if failed:
                out.flush()
                raise Unavailable(reason(log.read_text()))
    if not peer.program:
        raise Unavailable("installed, but there is no program here that flies it")
    done.write_text(wanted)
    return python


def reason(text: str) -> str:
    """What went wrong, in one line of a log: the last line that names an error with its cause."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    reported = [
        line for line in lines if re.search(r"[A-Za-z]*(Error|ERROR|error|fatal): \S", line)
    ]
    causes = [line for line in reported if not re.search("metadata|subprocess|See above", line)]
    return (causes or reported or lines or ["no word why"])[-1][:160]


def clean_environment() -> dict[str, str]:
    """This process's environment without what would steer another Python or its threads."""
    steering = ("PYTHON", "OMP_", "OPENBLAS_", "MKL_", "NUMBA_", "VIRTUAL_ENV")
    return {k: v for k, v in os.environ.items() if not k.startswith(steering)}
