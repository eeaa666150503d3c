"""Write a controller as C99 for a flight computer, compile it here, and fly both for comparison."""

import argparse
import tempfile
from importlib.util import find_spec
from pathlib import Path

import command_line

from coax_env.errors import InputError
from coax_env.files import staged_folder, write_bytes, write_text
from coax_env.model.vehicle_file import load_vehicle
from controllers.export import compiled
from controllers.export.c_code import c_files
from controllers.loading import Controller, make_controller
from controllers.policy import Policy


def main() -> None:
    options = arguments()
    if not options.seconds > 0.0:
        raise InputError(f"--seconds must be more than 0, found {options.seconds:g}")
    controller = make_controller(
        options.controller, options.vehicle, options.nominal, options.sensors
    )
    files = c_files(controller)
    with staged_folder(options.out) as stage:
        for name, text in files.items():
            write_text(stage / name, text)
        if isinstance(controller, Policy) and find_spec("onnx"):
            from controllers.export.onnx_network import onnx_bytes

            write_bytes(stage / "policy.onnx", onnx_bytes(controller))
    print(f"{controller.kind} on sensors {controller.sensors}: {', '.join(files)} in {options.out}")
    if isinstance(controller, Policy):
        print_onnx(options.out)
    if compiled.compiler() is None:
        print("no C compiler on this machine: not compiled, not compared")
        return
    print_check(controller, options)


def print_onnx(out: Path) -> None:
    """Where the network lies, or why it does not."""
    if (out / "policy.onnx").exists():
        print(f"network alone, for a runtime of ONNX: {out / 'policy.onnx'}")
    else:
        print("no policy.onnx: it needs the package onnx (pip install 'coaxheli[export]')")


def print_check(controller: Controller, options: argparse.Namespace) -> None:
    """Compile, measure and fly what was written.

    Args:
        controller: what was exported.
        options: of the command line.
    """
    with tempfile.TemporaryDirectory() as work:
        cost = compiled.cost(options.out, Path(work))
        exported = compiled.Compiled(controller, options.out, Path(work))
        arguments = {} if options.task == "hover" else {"task": options.task}
        difference = compiled.command_difference(
            controller, exported, load_vehicle(options.vehicle), options.seconds, 3, options.seed,
            arguments,
        )  # fmt: skip
    size = "" if cost.code is None else f", {cost.code} bytes of code and numbers"
    print(f"{cost.memory} bytes of RAM{size} (float, {' '.join(compiled.FLAGS[:2])})")
    print(f"{cost.microseconds:.2f} us per step on this machine, whose period is 10000 us")
    print(
        f"3 flights of {options.seconds:g} s ({options.task}) by this code and by the original: "
        f"commands differ by at most {difference:.1e} of their range"
    )


def arguments() -> argparse.Namespace:
    """What was asked for on the command line."""
    parser = command_line.parser("export", __doc__, seed=True)
    parser.add_argument(
        "controller",
        help="lqg, scheduled, ppo, ppo_outdoor, pid, or the path of a controller.json or policy.zip",
    )
    parser.add_argument(
        "--vehicle", default="lama400d", help="designed on, and flown (default: %(default)s)"
    )
    parser.add_argument("--nominal", help="vehicle whose trim centres the action (default: bare)")
    parser.add_argument("--sensors", help="to fly with (default: onboard; a file has its own)")
    parser.add_argument(
        "--task", default="hover", choices=("hover", "position", "waypoints"),
        help="flown for comparison (default: %(default)s)",
    )  # fmt: skip
    parser.add_argument(
        "--seconds", type=float, default=20.0, help="of each flight (default: %(default)g)"
    )
    return parser.parse_args()


if __name__ == "__main__":
    command_line.run(main)
