"""Fly maneuvers in simulation: a flight folder, a report, and the paper's doublet as a table."""

import argparse
from dataclasses import replace
from pathlib import Path

import command_line

from coax_env import report
from coax_env.files import make_folder
from coax_env.logs.flight import write_flight
from coax_env.model.sensors import SUITES, log_suite
from coax_env.model.vehicle_file import load_vehicle, shipped_vehicles
from coax_env.simulation.maneuvers import MANEUVERS
from coax_env.simulation.paper_doublet import doublet_remarks, doublet_table
from coax_env.simulation.simulate import Gusts, fly_all, log_flight


def main() -> None:
    options = arguments()
    vehicle = load_vehicle(options.vehicle)
    names = list(MANEUVERS) if options.maneuver == "all" else options.maneuver.split(",")
    gusts = Gusts() if options.gusts else None
    suite = log_suite(options.sensors, vehicle)
    tracks = fly_all(vehicle, names, seed=options.seed, gusts=gusts)
    flight = log_flight(vehicle, tracks, suite, noise=not options.no_noise, seed=options.seed)
    papers = names == ["lon_doublet"] and vehicle.name == "lama400d" and not vehicle.effects
    table = doublet_table(vehicle) if papers else ()
    remarks = doublet_remarks(vehicle) if papers else ()
    if vehicle.name not in shipped_vehicles():
        flight = replace(flight, vehicle=str(Path(options.vehicle).resolve()))
    make_folder(options.out)
    write_flight(flight, options.out / "flight")

    if papers:
        command_line.print_columns([report.DOUBLET_HEADER, *report.doublet_rows(table)])
        for remark in remarks:
            print("holds:" if remark.holds else "DOES NOT HOLD:", remark.statement)
    for track in tracks:
        print(track.maneuver.name + ":", f"{track.t[-1]:.1f} s", track.ended)
    command = command_line.typed("simulate")
    page = command_line.write_report(
        options.out / "report.html",
        lambda: report.simulation_page(tracks, vehicle, table, remarks, command),
    )
    print(f"flight {options.out / 'flight'}, {page}")


def arguments() -> argparse.Namespace:
    """What was asked for on the command line."""
    parser = command_line.parser("simulate", __doc__, seed=True)
    parser.add_argument(
        "--maneuver", default="lon_doublet", metavar="NAME,NAME",
        help=f"what is flown, or all: {', '.join(MANEUVERS)} (default: %(default)s)",
    )  # fmt: skip
    parser.add_argument("--vehicle", default="lama400d", help="shipped name or TOML file")
    parser.add_argument(
        "--sensors", default="onboard", help=f"{', '.join(SUITES)} (default: %(default)s)"
    )
    parser.add_argument("--no-noise", action="store_true", help="log without sensor noise")
    parser.add_argument("--gusts", action="store_true", help="fly in light gusts")
    return parser.parse_args()


if __name__ == "__main__":
    command_line.run(main)
