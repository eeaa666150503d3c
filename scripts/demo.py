"""The main job on a bundled flight: where the simulation is wrong, why, and what mending it is worth.

The bundled flight is synthetic: an independent simulator flew it with effects hidden in it, and
truth.json beside it says which. Where ../shared/flights/skybotix_coax is present, real flights of a
real helicopter follow.
"""

import json
from pathlib import Path
from time import monotonic

import command_line
import diagnose as diagnose_script

import coax_env
from coax_env import plain_words
from coax_env.diagnosis.diagnose import Diagnosis, diagnose
from coax_env.files import write_json
from coax_env.logs.flight import read_flight
from coax_env.model.vehicle import Vehicle
from coax_env.model.vehicle_file import load_vehicle
from coax_env.report import FlownControllers
from controllers import mended

PACKAGE = Path(coax_env.__file__).resolve().parent
BUNDLED = PACKAGE / "logs" / "flights" / "windy"
REAL = PACKAGE.parent.parent / "shared" / "flights" / "skybotix_coax"


def main() -> None:
    parser = command_line.parser("demo", __doc__)
    parser.add_argument("--no-real", action="store_true", help="leave the real flights out")
    options = parser.parse_args()
    start = monotonic()

    print("1. A measured flight: 12 runs of a Lama 400D, synthetic, from an independent simulator.")
    result = look("demo", BUNDLED, None)
    truth = json.loads((BUNDLED / "truth.json").read_text())
    print(f"   hidden in it, for comparison: {', '.join(truth['hidden'])}\n")

    print(
        "2. A hover controller designed on the bare and on the mended model (LQG, python-control),"
    )
    print("   both flown in CoaxHeli-v0 on the machine as it truly is, 20 episodes of 20 s:")
    flown = fly(result, true_vehicle(truth), options.out)
    save(result, options.out, flown)

    if REAL.is_dir() and not options.no_real:
        print(
            "\n3. Real flights of a Skybotix CoaX (M. Faessler, GRASP Lab, 2011): fitted on hover and"
        )
        print("   vertical_sine, predicted on circles, which the fit has not seen.")
        save(look("real", REAL, ["circles"]), options.out / "real")
    print(f"\n{monotonic() - start:.0f} s in all. Open {options.out / 'report.html'} in a browser.")


def look(name: str, flight: Path, hold_out: list[str] | None) -> Diagnosis:
    """Diagnose a flight and print what was found."""
    with command_line.progress(name) as say:
        result = diagnose(read_flight(flight), hold_out=hold_out, progress=say)
    print_errors(result)
    print(indented(diagnose_script.summary(result)))
    return result


def save(result: Diagnosis, out: Path, flown: FlownControllers | None = None) -> None:
    """Write a diagnosis and its report."""
    command = f"scripts/diagnose.py {result.flight.path} --out {out}"
    diagnose_script.save(result, out, command, flown)
    print(f"   report: {out / 'report.html'}")


def print_errors(result: Diagnosis) -> None:
    """Where the bare simulation departs, in one line."""
    gain = result.findings["gain"]
    worst = sorted(
        gain["channels"].items(),
        key=lambda item: -(item[1]["before"] or 0.0) / item[1]["noise"],
    )[:4]
    words = ", ".join(
        f"{plain_words.channel_name(c)} {e['before']:.2g} -> {e['after']:.2g} {e['unit']}"
        for c, e in worst
    )
    print(f"   1 s prediction error on held-out runs, bare -> mended: {words}")


def indented(text: str) -> str:
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


def fly(result: Diagnosis, machine: Vehicle, out: Path) -> FlownControllers:
    """LQG designed on each model, flown on the true machine."""
    bare = load_vehicle("lama400d")
    flown = mended.before_and_after(bare, result.vehicle_after, machine)
    rows = [["", "success", "cost", "height rms", "speed rms", "heading rms", "drift"]]
    for name, (controller, score) in flown.items():
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
    return mended.flown_controllers(flown, "the machine as it truly is")


if __name__ == "__main__":
    command_line.run(main)
