"""The main job on a bundled flight: where the simulation is wrong, why, and what correcting it gains.

The bundled flight is synthetic: an independent simulator flew it with effects hidden in it, and
truth.json beside it says which. Where recorded flights of a Skybotix CoaX are
present, they follow.
"""

import json
import shlex
import sys
from pathlib import Path
from time import monotonic

import command_line
import diagnose as diagnose_script

import coax_env
from coax_env import plain_words
from coax_env.diagnosis.diagnose import SHARES, Diagnosis, diagnose
from coax_env.estimation.compile_ahead import fill_cache
from coax_env.files import write_json
from coax_env.logs.flight import read_flight
from coax_env.model.vehicle import Vehicle
from coax_env.model.vehicle_file import load_vehicle
from coax_env.report import ControllerScores
from controllers import model_comparison

PACKAGE = Path(coax_env.__file__).resolve().parent
BUNDLED = PACKAGE / "logs" / "flights" / "windy"
REAL = PACKAGE.parent.parent / "shared" / "flights" / "skybotix_coax"
CHANNELS_PRINTED = 4


def main() -> None:
    parser = command_line.parser("demo", __doc__)
    parser.add_argument("--no-real", action="store_true", help="leave the real flights out")
    options = parser.parse_args()
    start = monotonic()

    print("1. A measured flight: 12 runs of a Lama 400D, synthetic, from an independent simulator.")
    fill_cache()
    result = diagnose_and_print("demo", BUNDLED, None)
    truth = json.loads((BUNDLED / "truth.json").read_text())
    print(f"   hidden in it, for comparison: {', '.join(truth['hidden'])}\n")

    print(
        "2. A hover controller (LQG, python-control) designed on the bare and on the corrected model,"
    )
    print("   both flown in CoaxHeli-v0 on the true machine, 20 episodes of 20 s:")
    scores = compare_controllers(result, true_vehicle(truth), options.out)
    save(result, options.out, shlex.join(["scripts/demo", *sys.argv[1:]]), scores)

    if REAL.is_dir() and not options.no_real:
        print(
            "\n3. Real flights of a Skybotix CoaX (M. Faessler, GRASP Lab, 2011): fitted on hover"
        )
        print("   and vertical_sine, predicted on circles, which is held out of the fit.")
        real = diagnose_and_print("real", REAL, ["circles"])
        out = options.out / "real"
        save(real, out, f"scripts/diagnose.py {REAL} --hold-out circles --out {out}")
    print(f"\n{monotonic() - start:.0f} s in all. Open {options.out / 'report.html'} in a browser.")


def diagnose_and_print(name: str, flight: Path, hold_out: list[str] | None) -> Diagnosis:
    """Diagnose a flight and print the findings.

    Args:
        name: shown with the progress.
        flight: its folder.
        hold_out: runs on which the gain is measured; None: chosen by the diagnosis.
    """
    with command_line.progress(name, SHARES) as report_progress:
        result = diagnose(read_flight(flight), hold_out=hold_out, progress=report_progress)
    print_errors(result)
    print(indented(diagnose_script.summary(result)))
    return result


def save(
    result: Diagnosis, out: Path, command: str, scores: ControllerScores | None = None
) -> None:
    """Write a diagnosis and its report.

    Args:
        result: of the diagnosis.
        out: folder of the results.
        command: that makes them again.
        scores: of controllers designed on both models.
    """
    print(f"   {diagnose_script.save(result, out, command, scores)}")


def print_errors(result: Diagnosis) -> None:
    """Errors of both models in the channels in which the bare one errs most, in one line."""
    gain = result.findings["gain"]
    worst = sorted(
        gain["channels"].items(),
        key=lambda item: -(item[1]["before"] or 0.0) / item[1]["noise"],
    )[:CHANNELS_PRINTED]
    words = ", ".join(
        f"{plain_words.channel_name(c)} {e['before']:.2g} -> {e['after']:.2g} {e['unit']}"
        for c, e in worst
    )
    print(f"   1 s prediction error on held-out runs, bare -> corrected: {words}")


def indented(text: str) -> str:
    """Every line three columns to the right."""
    return "\n".join("   " + line for line in text.splitlines())


def true_vehicle(truth: dict) -> Vehicle:
    """The bundled flight's machine, from its truth.json."""
    values = truth["values"]
    p, q, r = values["gyro_bias"]
    return (
        load_vehicle("lama400d")
        .with_effect("motor_lag", upper=values["motor_tau"], lower=values["motor_tau"])
        .with_effect("rotor_drag", coefficient=values["kdrag"])
        .with_effect("wind", north=values["wn"], east=values["we"])
        .with_effect("gyro_bias", x=p, y=q, z=r)
    )


def compare_controllers(result: Diagnosis, machine: Vehicle, out: Path) -> ControllerScores:
    """Design an LQG on each model, fly both on the true machine, print and write the scores.

    Args:
        result: of the diagnosis, with both models.
        machine: the true vehicle.
        out: folder of the controllers and scores.
    """
    bare = load_vehicle("lama400d")
    designs = model_comparison.lqg_of_both(bare, result.vehicle_after, machine)
    rows = [["", "success", "cost", "height rms", "speed rms", "heading rms", "drift"]]
    for name, (controller, score) in designs.items():
        controller.save(out / f"controller_{name}.json")
        write_json(out / f"score_{name}.json", score)
        rows.append(
            [
                f"   {name}",
                f"{100 * score['success_rate']:.0f} %",
                f"{score['mean_cost']:.3g}",
                f"{100 * score['height_rms_m']:.1f} cm",
                f"{score['velocity_rms_mps']:.3f} m/s",
                f"{score['heading_rms_deg']:.2f} deg",
                f"{score['drift_m']:.2f} m",
            ]
        )
    command_line.print_columns(rows)
    return model_comparison.controller_scores(designs, "the true machine")


if __name__ == "__main__":
    command_line.run(main)
