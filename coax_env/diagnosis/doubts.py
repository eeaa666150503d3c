"""What speaks against a name: as measured, in plain words, and when it is enough to take the name.

What stands at the limit of what is believed and is not determined, or does not hold under other noise
or on parts of the flights, stands for something else; so does what the readings of a channel that
should show it are likelier without; a motor's lag that measured rotor speeds alone show may be that of
their readings. What changed in flight, by little evidence, has no name: a hub stiffness, a servo's
delay, a centre of gravity and an accelerometer's bias did on four clean **synthetic** flights, for 18
to 29 nats, and by poses alone a swash offset for 33. Nor has what the held-out runs should show and
deny, if it is not clear on the fitted ones, nor what is a small share of a cause that stands at its
limit and shows in the same channels. Two of these take a name, too: noise left where it
shows, little evidence there or by poses alone, other noise, parts of the flights, such a one beside it,
numbers of which none is known to be another than nothing, but where another effect would do as well
(it is none then), held-out runs that should show it and do not, or that are likelier without it and
flown worse with the causes, a share of what all causes explain that their forms may be wrong by where
the control loop oscillates, a change in flight that a single
shock may have made.
"""

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

from coax_env.diagnosis.problem import Fit, Problem
from coax_env.diagnosis.replication import Replication
from coax_env.diagnosis.settings import Settings
from coax_env.diagnosis.unseen import Unseen
from coax_env.diagnosis.where_shown import SizeWhereMost
from coax_env.estimation.helicopter import MOST_USUAL_SIZES, UNUSUAL_FROM
from coax_env.estimation.state_space import AT_LIMIT
from coax_env.plain_words import and_list, channel_name, plain

SPEAKING_AGAINST = 2
"""Of what speaks against a name so much takes it; ours."""
MOST = 0.5
"""Share of the channels from which what is left in them speaks against every name; ours."""
LOUD = 2.0
"""Std of whitened innovations of a run, 1 where all is right, from which evidence is not to be trusted:
what changes them by a tenth is worth hundreds of nats. A wrong clock made that of a position 4 on a
clean **synthetic** flight, with a motor lag and a play of 400 nats, both sure; ours."""
MOST_VARIATIONS = 3
"""Variations of the noise that a doubt names; of more, their number; ours."""


@dataclass(frozen=True)
class Against:
    """What was measured that may speak against a name.

    Attributes:
        channels: in which it shows most, strongest first.
        coloured: those of them in which more than noise is left.
        elsewhere: share of all channels in which it is.
        likelier_without: channels that should show it and whose readings are likelier without it,
            beyond chance, and by how many nats.
        loud: channels whose innovations are over LOUD times as loud in a run as their noise is.
        falls_at: variations of the noise under which it does not hold.
        parts: how it fared on parts of the flights. runs: number of runs that were fitted.
        sizes: of its numbers [usual sizes].
        determined: whether the flights say more of one of its numbers than the prior did.
        may_be_none: whether nothing is within the 95 % interval of each of its numbers; in that is what
            models that do as well make of them.
        flies_worse: whether the model with the causes flies the held-out runs worse than as given.
        unseen: what it is worth on these; None where none were asked.
        within_form: whether the control loop oscillates, and what the causes explain, by forms that are
            a little wrong, leaves as much.
        alternatives: effects that would do as well.
        nats: its evidence.
        of_moment: what it is worth that it began or changed when it did; endless where it did not.
        shaken: whether gusts come in single shocks that no strengths speak for.
        poses_alone: whether neither gyros nor accelerometers were read.
        clock_error: std by which the times of the log's rows are wrong [s].
        smoothed: whether a low-pass of a sensor too fast to be seen would do the same.
        errors_left: what errors of readings that last, which look like it, are worth beside it [nats];
            0 where they are in the model, or nothing asks for them.
        beside_terms: channels among its own in which what no effect explains acts, too.
        beside_moved: numbers of the vehicle far from its file's that show in channels among its own.
        taken_back_by: a cause that takes back at rest what it does; empty: none.
        by_speeds_alone: whether it is a motor's lag that measured rotor speeds alone show.
        followed: whether the states of an onboard filter that were read follow it.
        where_most: its size where the flights show most of it; None where that is not known.
    """

    channels: tuple[str, ...]
    coloured: tuple[str, ...]
    elsewhere: float
    likelier_without: Mapping[str, float]
    loud: tuple[str, ...]
    falls_at: tuple[str, ...]
    parts: Replication
    runs: int
    sizes: Mapping[str, float]
    determined: bool
    may_be_none: bool
    flies_worse: bool
    unseen: Unseen | None
    within_form: bool
    alternatives: tuple[str, ...]
    nats: float
    of_moment: float
    shaken: bool
    poses_alone: bool
    clock_error: float
    smoothed: bool
    errors_left: float
    beside_terms: tuple[str, ...]
    beside_moved: tuple[str, ...]
    taken_back_by: str
    by_speeds_alone: bool
    followed: bool
    where_most: SizeWhereMost | None = None

    @property
    def at_limit(self) -> bool:
        """Whether one of its numbers is as large as is believed at most."""
        return has_limit(self.sizes)

    @property
    def is_denied(self) -> bool:
        """Whether the held-out runs should show it and do not, or deny it and are flown worse."""
        known = self.unseen
        return known is not None and (known.denied or (self.flies_worse and known.likelier_without))

    def may_have_been_constant(self, chosen: Settings) -> bool:
        """Whether it changed in flight, and that is worth little."""
        return self.of_moment < chosen.sure_evidence

    def is_little_change(self, chosen: Settings) -> bool:
        """Whether that is so, and it is worth little itself."""
        return self.may_have_been_constant(chosen) and self.nats < chosen.sure_evidence

    def is_weak_and_falls(self, chosen: Settings) -> bool:
        """Whether it is worth little, and does not hold under other noise or on the held-out runs."""
        falls = bool(self.falls_at) or self.is_denied
        return falls and self.nats < chosen.holding_evidence

    def is_not_clear_and_denied(self, chosen: Settings) -> bool:
        """Whether the held-out runs should show it and do not, and the fitted ones not clearly."""
        return self.unseen is not None and self.unseen.denied and self.nats < chosen.clear

    def may_be_shock(self, chosen: Settings) -> bool:
        """Whether that is so where gusts come in single shocks."""
        return self.shaken and self.may_have_been_constant(chosen)

    def is_gone_on_parts(self, chosen: Settings) -> bool:
        """Whether it does not return without enough of the runs, or in enough of the halves."""
        without_runs = _gone_without_runs(self.parts, self.runs, chosen)
        return without_runs or _gone_in_halves(self.parts, chosen)

    def stands_for_something_else(self, chosen: Settings) -> bool:
        """Whether it is at its limit, and does not hold or is not determined."""
        unsound = self.falls_at or not self.determined or self.is_gone_on_parts(chosen)
        return self.at_limit and bool(unsound)


def sizes(problem: Problem, fit: Fit, effect: str) -> dict[str, float]:
    """Numbers of an effect, from its off-value on, in usual sizes, however wide priors are by now.

    One that acts and stands at another limit, as an inertia of a fifth of the file's, has as many as
    are believed at most.

    Args:
        problem, fit: with the effect. effect: an active one.
    """
    acting = set(problem.acting_names(effect))
    found = {}
    for f in problem.model.effect_parameters(effect):
        value = fit.values[f.name]
        limited = f.name in acting and f.is_at_limit(value)
        found[f.name] = MOST_USUAL_SIZES if limited else abs(value - f.value) / f.std
    return found


def is_limit(size: float) -> bool:
    """Whether a number of so many usual sizes stands at the limit of what is believed."""
    return size > AT_LIMIT * MOST_USUAL_SIZES


def has_limit(numbers: Mapping[str, float]) -> bool:
    """Whether one of an effect's numbers, in usual sizes, stands at that limit."""
    return any(is_limit(size) for size in numbers.values())


def without_name(against: Mapping[str, Against], chosen: Settings) -> set[str]:
    """Effects to which no name is given.

    Args:
        against: of each active effect. chosen: what decides.
    """
    standing_in = {e: of for e, of in against.items() if of.stands_for_something_else(chosen)}
    limited = {e: of for e, of in against.items() if of.at_limit}

    def is_rest(effect: str, of: Against) -> bool:
        """Whether a cause that could not be as large as it is leaves as much in the same channels."""
        beside = _shows_beside(effect, of, limited)
        return any(of.nats < chosen.limited_form * limited[e].nats for e in beside)

    def voices(effect: str, of: Against) -> int:
        unseen = bool(of.coloured) or of.poses_alone or of.smoothed
        weak = unseen and of.nats < chosen.sure_evidence
        beside = any(_shows_beside(effect, of, standing_in))
        parts = of.is_gone_on_parts(chosen)
        none = of.may_be_none and not of.alternatives  # else one of these is in its place
        seen = (bool(of.coloured), bool(of.falls_at), none, of.is_denied)
        torn = of.may_be_none and bool(of.beside_moved)
        return sum((*seen, of.within_form, of.may_be_shock(chosen), weak, parts, beside, torn))

    return {
        effect
        for effect, of in against.items()
        if of.at_limit
        or of.likelier_without
        or of.nats < chosen.evidence  # in the model by what it flies (evidence.stays_without_a_name)
        or of.is_little_change(chosen)
        or of.is_weak_and_falls(chosen)
        or of.is_not_clear_and_denied(chosen)
        or of.by_speeds_alone
        or is_rest(effect, of)
        or voices(effect, of) >= SPEAKING_AGAINST
    }


def _shows_beside(effect: str, of: Against, others: Mapping[str, Against]) -> Iterator[str]:
    """Those of some others that show in the same channels as an effect."""
    return (e for e, it in others.items() if e != effect and set(it.channels) & set(of.channels))


# --- in plain words ---------------------------------------------------------------------------------


def doubts(effect: str, against: Mapping[str, Against], chosen: Settings) -> Iterator[str]:
    """Reasons against a name.

    Args:
        effect: the name. against: of each active effect. chosen: what decides.
    """
    of = against[effect]
    if of.coloured:
        coloured = and_list([channel_name(c) for c in of.coloured])
        yield f"it shows in {coloured}, where the model leaves more than noise"
    elif of.elsewhere > MOST:
        yield "the model leaves more than noise in most of what was read"
    for channel, nats in of.likelier_without.items():
        yield (
            f"the readings of {channel_name(channel)} are {nats:.0f} nats likelier without it: "
            "a sensor that is late or wrong looks so"
        )
    if of.loud:
        loud = and_list([channel_name(c) for c in of.loud])
        yield f"a run is over {LOUD:g} times as loud in {loud} as the noise that was fitted"
    if of.beside_terms:
        acts = and_list([channel_name(c) for c in of.beside_terms])
        yield f"something that no effect explains acts in {acts}, too: it may be a part of that"
    if of.beside_moved:
        moved = and_list([plain(name) for name in of.beside_moved])
        yield f"beside it the vehicle's {moved} had to go far from the file's: one of the two is wrong"
    if of.taken_back_by:
        other = plain(of.taken_back_by)
        yield f"{other} beside it takes it back at rest: gyros that are turned alone look like both"
    if of.by_speeds_alone:
        yield (
            "no reading but the rotors' speeds shows it: speeds that are read late look the same; "
            "quick changes of thrust or torque would tell"
        )
    if of.followed:
        yield "an onboard filter's states were read, which follow what is wrong with their sensors"
    yield from under_noise(of.falls_at)
    yield from on_parts(of.parts, of.runs, chosen)
    yield from of_sizes(of.sizes)
    yield from _beside_limits(effect, against)
    if not of.determined:
        yield "none of its numbers is determined"
    if of.may_be_none:
        yield "its numbers may as well be none: models that do as well have others"
    if of.unseen and of.is_denied:
        there, expected = f"{of.unseen.nats:z.0f}", f"{of.unseen.expected:.0f}"
        yield f"on the held-out runs it is worth {there} nats, where {expected} were to be expected"
        if of.flies_worse:
            yield "with the causes the model flies the held-out runs worse than as given"
    if of.where_most and of.where_most.is_another:
        percent, size = 100.0 * of.where_most.share, of.where_most.size
        yield (
            f"where the flights show half of it, in {percent:.2g} % of the time, it has {size:.1f}"
            " times its size: something of another form looks so"
        )
    if of.within_form:
        share = 100.0 * math.sqrt(chosen.oscillating_form)
        yield (
            "the control loop oscillates: at one frequency causes beside it leave as much if their form"
            f" is wrong by {share:.0f} %"
        )
    if of.alternatives:
        others = and_list([plain(name) for name in of.alternatives])
        yield f"these flights cannot distinguish it from {others}"
    if of.clock_error > 0.0:
        yield f"the times of the log's rows are wrong by {1e3 * of.clock_error:.2g} ms"
    if of.smoothed:
        yield "a low-pass of the accelerometers too fast to be seen does the same"
    if of.nats < of.errors_left:
        yield "readings have errors that last, worth more than it: a sensor that drifts has a bias"
    if of.may_have_been_constant(chosen):
        worth = f"that it was not always so is worth {of.of_moment:.0f} nats only"
        yield f"{worth}: a law of another form may look like a change"
    yield from weak(of.nats, of.shaken, chosen)


def under_noise(variations: Iterable[str]) -> Iterator[str]:
    """What other noise says against a name.

    Args:
        variations: of the noise under which it does not hold.
    """
    every = list(variations)
    if every:
        shown = every[:MOST_VARIATIONS]
        if len(every) > MOST_VARIATIONS:
            shown.append(f"{len(every) - MOST_VARIATIONS} more changes of the noise")
        yield f"it does not hold at {and_list(shown)}"


def on_parts(of_parts: Replication, runs: int, chosen: Settings) -> Iterator[str]:
    """What left-out runs and halves say against a name.

    Args:
        of_parts: how it fared. runs: number of runs that were fitted.
        chosen: the shares that it needs.
    """
    if runs < 2:
        yield "one run alone was fitted"
    elif _gone_without_runs(of_parts, runs, chosen):
        if len(of_parts.rests_on) == 1:
            yield f"it rests on {of_parts.rests_on[0]} alone"
        else:
            yield f"it is gone without {' or without '.join(of_parts.rests_on)}"
    if of_parts.kept is None:
        yield "no half of the flights could tell"
    elif _gone_in_halves(of_parts, chosen):
        yield f"it returns in {100.0 * of_parts.kept:.0f} % of the halves of the flights"


def _gone_without_runs(of_parts: Replication, runs: int, chosen: Settings) -> bool:
    """Whether a name does not return without enough of the runs; of one run nothing is left out."""
    return runs > 1 and of_parts.runs < chosen.least_runs


def _gone_in_halves(of_parts: Replication, chosen: Settings) -> bool:
    """Whether a name does not return in enough of the halves that could tell, where some could."""
    return of_parts.kept is not None and of_parts.kept < chosen.least_kept


def of_sizes(numbers: Mapping[str, float]) -> Iterator[str]:
    """What unusual sizes say against a name.

    Args:
        numbers: name -> usual sizes.
    """
    for name, size in numbers.items():
        if is_limit(size):
            limit = f"{plain(name)} stands at the limit of what is believed"
            yield f"{limit}: something else hides behind the name"
        elif size > UNUSUAL_FROM:
            yield f"{plain(name)} is {size:.1f} usual sizes"


def _beside_limits(effect: str, against: Mapping[str, Against]) -> Iterator[str]:
    """What stands at its limit leaves a part of itself to others that show in its channels."""
    limited = {e: of for e, of in against.items() if of.at_limit}
    others = [plain(e) for e in _shows_beside(effect, against[effect], limited)]
    if others:
        limit = f"{and_list(others)} beside it stands at the limit of what is believed"
        yield f"{limit}: it may be a part of that"


def weak(nats: float, shaken: bool, chosen: Settings) -> Iterator[str]:
    """What little evidence says against a name.

    Args:
        nats: its evidence. shaken: whether gusts come in single shocks. chosen: what is enough.
    """
    if shaken and nats < chosen.clear:
        yield f"gusts come in single shocks here, and {nats:.0f} nats may be one of them"
    elif nats < chosen.sure_evidence:
        yield f"it is worth {nats:.0f} nats only: an effect that is in no list may look like it"
