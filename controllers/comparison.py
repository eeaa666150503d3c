"""Controllers side by side: the same seeds, tasks, winds and vehicles for each."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from coax_env.env.actions import Nominal
from coax_env.model.vehicle import Vehicle
from coax_env.model.vehicle_file import load_vehicle
from coax_env.report import figures
from coax_env.report.page import Section, command, figure, page, prose, table
from controllers import lqr, pid, policy, state_feedback
from controllers.evaluation import evaluate, evaluate_spread
from controllers.loading import Controller

GUSTS = (0.08, 1e-3)  # [N, N m] std: some 1 % of the weight
WIND = {"wind": 2.0, "turbulence": "light"}  # [m/s] from anywhere
ROTOR_DRAG = 3.5e-4  # [N s/m per rad/s] given to a vehicle on which wind has no effect
_WIND_EFFECTS = ("rotor_drag", "body_drag", "flap_blowback")
TARGET_SENSORS = "mocap"

Maker = Callable[[Vehicle, Nominal, str, bool], Controller | None]
"""Vehicle designed on, nominal, suite, whether there is a target -> a controller, or None."""


@dataclass(frozen=True)
class Condition:
    """One column of the comparison: what is flown, and how the env is set up."""

    name: str
    vehicle: Vehicle
    sensors: str = "onboard"
    arguments: Mapping[str, Any] = field(default_factory=dict)
    spread: bool = False  # over vehicles drawn from the file's std: the worst counts

    @property
    def has_target(self) -> bool:
        """Whether there is a target other than the start."""
        return self.arguments.get("task", "hover") != "hover"


def conditions(vehicle: str | Vehicle) -> list[Condition]:
    """Hover in still air, in gusts, in wind, on drawn vehicles; a position; waypoints."""
    vehicle = load_vehicle(vehicle)
    wind_acts = any(vehicle.effects.get(name) for name in _WIND_EFFECTS)
    windy = vehicle if wind_acts else vehicle.with_effect("rotor_drag", coefficient=ROTOR_DRAG)
    return [
        Condition("hover", vehicle),
        Condition("hover in gusts", vehicle, arguments={"gusts": GUSTS}),
        Condition("hover in wind", windy, arguments=WIND),
        Condition("worst drawn vehicle", vehicle, spread=True),
        Condition("position", vehicle, TARGET_SENSORS, {"task": "position"}),
        Condition("waypoints", vehicle, TARGET_SENSORS, {"task": "waypoints"}),
    ]


def makers(ppo: Controller | None) -> dict[str, Maker]:
    """How each controller of the comparison is made; `ppo` only flies with its own sensors."""

    def trained(
        vehicle: Vehicle, nominal: Nominal, sensors: str, has_target: bool
    ) -> Controller | None:
        if isinstance(ppo, policy.Policy):
            return ppo.on(sensors) if sensors in ppo.suites.sights else None
        return ppo if ppo is not None and ppo.sensors == sensors else None

    return {
        "lqg": lambda vehicle, nominal, sensors, has_target: lqr.design(
            vehicle, nominal, sensors, lqr.BRISK if has_target else None
        ),
        "ppo": trained,
        "pid": lambda vehicle, nominal, sensors, has_target: pid.design(vehicle, nominal, sensors),
        "lqi": lambda vehicle, nominal, sensors, has_target: state_feedback.design(
            vehicle, nominal, limits=lqr.BRISK if has_target else None
        ),
    }


def compare(
    vehicle: str | Vehicle = "lama400d",
    ppo: Controller | None = None,
    episodes: int = 100,
    seconds: float = 20.0,
    vehicles: int = 50,
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
    jobs: int = 1,
    backend: str = "loky",
) -> dict[str, Any]:
    """Fly every controller in every condition.

    All but `ppo` are designed on `vehicle`; none knows of wind, gusts or draws. ``lqi`` is given
    the exact state: what it does better than ``lqg`` is what the sensors' noise costs.

    Args:
        vehicle: what flies.
        ppo: the trained policy; default the shipped one.
        episodes: flights per condition; on drawn vehicles a fifth of that for each.
        seconds: duration of a flight.
        vehicles: how many are drawn.
        seed: of the first flight, and of the draws.
        progress: called with what is being flown.
        jobs: drawn vehicles at once, as in `coax_env.workers.each`.
        backend: where, as in `coax_env.workers.each`.

    Returns:
        compare.json: condition -> controller -> score.json, None where it cannot fly that.
    """
    vehicle = load_vehicle(vehicle)
    ppo = policy.load_policy(policy.SHIPPED) if ppo is None else ppo
    found: dict[str, dict[str, Any]] = {}
    for condition in conditions(vehicle):
        row = found[condition.name] = {}
        for name, make in makers(ppo).items():
            if progress:
                progress(f"{condition.name}: {name}")
            controller = make(vehicle, None, condition.sensors, condition.has_target)
            if controller is None:
                row[name] = None
            elif condition.spread:
                row[name] = evaluate_spread(
                    controller, condition.vehicle, vehicles, max(episodes // 5, 1), seconds, seed,
                    jobs=jobs, backend=backend,
                )  # fmt: skip
            else:
                row[name] = evaluate(
                    controller, condition.vehicle, episodes, seconds, seed, **condition.arguments
                )
    return {"vehicle": vehicle.name, "episodes": episodes, "seed": seed, "conditions": found}


HEADER = (
    "condition", "controller", "success", "cost", "worst cost", "height rms", "speed rms",
    "heading rms", "effort", "reached",
)  # fmt: skip


def rows(found: Mapping[str, Mapping[str, Any]]) -> list[list[str]]:
    """The comparison in words, under HEADER."""
    return [
        [condition, name, *score_words(score)]
        for condition, row in found.items()
        for name, score in row.items()
    ]


def score_words(score: Mapping[str, Any] | None) -> list[str]:
    """A score's figures under HEADER's, without the first two columns."""
    if score is None:
        return ["-"] * (len(HEADER) - 2)

    def formatted(key: str, form: str, factor: float = 1.0) -> str:
        value = score.get(key)
        return "-" if value is None else form.format(factor * value)

    return [
        formatted("success_rate", "{:.0f} %", 100.0),
        formatted("mean_cost", "{:.3g}"),
        formatted("worst_cost", "{:.3g}"),
        formatted("height_rms_m", "{:.1f} cm", 100.0),
        formatted("velocity_rms_mps", "{:.3f} m/s"),
        formatted("heading_rms_deg", "{:.2f} deg"),
        formatted("effort", "{:.2f}"),
        formatted("mean_reached", "{:.1f}"),
    ]


def comparison_page(content: Mapping[str, Any], command_line: str = "") -> str:
    """The report as HTML text."""
    found = content["conditions"]
    names = list(next(iter(found.values())))

    def values(key: str) -> dict[str, list[float | None]]:
        return {
            name: [row[name][key] if row[name] else None for row in found.values()]
            for name in names
        }

    charts: Iterable[tuple[str, str, bool]] = (
        ("mean_cost", "quadratic cost per step, mean of all flights", True),
        ("worst_cost", "quadratic cost per step, worst flight", True),
        ("success_rate", "share of flights that succeed", False),
        ("effort", "rms of the action", False),
    )
    shown = [figure(figures.grouped_bars(list(found), values(k), t, log)) for k, t, log in charts]
    parts = [
        Section("Figures", [
            prose("Less is better, but for success. `lqi` is given the exact state and no noise: "
                  "the difference is what the sensors cost the others."),
            *shown,
        ]),
        Section("Table", [table(HEADER, rows(found))]),
    ]  # fmt: skip
    if command_line:
        parts.append(Section("How this was computed", [command(command_line)]))
    lead = [
        f"{content['episodes']} flights each from the same seeds, on {content['vehicle']}. LQG, LQI "
        "and PID are designed on the file as it is, the policy is trained as its description says; "
        "none knows of wind, gusts or what was drawn."
    ]
    return page("Controllers side by side", lead, parts, kicker="Comparison")


def ratio(worse: Mapping[str, Any], better: Mapping[str, Any]) -> float:
    """Mean cost of the one over that of the other."""
    return float(worse["mean_cost"]) / float(better["mean_cost"])


def without_repeats(header: Sequence[str], body: Sequence[Sequence[str]]) -> list[list[str]]:
    """A table for a terminal, a repeated first cell left out."""
    shown = [list(header)]
    last = ""
    for row in body:
        shown.append(["" if row[0] == last else row[0], *row[1:]])
        last = row[0]
    return shown
