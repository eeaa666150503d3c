"""The wheel under another Python: python3.14 tests/wheel_elsewhere.py coaxheli-*.whl [WHERE]

Needs that Python with its venv, a package index, and nothing of this project. It makes an environment
in WHERE (else in a folder that it removes), installs the wheel with what it requires, and flies,
checks and diagnoses in an empty folder.
A Python that the machine lacks can come from Debian, without touching the machine's own:

    debootstrap --variant=minbase --include=python3-venv,ca-certificates sid ROOT
    cp tests/wheel_elsewhere.py coaxheli-*.whl /etc/resolv.conf ROOT/etc/
    chroot ROOT sh -c 'python3 /etc/wheel_elsewhere.py /etc/coaxheli-*.whl'
"""

import subprocess
import sys
import tempfile
import venv
from pathlib import Path

FLY = """
import gymnasium, numpy as np, coax_env
from controllers.loading import make_controller
env = gymnasium.make("CoaxHeli-v0")
obs, info = env.reset(seed=1)
for _ in range(100):
    obs, reward, ended, cut, info = env.step(env.action_space.sample() * 0.0)
assert np.isfinite(obs).all() and not ended
envs = gymnasium.make_vec("CoaxHeli-v0", num_envs=16, vectorization_mode="vector_entry_point")
envs.reset(seed=1)
for _ in range(20):
    obs, *_ = envs.step(np.zeros(envs.action_space.shape))
assert np.isfinite(obs).all()
print(make_controller("ppo").kind, make_controller("lqg").kind)
"""


def main(wheel: Path, place: Path) -> None:
    """Install and try."""
    venv.create(place / "env", with_pip=True)
    python, coax = place / "env" / "bin" / "python", place / "env" / "bin" / "coax"
    call(python, "-m", "pip", "install", "-q", "--only-binary=:all:", str(wheel))
    work = place / "work"
    work.mkdir(exist_ok=True)
    call(python, "-c", FLY, where=work)
    call(coax, "check_flight", "--form", where=work)
    checked = call(coax, "check_flight", "windy", where=work)
    assert "SUSPICIOUS" not in checked
    said = call(coax, "diagnose", "windy", "--out", "found", where=work)
    assert all(cause in said for cause in ("rotor_drag", "wind", "motor_lag", "gyro_bias")), said
    assert (work / "found" / "findings.json").exists() and (
        work / "found" / "vehicle.toml"
    ).exists()
    print(said)
    print(
        f"Python {'.'.join(map(str, sys.version_info[:3]))}: the wheel flies, checks and diagnoses"
    )


def call(*command: str | Path, where: Path | None = None) -> str:
    """Its output; what went wrong, where it fails."""
    done = subprocess.run(command, cwd=where, capture_output=True, text=True, check=False)
    if done.returncode:
        said = " ".join(map(str, command))[:200]
        sys.exit(f"{said}: exit code {done.returncode}\n{done.stderr[-3000:]}")
    return done.stdout


if __name__ == "__main__":
    if len(sys.argv) > 2:
        main(Path(sys.argv[1]).resolve(), Path(sys.argv[2]).resolve())
    else:
        with tempfile.TemporaryDirectory() as folder:
            main(Path(sys.argv[1]).resolve(), Path(folder))
