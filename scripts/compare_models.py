"""Fly controllers designed on the bare and on the corrected model on one machine, and compare them."""

import argparse
import os
from pathlib import Path
from typing import Any

import command_line

from coax_env.errors import InputError
from coax_env.files import make_folder, write_json, write_text
from coax_env.model.vehicle_file import load_vehicle, vehicle_toml
from controllers import machines, model_comparison, removable


def main() -> None:
    options = arguments()
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # small nets: more threads only get in the way

    if options.machines:
        compare_machines(options)
        return
    if world(options):
        raise InputError("--task, --wind and --turbulence go with --machines")
    model_comparison.check_machine(options.machine, options.flight)
    bare = load_vehicle(options.model)
    machine = (
        load_vehicle(options.machine) if options.machine else model_comparison.default_machine(bare)
    )
    make_folder(options.out)
    with command_line.progress("compare_models") as report_progress:
        content, result, controllers = model_comparison.compare_models(
            machine, bare, options.flight, options.out, options.episodes, round(options.steps),
            options.seed, report_progress,
        )  # fmt: skip
    write_json(options.out / "models.json", content)
    write_text(options.out / "vehicle.toml", vehicle_toml(result.vehicle_after))
    words = command_line.typed("compare_models")
    page = command_line.write_report(
        options.out / "report.html",
        lambda: model_comparison.models_page(content, controllers, machine, words),
    )

    print("hidden:", ", ".join(content["hidden"]))
    print("named: ", ", ".join(content["found"]) or "nothing")
    command_line.print_columns([model_comparison.ROW_HEADER, *model_comparison.rows(content)])
    for kind, factor in content["cost_ratio"].items():
        print(f"{kind}: {factor:.2f} times less cost with the corrected model")
    print(page)


def compare_machines(options: argparse.Namespace) -> None:
    """Many machines, drawn; results that are already in the folder are kept.

    Args:
        options: of the command line.
    """
    if options.machine or options.flight:
        raise InputError(
            "--machines draws the machines: it goes with neither --machine nor --flight"
        )
    if options.machines < 1:
        raise InputError(f"--machines must be at least 1, found {options.machines}")
    make_folder(options.out)
    kind = "truth" if options.truth else "machines"
    seeds = range(options.seed, options.seed + options.machines)
    results = []
    with command_line.progress("compare_models") as report_progress:
        for found in machines.fly_machines(
            seeds, options.model, options.out, options.episodes, round(options.steps),
            options.truth, report_progress, **world(options),
        ):  # fmt: skip
            results.append(found)
            write_json(options.out / f"{kind}.json", machines.summary(results))
    words = command_line.typed("compare_models")
    page = command_line.write_report(
        options.out / "report.html", lambda: machines.machines_page(results, words)
    )
    command_line.print_columns([machines.HEADER, *machines.rows(results)])
    print("\n".join(machines.in_words(machines.summary(results))))
    truths = machines.stored_results(options.out, seeds, truth=True)
    print("\n".join(removable.in_words([] if options.truth else results, truths)))
    print(page)


def world(options: argparse.Namespace) -> dict[str, Any]:
    """Arguments of the env that `--machines` are flown in, where not hover in still air."""
    task = {"task": options.task} if options.task != "hover" else {}
    return task | command_line.air(options)


def arguments() -> argparse.Namespace:
    """What was asked for on the command line."""
    parser = command_line.parser("compare_models", __doc__, seed=True)
    parser.add_argument(
        "--machine", metavar="FILE",
        help="the true vehicle (default: --model with motor lag, torque out of balance, rotor drag)",
    )  # fmt: skip
    parser.add_argument(
        "--machines", type=int, default=0, metavar="N",
        help="instead: N machines from --seed on, with two to four hidden effects each; resumable",
    )  # fmt: skip
    parser.add_argument(
        "--truth", action="store_true",
        help="with --machines: the machine itself for its corrected model, the most there is to gain",
    )  # fmt: skip
    parser.add_argument("--model", default="lama400d", help="the bare model (default: %(default)s)")
    parser.add_argument(
        "--flight", type=Path, metavar="FOLDER", help="its flights (default: simulated)"
    )
    parser.add_argument("--episodes", type=int, default=100, help="(default: %(default)s)")
    parser.add_argument(
        "--steps", type=float, default=4e6, help="of each policy's training; 0: no PPO"
    )
    parser.add_argument(
        "--task", default="hover", choices=["hover", "position"],
        help="with --machines: what they fly (default: hover)",
    )  # fmt: skip
    command_line.add_air(parser)
    return parser.parse_args()


if __name__ == "__main__":
    command_line.run(main)
