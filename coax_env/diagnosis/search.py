"""Which effects do these flights show? Forward, backward and swap moves on the signatures.

At each point the likelihood is quadratic in all parameters at once: the Gram matrix of the
signatures, with priors on every parameter. A set of effects is scored by minimising that quadratic
over the base parameters, the effects already in and the candidate's, the base parameters always under
their priors, so that no effect is credited with what a better thrust coefficient would have done.

The score is a log Bayes factor in nats: the gain of the objective less the Laplace (Occam) factor of
the added parameters, whose prior is their usual size. An effect is taken when the score passes
EVIDENCE and one of its parameters is large enough to matter in prediction (`smallest` in the
catalogue). Everything is re-linearised after each move.

An effect that is the same column as a base parameter (`replaces`) takes that parameter's place: the
base parameter goes back to its file value. It counts when it moved by more than twice the base
parameter's prior std (contract.md) and the move is worth EVIDENCE against the file value.
"""

import math
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import TypeVar

import numpy as np

from coax_env.estimation.fit import Engine, RunPass, objective
from coax_env.estimation.helicopter import BUFFET_LEVELS, GUST_LEVELS, HeliModel
from coax_env.estimation.quadratic import Quadratic
from coax_env.estimation.state_space import FreeParameter, Noise
from coax_env.estimation.whiteness import is_white
from coax_env.model import effects
from coax_env.model import parameters as P
from coax_env.model.generic_terms import AXES

EVIDENCE = 14.0
"""Nats a cause must be worth, Occam factor deducted."""
TIE = 6.0
"""Alternatives within this many nats cannot be told apart."""
MOST_CAUSES = 10
PROMISE = 2.0
"""Nats below which another Gauss-Newton step is not worth its time."""
POLISH = 0.02
"""Nats that the last step of a final fit may promise: a fifth of a standard deviation.

PROMISE would leave two, and always on the side that the search came from."""
MOST_POLISHES = 4
PART_OF_STD = 0.3
"""Step of a difference of likelihoods, in standard deviations."""
WIDER = (0.5, 2.0)
"""Bounds of what the likelihood's own curvature may do to a standard deviation."""
MOST_STEPS = 4
MOST_TURNS = 6
GLANCE = 60.0
"""Seconds of flight on which noise levels are fitted while the search goes on."""
PLAIN = 2.0
"""Standard deviations by which white noise must want to be more before its levels are fitted."""
BEYOND_DOUBT = 10.0
"""A cause worth so many thresholds after the first refit without it needs no closer one."""
CLEAR = 10.0
"""An effect worth so many times what another step promises is added before the fit has settled."""
NEAR = 0.5
"""Share of EVIDENCE from which an effect that the quadratic does not carry is fitted to see."""
A_LITTLE_WAY = 4.0
"""Standard deviations, as the signatures have them, at which a damping is asked for its likelihood."""
TOGETHER = (frozenset({"servo_lag", "servo_delay"}),)
"""Effects of which one at most is named: a real servo is a mixture of both (design/effects.md)."""
BUFFET_SHARE = 0.2
"""White noise to start from, per gust level [s^1/2]: a gust that forgets within 20 ms."""
MOST_FAILURES = 3
"""Additions in a row that do not hold before the search gives up."""
Progress = Callable[[str], None]
T = TypeVar("T")


def together(effect: str) -> set[str]:
    """The effects that stand for the same thing as this one."""
    return {e for group in TOGETHER if effect in group for e in group} - {effect}


@dataclass
class State:
    """Where the search stands: effects in, values of all parameters, noise levels.

    wider: standard deviation of an effect's parameter by the likelihood's own curvature, over that by
    the signatures; 1 where it is not known.
    """

    active: list[str]
    values: dict[str, float]
    noise: Noise
    objective: float = np.inf
    wider: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Weight:
    """What a cause is worth. lost: nats without it, all else refitted. colour: see Quadratic.colour."""

    lost: float
    colour: float

    @property
    def evidence(self) -> float:
        """Nats that coloured innovations leave of what is lost."""
        return self.lost / self.colour


@dataclass(frozen=True)
class Offer:
    """An effect that might be added: see Search.score. evidence: what EVIDENCE is compared with."""

    effect: str
    score: float
    evidence: float


@dataclass
class Search:
    """The structure search over one set of records.

    Attributes:
        history: (effect, score) of every move, in order.
        levels: the noise levels that are fitted.
        strongest: evidence [nats] and name of the candidate that came nearest to being added, or
            was; the threshold is calibrated on it (scripts/study_diagnosis.py --calibrate).
    """

    engine: Engine
    model: HeliModel
    candidates: tuple[str, ...]
    progress: Progress | None = None
    history: list[tuple[str, float]] = field(default_factory=list)
    levels: tuple[str, ...] = GUST_LEVELS
    strongest: tuple[float, str] = (-math.inf, "")

    def __post_init__(self) -> None:
        self.base = self.model.base_parameters()
        self.by_effect = {e: self.model.effect_parameters(e) for e in self.candidates}
        self.all = self.base + [f for group in self.by_effect.values() for f in group]

    def say(self, text: str) -> None:
        """Tell whoever watches."""
        if self.progress:
            self.progress(text)

    def loosen(self, parameters: Sequence[FreeParameter]) -> None:
        """Fit these from now on, as the base parameters are (unlisted.py)."""
        self.base = [*self.base, *parameters]
        self.all = [*self.all, *parameters]

    def tighten(self, names: Collection[str]) -> None:
        """Stop fitting these."""
        self.base = [f for f in self.base if f.name not in names]
        self.all = [f for f in self.all if f.name not in names]

    # --- which parameters are loose -----------------------------------------------------------------

    def base_names(self, active: Collection[str]) -> list[str]:
        """Base parameters that no active effect replaces."""
        replaced = {b for e in active for b in effects.CATALOGUE[e].replaces}
        return [f.name for f in self.base if f.name not in replaced]

    def free_names(self, active: Collection[str]) -> list[str]:
        """Those, and the active effects' own."""
        return self.base_names(active) + [f.name for e in active for f in self.by_effect[e]]

    def candidate_names(self, effect: str) -> list[str]:
        """An effect's parameters that act as soon as it does (no shapes)."""
        shapes = {p.name for p in effects.CATALOGUE[effect].parameters if p.shape}
        return [f.name for f in self.by_effect[effect] if f.name.split(".")[1] not in shapes]

    def free(self, active: Collection[str]) -> list[FreeParameter]:
        """The loose parameters themselves."""
        names = set(self.free_names(active))
        return [f for f in self.all if f.name in names]

    def free_of_vehicle(self, active: Collection[str]) -> list[FreeParameter]:
        """Those of them that a vehicle file can hold."""
        return [f for f in self.free(active) if f.name not in P.COMMAND_GAINS]

    def pinned(self, effect: str) -> dict[str, float]:
        """Values that the base parameters replaced by an effect go back to."""
        return {b: self.model.bare_values[b] for b in effects.CATALOGUE[effect].replaces}

    def off(self, effect: str) -> dict[str, float]:
        """Off-values of an effect."""
        return {f.name: f.value for f in self.by_effect[effect]}

    # --- moves --------------------------------------------------------------------------------------

    def begin(self, noise: Noise) -> State:
        """The bare model with its own noise levels."""
        values = {**self.model.bare_values, "gust_memory": noise.process["memory"]}
        for f in self.all:
            values.setdefault(f.name, f.value)
        noise = self.engine.fit_noise(values, noise, GUST_LEVELS, 10, PROMISE, GLANCE)
        state = State([], values, noise)
        self.look_for_buffet(state)
        return state

    def linearise(self, state: State) -> tuple[list[RunPass], Quadratic]:
        """The quadratic at a state, over all parameters that might be free."""
        passes, lin = self.engine.linearise(state.values, state.noise, self.all)
        state.objective = objective(passes, self.free(state.active), state.values)
        return passes, Quadratic.of(lin, self.all, state.values)

    def advance(
        self,
        state: State,
        passes: Sequence[RunPass],
        quadratic: Quadratic,
    ) -> None:
        """Take the Newton step of the active set, halved until the cost falls."""
        free = self.free(state.active)
        _, move = quadratic.best([f.name for f in free])
        moves = {n: float(m) for n, m in zip(quadratic.names, move, strict=True) if m != 0.0}
        state.values, _ = self.engine.descend(passes, free, state.values, state.noise, moves)

    def moved(
        self,
        state: State,
        quadratic: Quadratic,
        active: list[str],
        pinned: Mapping[str, float],
    ) -> State:
        """Where the quadratic says the fit with other effects is, noise as it was."""
        free = [n for n in self.free_names(active) if n not in pinned]
        _, move = quadratic.best(free, dict(pinned))
        values = dict(zip(quadratic.names, (quadratic.at + move).tolist(), strict=True))
        return State(active, state.values | values | dict(pinned), state.noise)

    def settle(
        self,
        state: State,
        steps: int = 3,
        tolerance: float = 1.0,
        without: Collection[str] = (),
    ) -> State:
        """Fit the loose parameters by Gauss-Newton, those in `without` held. Changes `state`."""
        free = [f for f in self.free(state.active) if f.name not in without]
        estimate = self.engine.fit(free, state.values, state.noise, steps, tolerance)
        state.values = state.values | estimate.values
        state.objective = estimate.objective
        return state

    def refit_noise(self, state: State, seconds: float = GLANCE) -> State:
        """Noise levels again, from where they stand, on so many seconds of flight."""
        noise = self.engine.fit_noise(
            state.values,
            state.noise,
            self.levels,
            evaluations=5,
            tolerance=PROMISE,
            seconds=seconds,
        )
        return replace(state, noise=noise)

    def converge(self, state: State, without: Collection[str] = ()) -> State:
        """Noise levels and loose parameters by turns until neither gains, those in `without` held.

        Evidence is a difference of two such states: what one of them lacks in convergence would count
        for the other.
        """
        for _ in range(MOST_TURNS):
            before = state.objective
            state = self.settle(self.refit_noise(state, math.inf), steps=1, without=without)
            if before - state.objective < PROMISE:
                break
        return state

    def polish(self, state: State) -> State:
        """Fit to the end, effects' parameters by the slope of the likelihood itself. Changes `state`.

        Signatures hold the gains still. What an effect does to the gains is small, and zero on average,
        but on a gusty flight it can be a standard deviation. The slope by differences of whole filter
        passes has it in, and so has the curvature, which `state.wider` is taken from. Coloured
        innovations say that the gains are not those of the true noise: then that part of the slope is
        no more than a bias, and is left out.
        """
        state.wider = {}
        own = [f for e in state.active for f in self.by_effect[e]]
        if not own or not is_white(
            self.engine.filter(state.values, state.noise), self.model.channels
        ):
            return self.settle(state, MOST_STEPS, POLISH)
        free = self.free(state.active)
        names = [f.name for f in free]
        # what the slope with the gains held lacks: it hardly changes on the way
        missing = np.zeros(len(names))
        for count in range(MOST_POLISHES):
            passes, lin = self.engine.linearise(state.values, state.noise, free)
            quadratic = Quadratic.of(lin, free, state.values)
            if count == 0:
                state.objective = objective(passes, free, state.values)
                missing, state.wider = self._likelihoods_own(state, quadratic, free, own)
            _, move = replace(quadratic, g=quadratic.g + missing).best(names)
            for part in (1.0, 0.4):
                there = dict(zip(names, (quadratic.at + part * move).tolist(), strict=True))
                passes = self.engine.filter(state.values | there, state.noise)
                gained = state.objective - objective(passes, free, state.values | there)
                if gained > 0.0:
                    state.values, state.objective = state.values | there, state.objective - gained
                    break
            if gained < POLISH:
                break
        return state

    def _likelihoods_own(
        self,
        state: State,
        quadratic: Quadratic,
        free: Sequence[FreeParameter],
        own: Sequence[FreeParameter],
    ) -> tuple[np.ndarray, dict[str, float]]:
        """What the likelihood's slope has beyond the quadratic's, and `State.wider`.

        By differences inside the bounds, along the way of each of `own` on which all others answer: the
        curvature there is one over its variance.
        """
        covariance = quadratic.covariance(quadratic.names)
        ways = covariance / np.diag(covariance)  # a column each
        mine = quadratic.index([f.name for f in own])
        beyond, wider = np.zeros(len(own)), {}
        for j, (k, f) in enumerate(zip(mine, own, strict=True)):
            step = PART_OF_STD * math.sqrt(covariance[k, k])
            ends = min(step, f.upper - quadratic.at[k]), max(-step, f.lower - quadratic.at[k])
            if ends[0] <= ends[1]:
                continue
            costs = []
            for end in ends:
                moved = np.clip(quadratic.at + end * ways[:, k], quadratic.lower, quadratic.upper)
                there = state.values | dict(zip(quadratic.names, moved.tolist(), strict=True))
                costs.append(objective(self.engine.filter(there, state.noise), free, there))
            pull = quadratic.g + quadratic.precision * (quadratic.at - quadratic.mean)
            beyond[j] = (costs[0] - costs[1]) / (ends[0] - ends[1]) - pull @ ways[:, k]
            bend = costs[0] + costs[1] - 2.0 * state.objective
            if ends == (step, -step) and bend > 0.0:
                wider[f.name] = float(np.clip(PART_OF_STD / math.sqrt(bend), *WIDER))
        missing = np.zeros(len(free))
        missing[mine] = np.linalg.lstsq(ways[np.ix_(mine, mine)].T, beyond, rcond=None)[0]
        return missing, wider

    def look_for_buffet(self, state: State) -> bool:
        """Let white force and moment in, where that is worth more than TIE; True where it now is."""
        if self.levels != GUST_LEVELS:
            return False
        _, by_noise, _ = self.engine.noise_score(state.values, state.noise)
        sigmas = by_noise.sum(0) / (np.sqrt(len(by_noise)) * by_noise.std(0) + 1e-300)
        if sigmas[: len(AXES)].max() < PLAIN:
            return False
        start = dict(state.noise.process)
        for gust, buffet in zip(GUST_LEVELS, BUFFET_LEVELS, strict=True):
            start[buffet] = BUFFET_SHARE * start[gust]
        levels = GUST_LEVELS + BUFFET_LEVELS
        trial = self.engine.fit_noise(
            state.values, replace(state.noise, process=start), levels, 10, PROMISE, GLANCE
        )
        gained = self.engine.log_likelihood(state.values, trial)
        gained -= self.engine.log_likelihood(state.values, state.noise)
        if gained < TIE:
            return False
        self.say(f"shaken by white noise beside the gusts: {gained:.1f} nats")
        state.noise, self.levels = trial, levels
        return True

    # --- scores -------------------------------------------------------------------------------------

    def score(
        self, quadratic: Quadratic, active: list[str], effect: str
    ) -> tuple[float, float, bool]:
        """Log Bayes factor of adding an effect, its evidence for the rule, and whether it is large.

        The second number is what EVIDENCE is compared with: for an effect that replaces base
        parameters, against those held at their file values.
        """
        entry = effects.CATALOGUE[effect]
        now, _ = quadratic.best(self.free_names(active))
        pinned = self.pinned(effect)
        rest = [n for n in self.free_names(active) if n not in pinned]
        own = self.candidate_names(effect)
        then, move = quadratic.best(rest + own, pinned)
        occam = quadratic.occam(own, rest)
        gain = now - then
        evidence = gain
        if pinned:
            held, _ = quadratic.best(rest, pinned)
            evidence = held - then
        reached = dict(zip(quadratic.names, quadratic.at + move, strict=True))
        return (
            gain - (0.0 if pinned else occam),
            evidence - occam,
            self.is_large(entry.name, reached),
        )

    def promise(
        self, state: State, quadratic: Quadratic, damping: str
    ) -> tuple[float, dict[str, float]]:
        """What a damping that is not in promises [nats, Occam factor deducted], and its value there.

        By the slope of the likelihood itself, from one filter pass a little way towards it. Signatures
        hold the gains still, so that their slope lacks what the damping does to the gains.
        """
        (f,) = (f for f in self.by_effect[damping] if f.name in self.candidate_names(damping))
        rest = self.free_names(state.active)
        information = float(quadratic.projected([f.name], rest)[0][0, 0])
        if information <= 0.0:
            return -math.inf, {}
        step = min(f.std, A_LITTLE_WAY / math.sqrt(information))
        there = self.moved(state, quadratic, state.active, {f.name: f.value + step})
        passes = self.engine.filter(there.values, there.noise)
        gained = state.objective - objective(passes, self.free(state.active), there.values)
        gained += quadratic.best(rest)[0]  # what the others would gain without it
        slope = gained / step + 0.5 * information * step
        size = min(max(slope / (information + 1.0 / f.std**2), 0.0), f.upper - f.value)
        return 0.5 * slope * size - quadratic.occam([f.name], rest), {f.name: f.value + size}

    def is_large(self, effect: str, values: dict[str, float]) -> bool:
        """Whether an effect at these values matters in prediction."""
        entry = effects.CATALOGUE[effect]
        sizes = [
            abs(values[full] - p.off) / p.smallest
            for full, p in zip(entry.names(), entry.parameters, strict=True)
            if p.smallest > 0.0
        ]
        for base in entry.replaces:
            old = self.model.vehicle.parameters[base]
            relative = abs(values[entry.names()[0]])
            relative /= 1.0 if entry.parameters[0].unit == "1" else old.value
            if relative < 2.0 * old.std / old.value:
                return False
        return max(sizes) >= 1.0

    def loss_without(
        self, quadratic: Quadratic, active: list[str], effect: str, coloured: bool
    ) -> float:
        """Nats lost when an effect leaves and the rest refits, Occam factor returned.

        `coloured`: divided by the colour of the innovations in this effect's direction.
        """
        free = self.free_names(active)
        now, _ = quadratic.best(free)
        rest = [n for n in free if not n.startswith(effect + ".")]
        pinned = self.off(effect) | self.pinned(effect)
        then, _ = quadratic.best(rest, pinned)
        own = self.candidate_names(effect)
        colour = self.colour(quadratic, active, effect) if coloured else 1.0
        return (then - now) / colour - quadratic.occam(own, rest)

    def colour(self, quadratic: Quadratic, active: Collection[str], effect: str) -> float:
        """Colour of the innovations in an active effect's direction, at least 1."""
        return quadratic.colour(self.candidate_names(effect), self.free_names(active))

    def swap(
        self, quadratic: Quadratic, active: list[str], old: str, new: str
    ) -> tuple[float, np.ndarray]:
        """Change of the objective [nats, Occam factors in] when one effect stands for another."""
        free = self.free_names(active)
        now, _ = quadratic.best(free)
        others = [e for e in active if e != old]
        rest = [n for n in self.free_names(others) if n not in self.pinned(new)]
        pinned = self.off(old) | self.pinned(new)
        then, move = quadratic.best(rest + self.candidate_names(new), pinned)
        occam_new = 0.0 if self.pinned(new) else quadratic.occam(self.candidate_names(new), rest)
        occam_old = 0.0 if self.pinned(old) else quadratic.occam(self.candidate_names(old), rest)
        return then + occam_new - now - occam_old, move

    def without(self, state: State, quadratic: Quadratic, effect: str) -> State:
        """The state without an effect, the rest moved to where the quadratic says."""
        rest = [e for e in state.active if e != effect]
        return self.moved(state, quadratic, rest, self.off(effect) | self.pinned(effect))

    def weigh(self, state: State, quadratic: Quadratic) -> dict[str, "Weight"]:
        """What each cause is worth: everything refitted without it, noise levels too."""

        def one(effect: str) -> Weight:
            held = effects.CATALOGUE[effect].replaces
            colour = self.colour(quadratic, state.active, effect)
            without = self.refit_noise(self.without(state, quadratic, effect))
            self.settle(without, steps=1, without=held)
            if without.objective - state.objective < BEYOND_DOUBT * EVIDENCE * colour:
                without = self.converge(without, held)
            return Weight(float(without.objective - state.objective), colour)

        return self.for_each(one, state.active)

    def for_each(self, work: Callable[[str], T], of: Sequence[str]) -> dict[str, T]:
        """What is found for each effect, of several at once: no core waits for another's last run."""
        with ThreadPoolExecutor(self.engine.threads) as pool:
            return dict(zip(of, pool.map(work, of), strict=True))

    def prune(self, state: State) -> tuple[State, Quadratic, dict[str, "Weight"]]:
        """Take out, one at a time, causes whose evidence is gone once the noise may answer too."""
        state, quadratic, weights = self._weighed(state)
        while weights:
            weakest = min(weights, key=lambda e: weights[e].evidence)
            if weights[weakest].evidence >= EVIDENCE:
                break
            self.history.append((f"- {weakest}", max(weights[weakest].evidence, 0.0)))
            self.say(f"dropped {weakest}: worth {weights[weakest].evidence:.1f} nats in the end")
            state.active = [e for e in state.active if e != weakest]
            state.values |= self.off(weakest) | self.pinned(weakest)
            state, quadratic, weights = self._weighed(state)
        return state, quadratic, weights

    def _weighed(self, state: State) -> tuple[State, Quadratic, dict[str, "Weight"]]:
        state = self.polish(self.converge(state))
        _, quadratic = self.linearise(state)
        return state, quadratic, self.weigh(state, quadratic)

    # --- the search ---------------------------------------------------------------------------------

    def run(self, state: State) -> tuple[State, Quadratic]:
        """Forward, backward and swap from a fitted state until nothing moves; with the quadratic."""
        banned: set[str] = set()  # dropped since the last addition
        drops: Counter[str] = Counter()
        tried: set[tuple[str, ...]] = set()
        failures = most = 0
        complete = False
        settled = False  # since the last move
        for _ in range(4 * MOST_CAUSES):
            passes, quadratic = self.linearise(state)
            promised, _ = quadratic.best(self.free_names(state.active))
            offers = self._offers(state, quadratic, banned)
            strong = [offer for offer in offers if offer.evidence > EVIDENCE]
            clear = not complete and strong and strong[0].score > -CLEAR * promised
            fitted = -promised <= PROMISE or settled
            if not fitted and not clear:
                self.advance(state, passes, quadratic)
                self.settle(state, MOST_STEPS, PROMISE)
                settled = True
                continue
            settled = False
            # on the way to a fit an effect may look small
            drop = fitted and not complete
            dropped = self._drop(state, quadratic, coloured=False) if drop else None
            if dropped:
                drops[dropped] += 1
                banned.add(dropped)
                failures += 1
            elif (
                not complete
                and failures < MOST_FAILURES
                and self._add(state, passes, quadratic, strong)
            ):
                if len(state.active) > most + 1:  # the one before held
                    most, failures = len(state.active) - 1, 0
                    banned = {e for e, count in drops.items() if count > 1}
            elif not complete and (
                self._swap(state, quadratic, tried)
                or self._add_near(state, quadratic, offers, banned, tried)
                or self.look_for_buffet(state)
            ):
                pass
            else:  # nothing more to add: what is in must also stand against coloured residuals
                complete = True
                if not self._drop(state, quadratic, coloured=True):
                    break
            state = self.refit_noise(state)
        return state, quadratic

    def _drop(self, state: State, quadratic: Quadratic, coloured: bool) -> str | None:
        """Take out the effect that is worth least, if that is too little or it is too small."""
        worth = {
            effect: self.loss_without(quadratic, state.active, effect, coloured)
            if self.is_large(effect, state.values)
            else -np.inf
            for effect in state.active
        }
        for effect in sorted(worth, key=lambda e: worth[e]):
            if worth[effect] >= EVIDENCE:
                return None
            if not np.isfinite(worth[effect]) or self._holds_not(
                state, quadratic, effect, coloured
            ):
                break
        else:
            return None
        self.history.append((f"- {effect}", max(worth[effect], 0.0)))
        self.say(f"dropped {effect}: worth {worth[effect]:.1f} nats")
        without = self.moved(
            state, quadratic, [e for e in state.active if e != effect], self.off(effect)
        )
        state.active, state.values = without.active, without.values
        return effect

    def _holds_not(self, state: State, quadratic: Quadratic, effect: str, coloured: bool) -> bool:
        """Whether a refit without the effect confirms that it is worth too little.

        The quadratic reaches from where the effect stands back to nothing, which is far for a lag.
        """
        without = self.settle(
            self.without(state, quadratic, effect), without=effects.CATALOGUE[effect].replaces
        )
        colour = self.colour(quadratic, state.active, effect) if coloured else 1.0
        own = self.candidate_names(effect)
        occam = quadratic.occam(own, self.free_names(without.active))
        return (without.objective - state.objective) / colour - occam < EVIDENCE

    def _swap(self, state: State, quadratic: Quadratic, tried: set[tuple[str, ...]]) -> bool:
        """Put another effect in the place of one that is in, where that fits better."""
        promising = []
        for old in state.active:
            for new in self.candidates:
                active = tuple(new if e == old else e for e in state.active)
                if new not in state.active and active not in tried:
                    change, move = self.swap(quadratic, state.active, old, new)
                    if change < -TIE:
                        promising.append((change, old, new, active, move))
        for _, old, new, active, move in sorted(promising, key=lambda c: c[0])[:3]:
            tried.add(active)
            values = dict(zip(quadratic.names, (quadratic.at + move).tolist(), strict=True))
            trial = self.settle(State(list(active), state.values | values, state.noise))
            if trial.objective < state.objective - TIE and self.is_large(new, trial.values):
                gained = state.objective - trial.objective
                self._take(state, trial, f"{old} -> {new}", gained)
                self.say(f"{new} explains it better than {old}, by {gained:.1f} nats")
                return True
        return False

    def _add_near(
        self,
        state: State,
        quadratic: Quadratic,
        offers: Sequence[Offer],
        banned: Collection[str],
        tried: set[tuple[str, ...]],
    ) -> bool:
        """Put in an effect that the quadratic nearly carries, where a fit says that it is worth it.

        The quadratic at nothing is not that at the effect's size: a damping changes what the filter
        makes of gusts, and may be worth ten times what its slope promised. So dampings and drags, of
        one parameter each, are asked by the likelihood itself.
        """

        def untried(names: Iterable[str]) -> list[str]:
            return [e for e in names if (*state.active, e) not in tried]

        near: dict[str, dict[str, float]] = {  # and where to begin
            effect: {}
            for effect in untried(
                offer.effect
                for offer in offers
                if NEAR * EVIDENCE < offer.evidence <= EVIDENCE
                and not effects.CATALOGUE[offer.effect].replaces
            )[:3]
        }
        dampings = (e for e in self.candidates if effects.CATALOGUE[e].damps)
        asked = untried(e for e in dampings if e not in {*state.active, *banned, *near})
        promises = self.for_each(lambda e: self.promise(state, quadratic, e), asked)
        near |= {e: at for e, (nats, at) in promises.items() if nats > NEAR * EVIDENCE}
        tried |= {(*state.active, e) for e in asked}
        for effect, start in near.items():
            active = [*state.active, effect]
            tried.add(tuple(active))
            occam = quadratic.occam(self.candidate_names(effect), self.free_names(state.active))
            trial = self.settle(self.moved(state, quadratic, active, start))
            worth = state.objective - trial.objective - occam
            if worth > EVIDENCE and self.is_large(effect, trial.values):
                self._take(state, trial, f"+ {effect}", worth)
                self.say(f"added {effect}: {worth:.1f} nats, once fitted")
                self.strongest = max(self.strongest, (worth, effect))
                return True
        return False

    def _take(self, state: State, trial: State, move: str, gained: float) -> None:
        """A trial becomes the state."""
        self.history.append((move, gained))
        state.active, state.values = trial.active, trial.values
        state.objective = trial.objective

    def _offers(self, state: State, quadratic: Quadratic, banned: Collection[str]) -> list[Offer]:
        """Effects that are not in, may be, and promise something that matters; the best first."""
        offers = []
        for effect in self.candidates:
            if effect in banned or ({effect} | together(effect)) & set(state.active):
                continue
            score, evidence, large = self.score(quadratic, state.active, effect)
            if large and score > 0.0:
                self.strongest = max(self.strongest, (evidence, effect))
                offers.append(Offer(effect, score, evidence))
        return sorted(offers, key=lambda offer: -offer.score)

    def _add(
        self,
        state: State,
        passes: Sequence[RunPass],
        quadratic: Quadratic,
        offers: Sequence[Offer],
    ) -> bool:
        """Put in the best effect that may be added, if there is one."""
        if not offers or len(state.active) >= MOST_CAUSES:
            return False
        effect, score = offers[0].effect, offers[0].score
        self.history.append((f"+ {effect}", score))
        self.say(f"added {effect}: {score:.1f} nats")
        state.active = [*state.active, effect]
        pinned = self.pinned(effect)
        if pinned:  # takes the base parameter's place: the same model, not a better one
            state.values = self.moved(state, quadratic, state.active, pinned).values
        else:
            self.advance(state, passes, quadratic)
        return True
