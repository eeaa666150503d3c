"""What every controller can do, and how a saved one is read."""

import json
from pathlib import Path
from typing import Protocol

import numpy as np

from coax_env.errors import InputError


class Controller(Protocol):
    """Anything that flies CoaxHeli-v0: one helicopter or a batch, told nothing but observations."""

    @property
    def kind(self) -> str:
        """A word for tables: ``"lqg"``, ``"ppo"``."""

    @property
    def sensors(self) -> str:
        """The suite it must be given."""

    @property
    def nominal(self) -> tuple[np.ndarray, np.ndarray]:
        """Trim and scale of its actions, for ``nominal=`` of the env."""

    def reset(self, count: int = 1) -> None:
        """Forget the last flight; `count` helicopters are flown next."""

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Observation (n_obs,) or (count, n_obs) to action (4,) or (count, 4)."""


def load_controller(path: str | Path) -> Controller:
    """Read a controller.json of `design_lqr.py` or a policy.zip of `train_ppo.py`.

    Raises:
        InputError: no such file, or not one of these.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"no controller {str(path)!r}: neither lqr nor a controller's file")
    if path.suffix == ".zip":
        from controllers.ppo import load_policy

        return load_policy(path)
    from controllers.lqr import FORMAT, LQG, VERSION

    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise InputError(f"{path}: not a JSON file ({error})") from error
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise InputError(f"{path}: not a controller of this project (format is not {FORMAT!r})")
    if content.get("version") != VERSION or content.get("kind") != LQG.kind:
        raise InputError(
            f"{path}: version {content.get('version')!r} of kind {content.get('kind')!r} is unknown"
        )
    try:
        return LQG.from_dict(content)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: a field is missing or of the wrong kind ({error})") from error
