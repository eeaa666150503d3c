"""Reports: self-contained, small enough to send, and saying what the findings say."""

import json
import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest

from coax_env import effects, figures, identify, load_vehicle, plain_words, report, simulate
from coax_env import simulation as sim
from coax_env.diagnosis import Diagnosis
from coax_env.engine.whiteness import Whiteness
from coax_env.identification import RunEstimate
from coax_env.prediction import ChannelReplay, RunReplay
from coax_env.report.page import figure, inline, table
from coax_env.vehicle import Parameter

LAMA = load_vehicle("lama400d")
CHANNELS = ("h", "phi", "az")


class Outline(HTMLParser):
    """Text, headings and external addresses of a page; fails on tags that do not nest."""

    VOID = ("meta", "br", "link", "img")

    def __init__(self, text):
        super().__init__()
        self.open, self.words, self.external = [], [], []
        self.feed(text)
        assert not self.open

    def handle_starttag(self, tag, attributes):
        self.external += [
            v for k, v in attributes if k in ("src", "href") and not v.startswith("#")
        ]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if not {"script", "style"} & set(self.open):
            self.words.append(data.replace("\u00a0", " "))

    @property
    def text(self):
        return " ".join("".join(self.words).split())


def replays(flight, size, diverged=False):
    rng = np.random.default_rng(0)
    runs = []
    for run in flight.runs:
        channels = {}
        for c in CHANNELS[:2]:
            rows = np.flatnonzero(np.isfinite(run.measured[c]))[::10]
            t, measured = run.t[rows], run.measured[c][rows]
            error = size * rng.standard_normal(len(t))
            channels[c] = ChannelReplay(t, measured, measured + error, error, error)
        runs.append(RunReplay(run.name, channels, diverged, {}))
    return runs


def finding(effect, twins=(), **values):
    units = {p.name: p.unit for p in effects.CATALOGUE[effect].parameters}
    return {
        "effect": effect,
        "parameters": {
            f"{effect}.{n}": {"value": v, "std": 0.04 * abs(v), "unit": units[n]}
            for n, v in values.items()
        },
        "evidence": 123.4,
        "confusable_with": list(twins),
        "channels": ["az", "h"],
    }


def entry(before, after, unit):
    return {
        "before": before, "before_refitted": 0.9 * before, "after": after, "noise": 0.05,
        "unit": unit, "ci95": [0.9 * after, 1.1 * after],
    }  # fmt: skip


def diagnosis(**changes):
    flight = simulate("lama400d", ["hover", "low_hover"], seed=1)
    rng = np.random.default_rng(1)
    innovations = {
        run.name: {"t": run.t} | {c: rng.standard_normal(len(run.t)) for c in CHANNELS}
        for run in flight.runs
    }
    gain = {
        "held_out": ["low_hover"], "horizon_s": 1.0,
        "channels": {"h": entry(0.21, 0.06, "m"), "phi": entry(0.02, 0.02, "rad")},
        "error_removed_percent": 71.4, "ci95": [66.0, 75.0], "refitted_base_percent": -0.2,
        "noise_floor_percent": 98.0,
    }  # fmt: skip
    findings = {
        "verdict": "explained",
        "causes": [
            finding("ground_effect", gain=0.5, decay=2.08),
            finding("axial_damping", ["airframe_drag"], coefficient=0.07),
        ],
        "gusts": {"force_N": [0.02] * 3, "moment_Nm": [1e-3] * 3, "memory_s": 0.5},
        "unexplained": [],
        "gain": gain,
        "next_maneuver": {
            "maneuver": "climb_descend", "why": "W.",
            "separates": ["axial_damping", "airframe_drag"],
        },
        "false_alarm_rate": 0.01,
    } | changes  # fmt: skip
    white = {c: Whiteness(0.2, 1e-9, 1.4, "hover", False) for c in CHANNELS}
    return Diagnosis(
        findings=findings,
        flight=flight,
        vehicle_before=LAMA,
        vehicle_after=LAMA.with_parameters(
            {"ground_effect.gain": Parameter(0.5, 0.02, "1", "fit <b>&")}
        ),
        replay_before=replays(flight, 0.2),
        replay_refitted=replays(flight, 0.18),
        replay_after=replays(flight, 0.05),
        innovations_before=innovations,
        innovations_after=innovations,
        whiteness={"before": white, "after": white},
        evidence_history=[("+ ground_effect", 300.0), ("axial_damping -> rotor_drag", 2.0)],
        remarks=("outliers in h removed: 12",),
        noise={"h": 0.05, "phi": 0.0087, "az": 0.1},
    )


def test_diagnosis_page_says_what_was_found():
    page = report.diagnosis_page(diagnosis(), "scripts/diagnose.py <flight>")
    text = Outline(page).text
    for words in (
        "Ground effect and axial damping explain what the simulation got wrong",
        "removes 71 % (66 to 75 %, 95 % interval)",
        "would remove 0 %",
        "+6.2 % thrust at 0.25 m",
        "gain 0.500 ± 0.020",
        "These flights cannot tell it from airframe drag",
        "Cannot be mistaken for another effect",
        "Fly next: climb descend",
        "false cause through in 1 % of them",
        "outliers in h removed: 12",
        "scripts/diagnose.py <flight>",
        "axial damping -> rotor drag",
    ):
        assert words in text or words in page, words
    assert "fit <b>" not in page


def test_pages_are_self_contained_and_small():
    page = report.diagnosis_page(diagnosis())
    assert not Outline(page).external
    assert page.count("Plotly.newPlot(plot") == 1
    assert len(page.encode()) < 6e6
    for content in re.findall(r'<script type="application/json">(.*?)</script>', page):
        assert set(json.loads(content)) == {"data", "layout"}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"verdict": "consistent", "causes": []}, "agrees with these flights"),
        (
            {
                "verdict": "unexplained",
                "causes": [],
                "unexplained": [
                    {"channel": "q", "depends_on": ["psi"], "share": 0.12, "form": "sin(3 psi)"}
                ],
            },
            "Unexplained structure is left in pitch rate",
        ),
        ({"verdict": "partly explained"}, "explain a part; something else is left"),
        ({"gain": None}, "how well this predicts is not known"),
        ({"next_maneuver": None, "false_alarm_rate": None}, "has not been calibrated"),
        ({"causes": [finding("cg_offset", x=0.05, y=0.0)]}, "outside the usual range"),
    ],
)
def test_every_verdict_has_its_words(changes, words):
    assert words in Outline(report.diagnosis_page(diagnosis(**changes))).text


def test_numbers_that_are_missing_do_not_break_the_page():
    result = diagnosis()
    lost = dict.fromkeys(("before", "before_refitted", "after", "ci95")) | {
        "noise": 0.1,
        "unit": "m",
    }
    result.findings["gain"]["channels"]["pn"] = lost
    half = entry(0.2, 0.1, "m") | {"after": None, "ci95": [None, None]}
    result.findings["gain"]["channels"]["pe"] = half
    result.findings["gain"] |= {"error_removed_percent": None, "ci95": [None, None]}
    nothing = replays(result.flight, np.nan, diverged=True)
    result = replace(result, replay_before=nothing, innovations_after={}, whiteness={})
    assert "runs away in" in Outline(report.diagnosis_page(result)).text


def test_simulation_page():
    track = sim.fly("lama400d", "lon_doublet")
    text = Outline(
        report.simulation_page([track], LAMA, sim.doublet_table(), sim.doublet_remarks())
    ).text
    assert "16 of 16 quantities agree with its equations, 6 miss what it prints" in text
    assert "K_b = 0.67" in text and "Does not hold" not in text


def test_identification_page():
    after = LAMA.with_parameters({"mass": replace(LAMA["mass"], value=0.82, std=0.002)})
    tied = replace(
        after, correlated=("mass", "inertia_xx"), correlation=np.array([[1.0, 0.97], [0.97, 1.0]])
    )
    text = Outline(report.identification_page(LAMA, tied, ["mass", "inertia_xx"])).text
    assert "Mass moved most: by 2.5 standard deviations" in text
    assert "Known only together: mass with inertia xx (0.97)" in text
    assert "0.8200 ± 0.0020 kg" in text


def test_identification_page_says_what_stays_open():
    runs = [
        RunEstimate(name, {"mass": 0.8 + k / 100}, {"mass": 0.01}, chi, 1)
        for k, (name, chi) in enumerate((("hover", 0.5), ("strange", 40.0)))
    ]
    page = report.identification_page(
        LAMA, LAMA, ["mass"], undetermined=["mass"], directions=["mass together"], by_run=runs
    )
    text = Outline(page).text
    assert "1 of them these flights do not determine: mass" in text
    assert "hover10.5yes" in text and "strange140.0no" in text  # cells run together


@pytest.fixture(scope="module")
def two_steps():
    return identify(simulate(LAMA, "lon_doublet", sensors="paper"), method="paper")


def test_two_step_page(two_steps):
    page = report.two_step_page(two_steps)
    outline = Outline(page)
    assert not outline.external and len(page.encode()) < 6e6
    text = " ".join(outline.text.split())
    assert "The paper's two steps on 1 run of lama400d" in text
    assert "1 number found" in text and "Table VIII examined" in text
    assert "C_m, α_l" in text and "hardly moves" in text
    assert "delta_lon" not in text.split("Longitudinal force")[1].split("Step 1")[0]
    moment = two_steps.modes[2].completed
    value = moment.values[moment.names.index("p")]
    assert plain_words.number(value, 3) in text
    for content in re.findall(r'<script type="application/json">(.*?)</script>', page):
        assert set(json.loads(content)) == {"data", "layout"}


# --- words and figures ----------------------------------------------------------------------------


@pytest.mark.parametrize("name", list(effects.CATALOGUE))
def test_every_effect_reads_well(name):
    parameters = effects.CATALOGUE[name].parameters
    values = {p.name: p.off + p.usual for p in parameters}
    words = plain_words.consequence(name, values, LAMA)
    assert "nan" not in words and "_" not in words and len(words) < 90
    assert not plain_words.outside_usual(name, {p.name: p.off for p in parameters})


def test_numbers_as_people_write_them():
    assert plain_words.with_std(0.5, 0.02, "1") == "0.500 ± 0.020"
    assert plain_words.with_std(-1.234, 0.1, "m/s2") == "−1.23 ± 0.10 m/s²"
    assert plain_words.with_std(2e-6, 1e-7, "N m s") == "(2.00 ± 0.10)·10^−6 N m s"
    assert plain_words.number(None) == plain_words.number(float("nan")) == "–"
    assert plain_words.number(-0.01234, 2) == "−0.012" and plain_words.number(0) == "0"
    assert plain_words.and_list(["a", "b", "c"]) == "a, b and c"
    assert plain_words.whole_percent(-0.3) == "0 %"


def test_text_is_escaped():
    assert inline("<b> **x** `y`") == "&lt;b&gt; <strong>x</strong> <code>y</code>"
    assert "<script>" not in table(["<script>"], [["<script>", "1"]])
    closing = figures.heat_map(["</script>"], ["a"], np.eye(1), [["1"]], "x")
    assert figure(closing).count("</script>") == 1


def test_rolling_rms_and_autocorrelation():
    rng = np.random.default_rng(0)
    t = np.arange(0.0, 100.0, 0.01)
    white = rng.standard_normal(len(t))
    white[::7] = np.nan
    level = figures.rolling_rms(t, 2.0 * white, np.array([20.0, 50.0]), 20.0)
    np.testing.assert_allclose(level, 2.0, rtol=0.1)
    assert np.isnan(figures.rolling_rms(t, np.full(len(t), np.nan), t[:3], 1.0)).all()
    red = np.zeros(len(t))
    for k in range(1, len(t)):
        red[k] = 0.8 * red[k - 1] + rng.standard_normal()
    np.testing.assert_allclose(figures.autocorrelation(red, 3), [1, 0.8, 0.64, 0.512], atol=0.06)


def test_figures_are_plotly_figures():
    go = pytest.importorskip("plotly.graph_objects")
    t = np.arange(0.0, 5.0, 0.01)
    for fig in (
        figures.histories(t, [("a [m]", {"x": t, "y": -t}), ("b", {"z": t})]),
        figures.plan_view(t, t, t),
        figures.prediction("h", (t, t), {"before": (t, t, 0 * t), "after": (t, t, t)}, 0.1),
        figures.gain_bars({"h": entry(0.2, 0.1, "m")}),
        figures.innovations(t, np.sin(9 * t), np.cos(9 * t)),
        figures.whiteness_bars({"h": (0.3, 0.01)}, 0.04),
        figures.evidence_steps([("+ a", 3.0)]),
        figures.parameter_moves({"mass": (1.0, 0.5)}),
        figures.heat_map(["a"], ["b"], np.ones((1, 1)), [["1"]], "x", log=True),
    ):
        go.Figure(fig).update_layout(template=figures.template())  # validates every property
