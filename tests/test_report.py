"""Reports: self-contained, small enough to send, and saying what the findings say."""

import asyncio
import json
import math
import re
from dataclasses import replace
from html.parser import HTMLParser

import browser
import diagnose as diagnose_script
import numpy as np
import pytest

from coax_env import derivative, hover_trim, identify, load_vehicle, plain_words, report, simulate
from coax_env.diagnosis.diagnose import Diagnosis
from coax_env.estimation.prediction import ChannelReplay, RunReplay
from coax_env.estimation.trajectories import RESTART, trajectories
from coax_env.estimation.whiteness import Whiteness
from coax_env.identification.maximum_likelihood import RunEstimate
from coax_env.model import effects
from coax_env.model.layout import STATES
from coax_env.model.vehicle import Parameter
from coax_env.report import causes, consequences, figures, fit_figures, plot_style, trust_banner
from coax_env.report.flight_view import flight_view
from coax_env.report.page import card, figure, inline, table
from coax_env.simulation import simulate as sim
from coax_env.simulation.paper_doublet import doublet_remarks, doublet_table

LAMA = load_vehicle("lama400d")
CHANNELS = ("h", "phi", "az")


class Outline(HTMLParser):
    """Text, headings and external addresses of a page; fails on tags that do not nest."""

    VOID = ("meta", "br", "link", "img", "input")

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
            f"{effect}.{n}": {
                "value": v,
                "std": 0.04 * abs(v),
                "unit": units[n],
                "determined": v != 0.0,
            }
            for n, v in values.items()
        },
        "evidence": 123.4,
        "confusable_with": list(twins),
        "channels": ["az", "h"],
        "robust": {"noise": True, "runs": 1.0, "kept": 0.95 - 0.5 * bool(twins)},
        "trust": "doubtful" if twins else "sure",
        "doubts": [
            f"these flights cannot distinguish it from {plain_words.plain(t)}" for t in twins
        ],
        "since": None,
        "unseen": None if twins else {"nats": 41.2, "expected": 40.0, "std": 9.0},
        "where_most": None if twins else {"share": 0.062, "size": 0.98, "std": 0.04},
    }


def entry(before, after, unit):
    return {
        "before": before, "before_refitted": 0.9 * before, "after": after, "noise": 0.05,
        "persistence": 2.0 * before, "unit": unit, "ci95": [0.9 * after, 1.1 * after],
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
        "noise_floor_percent": 98.0, "persistence_percent": -30.2, "black_box_percent": 45.6,
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
        "model_check": {"words": ["heading: its 1 s error is 2.3 times what it should be"]},
        "class": {"rate_hz": 100.0, "calibrated": "flights of the study", "why": ""},
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


def score(cost):
    return {
        "success_rate": 0.95, "mean_cost": cost, "height_rms_m": 0.02, "velocity_rms_mps": 0.1,
        "heading_rms_deg": 3.0 * cost, "drift_m": 0.4, "episodes": 20, "seconds": 20.0,
    }  # fmt: skip


SCORES = report.ControllerScores(
    {"bare": score(1.75), "corrected": score(0.5)}, "the machine itself", "An LQG of each."
)


@pytest.fixture(scope="session")
def made(tmp_path_factory):
    """What scripts/diagnose.py writes for the diagnosis above, its controllers flown."""
    out = tmp_path_factory.mktemp("report") / "out"
    diagnose_script.save(diagnosis(), out, "scripts/diagnose.py <flight>", SCORES)
    return out


def test_diagnosis_page_says_what_was_found(made):
    page = (made / "report.html").read_text(encoding="utf-8")
    text = Outline(page).text
    for words in (
        "Ground effect and, doubtful, axial damping explain what the simulation got wrong",
        "71 % of the error of a 1 s prediction is gone on runs held out of the fit",
        "66 to 75 %, 95 % interval",
        "0 % by refitting alone",
        "46 % by a black box of 318 generic terms",
        "Two runs of a lama400d",
        "the bare model misses height by 0.21 m (4.2 times the sensor's noise)",
        "+6.2 % (5.1 to 7.4) thrust at 0.25 m",
        "16 sigma, 123 nats",
        "These flights cannot distinguish it from airframe drag",
        "Within the catalogue and this class of noise no other effect fits these flights equally well",
        "Sure. These names hold at half and twice every noise level",
        "Doubtful. With these the model predicts better",
        "98 % expected of a perfect model",
        "−30 % by saying that nothing moves",
        "Heading: its 1 s error is 2.3 times what it should be.",
        "Causes that are sure",
        "Sure: ground effect. Doubtful: axial damping",
        "Axial damping or airframe drag",
        "5 nats are odds of 150 to 1",
        "Fly next: climb descend. It separates axial damping and airframe drag: W.",
        "is calibrated on flights of the study without any effect: a cause is named in 1 % of them",
        "nothing but noise and gusts is left",
        "outliers in h removed: 12",
        "Flown on the machine itself, 20 flights of 20 s each",
        "95 % with the bare model's and 95 % with the corrected model's",
        "scripts/diagnose.py <flight>",
        "axial damping -> rotor drag",
    ):
        assert words in text or words in page, words
    assert "fit <b>" not in page


def test_pages_are_self_contained_and_small(made):
    page = (made / "report.html").read_text(encoding="utf-8")
    assert not Outline(page).external
    assert page.count("Plotly.newPlot(plot") == 1
    assert len(page.encode()) < 5e6
    contents = re.findall(r'<script type="application/json">(.*?)</script>', page)
    assert all({"data", "layout"} == set(c) or "runs" in c for c in map(json.loads, contents))


# --- as a browser shows it ------------------------------------------------------------------------

LIBRARY = """
const rest = time => new Promise(done => setTimeout(done, time));
const part = name => document.querySelector(`.flight [data-part="${name}"]`);
const tell = (one, kind) => one.dispatchEvent(new Event(kind));
const shown = one => one.checkVisibility();
const picture = () => document.querySelector('.scene').toDataURL();
async function scroll() { // lazy figures are drawn as they come near
  await library;
  const root = document.documentElement;
  for (let y = 0; y < root.scrollHeight; y += 700) { scrollTo(0, y); await rest(60); }
  scrollTo(0, 0);
}
function colours(canvas) {
  const copy = new OffscreenCanvas(canvas.width, canvas.height).getContext('2d');
  copy.drawImage(canvas, 0, 0);
  const {data} = copy.getImageData(0, 0, canvas.width, canvas.height);
  return new Set(new Uint32Array(data.buffer)).size;
}
function state() {
  const words = [...document.querySelectorAll('body *')].filter(one => shown(one) &&
    [...one.childNodes].some(n => n.nodeType === 3 && n.textContent.trim()));
  return {
    wide: document.documentElement.scrollWidth, screen: document.documentElement.clientWidth,
    smallest: Math.min(...words.map(one => parseFloat(getComputedStyle(one).fontSize))),
    plots: [...document.querySelectorAll('.plot')].filter(shown).map(plot => ({
      marks: plot.querySelectorAll('.trace path, .points path, .point, .shapelayer path').length,
      right: Math.max(0, ...[...plot.querySelectorAll('.main-svg')].map(
        svg => svg.getBoundingClientRect().right)),
      ink: plot.layout ? plot.layout.template.layout.font.color : 'not drawn'})),
    canvases: [...document.querySelectorAll('canvas')].filter(shown).map(colours),
    ground: getComputedStyle(document.body).backgroundColor,
    folded: [...document.querySelectorAll('details.numbers')].filter(one => !one.open).length,
    buttons: [...document.querySelectorAll('button')].filter(shown).length,
  };
}
"""

EVERY_CHOICE = """(async () => {
  const found = [];
  document.querySelectorAll('details').forEach(one => { one.open = true; });
  for (const chooser of document.querySelectorAll('.chooser')) {
    const [first, second] = chooser.querySelectorAll('select');
    for (const a of first.options) for (const b of second.options) {
      first.value = a.value; second.value = b.value; tell(first, 'change');
      await rest(50);
      const choice = chooser.querySelector('.choice:not([hidden])');
      if (choice) found.push([choice.dataset.key, choice.querySelectorAll('.trace').length]);
    }
  }
  return found;
})()"""

PLAY = """(async () => {
  const slider = part('time'), play = part('play'), run = part('run'), seen = {runs: []};
  slider.value = slider.min; tell(slider, 'input');
  const [first, start] = [picture(), part('clock').textContent];
  part('speed').value = '4';
  play.click(); await rest(800);
  seen.while = play.textContent;
  play.click();
  seen.clock = [start, part('clock').textContent];
  seen.moved = picture() !== first && Number(slider.value) > Number(slider.min);
  const paused = picture(); await rest(200);
  seen.stays = picture() === paused;
  slider.value = slider.max; tell(slider, 'input');
  seen.end = part('clock').textContent;
  for (const option of run.options) {
    run.value = option.value; tell(run, 'change');
    seen.runs.push([option.value, part('words').textContent, picture()]);
  }
  const all = picture();
  document.querySelector('[data-model="0"]').click();
  seen.hidden = picture() !== all;
  return seen;
})()"""


async def look(page):
    """Everything about the report that the tests below ask."""
    found = {"touched": []}
    await page.ask(f"{LIBRARY}; scroll()")
    found["desk"] = await page.ask("state()")
    found["numbers"] = await page.ask(
        "[...document.querySelectorAll('data')].map("
        "d => [d.dataset.of, d.value, d.textContent, Number(d.dataset.factor || 1)])"
    )
    found["played"] = await page.ask(PLAY)
    found["choices"] = await page.ask(EVERY_CHOICE)
    await page.ask("document.querySelectorAll('details').forEach(one => { one.open = false; })")
    for name, dark in (("phone", False), ("dark", True)):
        await page.show(browser.PHONE, dark)
        await page.ask("scroll().then(() => rest(500))")
        found[name] = await page.ask("state()")
    await page.ask("document.querySelector('.scene').scrollIntoView({block: 'center'})")
    box = await page.ask(
        "(r => [r.x, r.y])(document.querySelector('.scene').getBoundingClientRect())"
    )
    for x in (150, 190, 230):
        kind = "touchStart" if x == 150 else "touchMove"
        point = {"x": box[0] + x, "y": box[1] + 100}
        await page.send("Input.dispatchTouchEvent", type=kind, touchPoints=[point])
        await asyncio.sleep(0.1)
        found["touched"].append(await page.ask("picture()"))
    await page.send("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])
    await page.show((700, 900), dark=True, paper=True)
    await page.ask("tell(window, 'beforeprint'); rest(800)")
    found["paper"] = await page.ask("state()")
    await page.ask("tell(window, 'afterprint')")
    await page.show(browser.DESK)
    found["after"] = await page.ask("rest(300).then(state)")
    found["pdf"] = await page.print()
    found["faults"] = page.faults
    return found


@pytest.fixture(scope="session")
def seen(made):
    return browser.visit(made / "report.html", look)


@pytest.mark.slow
@browser.needed
def test_the_console_is_silent(seen):
    assert seen["faults"] == []


@pytest.mark.slow
@browser.needed
def test_every_figure_is_drawn(seen):
    for screen in ("desk", "phone", "dark", "paper"):
        state = seen[screen]
        assert len(state["plots"]) >= 3 and all(p["marks"] for p in state["plots"]), screen
        assert len(state["canvases"]) == 2 and all(c > 5 for c in state["canvases"]), screen
    assert len(seen["choices"]) > 6 and all(traces for _, traces in seen["choices"])


@pytest.mark.slow
@browser.needed
def test_every_number_shown_is_that_of_findings_json(seen, made):
    findings = json.loads((made / "findings.json").read_text())
    shown = set()
    for place, exact, text, factor in seen["numbers"]:
        value = findings
        for step in place.split("/"):
            value = value[int(step) if isinstance(value, list) else step]
        assert float(exact) == value, place
        assert factor in (1.0, pytest.approx(180.0 / math.pi)), place
        digits, _, power = re.search(r"-?[\d.]+(e-?\d+)?", text.replace("−", "-"))[0].partition("e")
        unit = 10.0 ** (int(power or 0) - len(digits.partition(".")[2]))
        assert abs(float(digits) * 10.0 ** int(power or 0) - factor * value) <= 0.5001 * unit, (
            place,
            text,
        )
        shown.add(place)
    for k, cause in enumerate(findings["causes"]):
        assert f"causes/{k}/evidence" in shown
        for name in cause["parameters"]:
            assert {f"causes/{k}/parameters/{name}/{x}" for x in ("value", "std")} <= shown
    for channel in findings["gain"]["channels"]:
        keys = ("before", "before_refitted", "after", "noise", "ci95/0", "ci95/1")
        assert {f"gain/channels/{channel}/{key}" for key in keys} <= shown
    whole = ("error_removed_percent", "refitted_base_percent", "noise_floor_percent",
             "black_box_percent", "ci95/0", "ci95/1")  # fmt: skip
    assert {f"gain/{key}" for key in whole} <= shown


@pytest.mark.slow
@browser.needed
def test_the_page_fits_a_phone(seen):
    for screen in ("phone", "dark"):
        assert seen[screen]["screen"] == browser.PHONE[0]
        assert seen[screen]["wide"] <= browser.PHONE[0]
        assert all(p["right"] <= browser.PHONE[0] for p in seen[screen]["plots"])
    assert all(seen[screen]["smallest"] >= 13.9 for screen in ("desk", "phone", "dark"))


@pytest.mark.slow
@browser.needed
def test_the_reader_chooses_light_or_dark(seen):
    grounds, inks = [], []
    for screen in ("phone", "dark", "paper"):
        grounds.append(sum(map(int, re.findall(r"\d+", seen[screen]["ground"])[:3])))
        inks.append({p["ink"] for p in seen[screen]["plots"]})
    assert grounds[0] > 700 and grounds[1] < 150 and grounds[2] > 700  # paper is white
    assert inks[0] == inks[2] == {plot_style.plotly_template(False)["layout"]["font"]["color"]}
    assert inks[1] == {plot_style.plotly_template(True)["layout"]["font"]["color"]}


@pytest.mark.slow
@browser.needed
def test_the_page_prints(seen):
    """Figures fit the sheet, the tables are open, nothing is left to click; all as before after."""
    paper = seen["paper"]
    assert paper["wide"] <= 700 and all(p["right"] <= 700 for p in paper["plots"])
    assert paper["folded"] == 0 and paper["buttons"] == 0
    assert seen["after"]["folded"] == 3 and seen["after"]["buttons"] == seen["desk"]["buttons"]
    assert seen["pdf"].startswith(b"%PDF") and len(seen["pdf"]) > 50_000


@pytest.mark.slow
@browser.needed
def test_the_flight_is_replayed(seen):
    played = seen["played"]
    assert played["moved"] and played["while"] == "Pause" and played["stays"] and played["hidden"]
    start, now, end = (float(w.split()[0]) for w in (*played["clock"], played["end"]))
    assert start == 0.0 and 1.0 < now < 8.0 < end
    names, words, pictures = zip(*played["runs"], strict=True)
    assert {n.split(" ")[0] for n in names} == {"hover", "low_hover"}
    assert "low_hover (held out of the fit)" in names and len(set(pictures)) == 2
    for text in words:
        assert re.fullmatch(r"bare [\d.]+ m off, corrected [\d.]+ m off", text)


@pytest.mark.slow
@browser.needed
def test_a_finger_turns_the_flight(seen):
    assert len(set(seen["touched"])) == 3


# --- what a page says -----------------------------------------------------------------------------


@pytest.mark.slow
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
        (
            {
                "verdict": "unexplained",
                "causes": [],
                "unexplained": [
                    {
                        "channel": "r",
                        "depends_on": [],
                        "share": 0.1,
                        "form": "as yaw damping would",
                        "like": "yaw_damping",
                        "evidence": 75.2,
                        "why": ["it is at its limit"],
                    }
                ],
            },
            "worth 75.2 nats. The model has it, but it has no name: it is at its limit.",
        ),
        ({"verdict": "partly explained"}, "explain a part of what the simulation got wrong"),
        ({"gain": None}, "how well this predicts is not known"),
        (
            {"false_alarm_rate": None, "class": {"why": "not like those: rate hz 25"}},
            "is not known for flights of this class (not like those: rate hz 25)",
        ),
        (
            {"causes": [finding("cg_offset", ["wind"], x=0.05, y=0.0)]},
            "The model predicts better with CG offset; the name is doubtful",
        ),
        ({"causes": [finding("cg_offset", x=0.05, y=0.0)]}, "not determined"),
    ],
)
def test_every_verdict_has_its_words(changes, words):
    assert words in Outline(report.diagnosis_page(diagnosis(**changes))).text


SURE = [finding("ground_effect", gain=0.5, decay=2.08)]
DOUBTFUL = [finding("axial_damping", ["airframe_drag"], coefficient=0.07)]


def gain_of(low):
    return {"error_removed_percent": 50.0, "ci95": [low, 70.0], "persistence_percent": -1.0}


@pytest.mark.parametrize(
    ("changes", "kind", "words"),
    [
        ({}, "good", "the names and the model"),
        ({"gain": None}, "good", "the names and the model"),
        ({"verdict": "consistent", "causes": []}, "good", "may be used as it is"),
        ({"causes": SURE + DOUBTFUL}, "note", "the sure names"),
        ({"unexplained": [{"channel": "q"}]}, "note", "the sure names"),
        ({"model_check": {"words": ["roll: it is less"]}}, "note", "the sure names"),
        ({"causes": DOUBTFUL}, "warning", "no name"),
        ({"verdict": "unexplained", "causes": []}, "warning", "no name"),
        ({"gain": gain_of(-3.0)}, "warning", "chance"),
    ],
)
def test_the_banner_says_how_far_to_trust(changes, kind, words):
    found = {
        "verdict": "explained", "causes": SURE, "unexplained": [], "gain": gain_of(30.0),
        "model_check": {"words": []},
    }  # fmt: skip
    said = trust_banner.how_far(found | changes)
    assert said[0] == kind and words in said[1]


def test_synthetic_flights_are_called_so():
    result = diagnosis()
    assert result.flight.synthetic  # simulate() says so
    assert "synthetic flight" in Outline(report.diagnosis_page(result)).text
    real = replace(result, flight=replace(result.flight, synthetic=False))
    assert "synthetic" not in Outline(report.diagnosis_page(real)).text


def test_where_the_model_flies_worse_the_error_is_larger():
    """Not "-16 % of the error is gone"."""
    result = diagnosis()
    result.findings["gain"] |= {"error_removed_percent": -16.2, "ci95": [-37.0, 1.0]}
    text = Outline(report.diagnosis_page(result)).text
    assert "the error of a 1 s prediction is 16 % larger on runs held out of the fit" in text
    assert "On runs that it has not seen the error is 16 % larger (−37 to 1)." in text
    assert "error is gone" not in text


def test_angles_are_read_in_degrees_and_a_spin_is_called_so():
    result = diagnosis()
    channels = result.findings["gain"]["channels"]
    channels["phi"] = entry(0.1, 0.02, "rad")
    channels["psi"] = entry(5.9, 0.02, "rad")
    text = Outline(report.diagnosis_page(result)).text
    assert "roll by 5.7°" in text and "heading altogether: it spins" in text
    assert "rad/s" not in text and " rad " not in text


def test_numbers_that_are_missing_do_not_break_the_page():
    result = diagnosis()
    lost = dict.fromkeys(("before", "before_refitted", "after", "persistence", "ci95")) | {
        "noise": 0.1,
        "unit": "m",
    }
    result.findings["gain"]["channels"]["pn"] = lost
    half = entry(0.2, 0.1, "m") | {"after": None, "ci95": [None, None]}
    result.findings["gain"]["channels"]["pe"] = half
    result.findings["gain"] |= {"error_removed_percent": None, "ci95": [None, None]}
    nothing = replays(result.flight, np.nan, diverged=True)
    result = replace(result, replay_before=nothing, innovations_after={}, whiteness={})
    assert "diverges in" in Outline(report.diagnosis_page(result)).text


def test_simulation_page():
    track = sim.fly("lama400d", "lon_doublet")
    text = Outline(report.simulation_page([track], LAMA, doublet_table(), doublet_remarks())).text
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


@pytest.mark.slow
def test_two_step_page(two_steps):
    page = report.two_step_page(two_steps)
    outline = Outline(page)
    assert not outline.external and len(page.encode()) < 5e6
    text = " ".join(outline.text.split())
    assert "The paper's two steps on 1 run of lama400d" in text
    assert "1 parameter found" in text and "Table VIII examined" in text
    assert "C_m, α_l" in text and "hardly moves" in text
    assert "delta_lon" not in text.split("Longitudinal force")[1].split("Step 1")[0]
    moment = two_steps.modes[2].completed
    value = moment.values[moment.names.index("p")]
    assert plain_words.number(value, 3) in text
    for content in re.findall(r'<script type="application/json">(.*?)</script>', page):
        assert set(json.loads(content)) == {"data", "layout"}


# --- what causes mean -----------------------------------------------------------------------------


def usual(name, side=1.0):
    """A cause of usual size with stds of a tenth of it."""
    values = {p.name: p.off + side * p.usual for p in effects.CATALOGUE[name].parameters}
    return finding(name, **values)


@pytest.mark.parametrize("name", list(effects.CATALOGUE))
def test_every_effect_reads_well(name):
    """What it does, with a number, its unit and interval."""
    parameters = effects.CATALOGUE[name].parameters
    for side in (1.0, -1.0):
        if side < 0.0 and any(p.lower > p.off - p.usual for p in parameters):
            continue
        words = consequences.described(usual(name, side), LAMA, LAMA)
        assert "nan" not in words and "_" not in words and "inf" not in words
        number = r"[+−]?\d[\d.]*( ?(%|°|°/s|°/s²|ms|s|g|mm|m/s|m/s²))? \([−\d.]+ to [−\d.]+\)"
        assert re.search(number, words), words
        assert len(words.split(" ")) > 6, words


def stated(name, **values):
    """The numbers of an effect, in the catalogue's order."""
    size = len(values)
    found = consequences.consequences(name, values, np.zeros((size, size)), LAMA)
    return [c.value for c in found]


AT_HOVER = [
    ("torque_balance", {"scale": 0.05}, {}, "r", lambda found: -np.radians(found[1])),
    ("ground_effect", {"gain": 0.3}, {"z": -0.25}, "w", lambda found: -9.804 * found[0] / 100),
    ("ground_effect", {"gain": 0.3}, {"z": -0.5}, "w", lambda found: -9.804 * found[1] / 100),
    ("axial_damping", {"coefficient": 0.1}, {"w": -1.0}, "w", lambda found: -9.804 * found[0] / 100),
    ("rotor_drag", {"coefficient": 4e-4}, {"u": 1.0}, "u", lambda found: -found[0]),
    ("airframe_drag", {"area_x": 0.02}, {"u": 3.0}, "u", lambda found: -found[0]),
    ("airframe_drag", {"area_y": 0.01}, {"v": 3.0}, "v", lambda found: -found[1]),
    ("position_spring", {"stiffness": 0.2}, {"x": 1.0}, "u", lambda found: -found[0]),
    ("yaw_damping", {"coefficient": 4e-3}, {"r": np.pi / 2}, "r", lambda found: -np.radians(found[0])),
    ("rate_damping", {"coefficient": 4e-3}, {"p": np.pi / 2}, "p", lambda found: -np.radians(found[0])),
    ("rate_damping", {"coefficient": 4e-3}, {"q": np.pi / 2}, "q", lambda found: -np.radians(found[1])),
]  # fmt: skip


@pytest.mark.parametrize(("name", "values", "moved", "rate", "expected"), AT_HOVER)
def test_what_is_said_of_an_effect_is_what_the_model_does(name, values, moved, rate, expected):
    """The change that an effect makes to the state's rates, from the bare model's hover."""
    names = [state for state, _ in STATES]
    state, command = hover_trim(LAMA)
    for key, value in moved.items():
        state[names.index(key)] = value
    with_it = derivative(state, command, LAMA.with_effect(name, **values))
    change = (with_it - derivative(state, command, LAMA))[names.index(rate)]
    assert change == pytest.approx(expected(stated(name, **values)), rel=0.03)


@pytest.mark.parametrize(
    ("name", "values", "place"),
    [("added_mass", {"mass": 0.05}, 1), ("thrust_scale", {"scale": -0.07}, 1)],
)
def test_the_rotor_speed_to_hover_is_the_trim_s(name, values, place):
    bare, changed = (hover_trim(v)[1][:2].mean() for v in (LAMA, LAMA.with_effect(name, **values)))
    assert 100.0 * (changed / bare - 1.0) == pytest.approx(stated(name, **values)[place], rel=0.02)


def test_intervals_hold_what_the_covariance_says():
    """Against draws: 95 % of what the parameters' spread makes of a consequence."""
    values = {"gain": 0.5, "decay": 2.0}
    covariance = np.array([[0.02**2, 0.7 * 0.02 * 0.1], [0.7 * 0.02 * 0.1, 0.1**2]])
    found = consequences.consequences("ground_effect", values, covariance, LAMA)[0]
    draws = np.random.default_rng(0).multivariate_normal(list(values.values()), covariance, 20_000)
    rises = 100.0 * draws[:, 0] * np.exp(-draws[:, 1] * 0.25 / 0.25)
    low, high = np.percentile(rises, [2.5, 97.5])
    assert (found.value - found.half_width, found.value + found.half_width) == pytest.approx(
        (low, high), rel=0.03
    )


@pytest.mark.parametrize(
    ("at_once", "grown", "words"),
    [(1.0, None, "since 6.2 s (5.8 to 6.6) of run hover"),
     (0.0, {"run": "circles", "t": 1.3, "std": 0.3},
      "growing since 6.2 s (5.8 to 6.6) of run hover, grown at 1.3 s (0.7 to 1.9) of run circles"),
     (0.6, None, "since 6.2 s (5.8 to 6.6) of run hover (whether it came at once or grew, these"
      " flights do not tell)")],
)  # fmt: skip
def test_when_a_cause_came_is_said_in_words(at_once, grown, words):
    moment = {"run": "hover", "t": 6.2, "std": 0.2, "at_once": at_once, "grown": grown}
    cause = finding("gyro_bias", x=0.02) | {"since": moment, "before": {}}
    assert causes.since(cause) == words
    line = diagnose_script.cause_line(cause)
    assert "; since 6.20 +- 0.2 s of hover" in line
    assert ("grown at 1.30 +- 0.3 s of circles" in line) == (grown is not None)


def test_what_a_number_rests_on_is_said_beside_its_cause():
    remarks = (
        "cg_offset.x = 0.05 holds without wind, which these flights neither show nor rule out: "
        "with it 0.03 fits as well",
        "wind is not asked",
    )
    cause = finding("cg_offset", x=0.05, y=0.0) | {
        "channels": [], "trust": "sure", "robust": {"noise": True, "runs": 1.0, "kept": 1.0},
    }  # fmt: skip
    sections = causes.cause_sections({"causes": [cause]}, LAMA, LAMA, remarks)
    said = "".join(str(block) for section in sections for block in section.blocks)
    assert "with it 0.03 fits as well." in said
    assert "wind is not asked" not in said


@pytest.mark.parametrize(
    ("unseen", "said"),
    [({"nats": 41.2, "expected": 40.0, "std": 9.0}, "worth 41.2"), (None, "not asked")],
)
def test_what_a_cause_is_worth_on_the_held_out_runs_is_said(unseen, said):
    cause = finding("cg_offset", x=0.05, y=0.0) | {"unseen": unseen}
    sections = causes.cause_sections({"causes": [cause]}, LAMA, LAMA)
    assert said in "".join(str(block) for section in sections for block in section.blocks)


def test_a_cause_s_size_where_half_of_it_shows_is_said():
    cause = finding("cg_offset", x=0.05, y=0.0)

    def said(cause):
        sections = causes.cause_sections({"causes": [cause]}, LAMA, LAMA)
        return "".join(str(block) for section in sections for block in section.blocks)

    assert "0.98 of all" in said(cause) and "not asked" not in said(cause)
    assert "of all" not in said(cause | {"where_most": None})


def test_a_cause_s_interval_knows_its_correlation():
    """Two numbers that move together leave their difference well known."""
    cause = finding("ground_effect", gain=0.5, decay=2.0)
    tied = replace(
        LAMA, correlated=("ground_effect.gain", "ground_effect.decay"),
        correlation=np.array([[1.0, 0.9], [0.9, 1.0]]),
    )  # fmt: skip
    alone, together = (consequences.covariance_of(cause, v) for v in (LAMA, tied))
    np.testing.assert_allclose(np.diag(alone), np.diag(together))
    assert alone[0, 1] == 0.0
    assert together[0, 1] == pytest.approx(0.9 * np.sqrt(alone[0, 0] * alone[1, 1]))


def test_what_an_interval_cannot_tell_from_zero_is_not_said():
    words = consequences.described(finding("gyro_bias", x=1e-5, y=-0.012, z=0.0), LAMA, LAMA)
    cause = finding("gyro_bias", x=1e-5, y=-0.012, z=0.0)
    cause["parameters"]["gyro_bias.x"]["std"] = 3e-4
    assert "roll" in words
    words = consequences.described(cause, LAMA, LAMA)
    assert words == "the pitch gyro reads 0.69°/s (0.63 to 0.74) too low"


# --- the flight replayed --------------------------------------------------------------------------


@pytest.fixture(scope="module")
def pushed():
    """A machine with a drag that its bare model lacks, and its paths."""
    machine = LAMA.with_effect("rotor_drag", coefficient=8e-4)
    flight = simulate(machine, ["hover", "forward_run"], seed=2)
    return flight, machine, trajectories(flight, machine, {"bare": LAMA, "true": machine})


def test_simulations_start_on_the_measured_path(pushed):
    flight, _, paths = pushed
    assert [p.run for p in paths] == list(flight.run_names)
    for one in paths:
        starts = one.t[one.begins]
        assert np.diff(starts) == pytest.approx(RESTART, abs=0.06)
        for simulated in one.simulated.values():
            np.testing.assert_array_equal(simulated[one.begins], one.measured[one.begins])


def test_the_true_model_stays_and_the_bare_one_leaves(pushed):
    _, _, paths = pushed
    ends = np.flatnonzero(paths[1].begins)[1:] - 1
    bare, true = (paths[1].position_error(m)[ends].mean() for m in ("bare", "true"))
    assert bare > 3.0 * true and true < 0.3
    assert paths[1].error_removed().max() > 0.3 and np.isfinite(paths[1].error_removed()).all()


def test_the_measured_path_is_the_flight_s(pushed):
    """Where velocity was measured: the path's own slope is that velocity."""
    flight, _, paths = pushed
    one, run = paths[1], flight.runs[1]
    slope = np.gradient(one.measured[:, 0], one.t)
    there = np.isfinite(run.measured["vn"])
    measured = np.interp(one.t, run.t[there], run.measured["vn"][there])
    assert np.sqrt(np.mean((slope - measured) ** 2)) < 0.25  # the sensor's 0.2 m/s
    heights = np.interp(one.t, run.t, -run.t * 0 + np.nanmedian(run.measured["h"]))
    assert np.abs(one.measured[:, 2] - heights).max() < 1.0


def test_a_long_flight_has_fewer_frames(pushed, monkeypatch):
    flight, machine, paths = pushed
    monkeypatch.setattr("coax_env.estimation.trajectories.MOST_FRAMES", 200)
    thin = trajectories(flight, machine, {"bare": LAMA})
    assert sum(len(p.t) for p in thin) <= 200 < sum(len(p.t) for p in paths)


def test_a_simulation_that_runs_away_is_left_out(pushed):
    flight, machine, _ = pushed
    wild = LAMA.with_values({"inertia_xx": 1e-9, "inertia_yy": 1e-9})
    with np.errstate(all="ignore"):
        paths = trajectories(flight, machine, {"wild": wild})
    assert np.isnan(paths[0].simulated["wild"]).any()
    view = flight_view(paths, {"wild": "#000000"}, 0.25, (), "")
    assert "NaN" not in view


# --- words and figures ----------------------------------------------------------------------------


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
    assert inline("(7.0 ± 0.1)·10^−3") == "(7.0 ± 0.1)·10<sup>−3</sup>"
    assert card("<b>", "<i>", ["<u>"], "<s>").count("&lt;") == 4
    assert "<script>" not in table(["<script>"] * 2, [["<script>", "1"]])
    closing = figures.heat_map(["</script>"], ["a"], np.eye(1), [["1"]], "x")
    assert figure(closing).count("</script>") == 1


def test_rolling_rms_and_autocorrelation():
    rng = np.random.default_rng(0)
    t = np.arange(0.0, 100.0, 0.01)
    white = rng.standard_normal(len(t))
    white[::7] = np.nan
    level = fit_figures.rolling_rms(t, 2.0 * white, np.array([20.0, 50.0]), 20.0)
    np.testing.assert_allclose(level, 2.0, rtol=0.1)
    assert np.isnan(fit_figures.rolling_rms(t, np.full(len(t), np.nan), t[:3], 1.0)).all()
    red = np.zeros(len(t))
    for k in range(1, len(t)):
        red[k] = 0.8 * red[k - 1] + rng.standard_normal()
    np.testing.assert_allclose(
        fit_figures.autocorrelation(red, 3), [1, 0.8, 0.64, 0.512], atol=0.06
    )


def test_no_line_joins_predictions_across_what_was_cut_out():
    """Of a run from whose middle five seconds are gone, and one without a hole."""
    t = np.r_[np.arange(0.0, 5.0, 0.25), np.arange(10.0, 14.0, 0.25)]
    at, line, error = figures._broken(t, 2.0 * t, 0.0 * t)
    assert np.flatnonzero(np.isnan(line)).tolist() == np.flatnonzero(np.isnan(error)).tolist() == [20]
    np.testing.assert_array_equal(np.delete(at, 20), t)
    np.testing.assert_array_equal(np.delete(line, 20), 2.0 * t)
    whole = figures._broken(t[:20], t[:20])
    np.testing.assert_array_equal(whole, [t[:20], t[:20]])
    assert [values.size for values in figures._broken(t[:1], t[:1])] == [1, 1]


@pytest.mark.slow
def test_figures_are_plotly_figures():
    go = pytest.importorskip("plotly.graph_objects")
    t = np.arange(0.0, 5.0, 0.01)
    for fig in (
        figures.histories(t, [("a [m]", {"x": t, "y": -t}), ("b", {"z": t})]),
        figures.plan_view(t, t, t),
        figures.prediction("h", (t, t), {"before": (t, t, 0 * t), "after": (t, t, t)}, 0.1),
        figures.gain_bars({"h": entry(0.2, 0.1, "m")}),
        fit_figures.innovations(t, np.sin(9 * t), np.cos(9 * t)),
        fit_figures.whiteness_bars({"h": (0.3, 0.01)}, 0.04),
        fit_figures.evidence_steps([("+ a", 3.0)]),
        fit_figures.parameter_moves({"mass": (1.0, 0.5)}),
        figures.heat_map(["a"], ["b"], np.ones((1, 1)), [["1"]], "x", log=True),
    ):
        go.Figure(fig).update_layout(
            template=plot_style.plotly_template()
        )  # validates every property
