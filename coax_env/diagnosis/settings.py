"""Every number by which the diagnosis decides, with its unit and where it comes from.

Evidence is a log Bayes factor in nats. "Measured" means on synthetic flights by other code
(tests/injector.py, scripts/study_diagnosis.py); "ours" is a choice that no figure is sensitive to.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class Settings:
    """Thresholds, tolerances and limits of the search, of the generic terms and of the report."""

    # --- what a cause must be worth ----------------------------------------------------------------
    evidence: float = 14.0
    """nats; measured: 1 % of 200 clean flights reach 11.1 (8.9 to 13.5), calibration.json."""
    slow_rows: float = 0.025
    """s between rows beyond which what a command did before the next one is not known; ours, between
    the 10 ms and the 38 ms that were measured."""
    unknown_commands: float = 0.06
    """s between known commands, those between on straight lines, from which nothing that looks like a
    weak or late answer is asked for. At 10 Hz a clean **synthetic** flight had a late command of 612
    nats, a yaw inertia of 152 and two dampings; at 20 Hz one of two had a servo's lag of 37; ours."""
    unseen_inflation: float = 3.0
    """Times that what looks like a weak or late answer must then be worth more, where gusts are not as
    the filter has them, and behind a low-pass. Measured by 26 Hz telemetry (`study_diagnosis.py --arms
    telemetry`, seeds 70 and 71): 5 of 71 clean flights had a name, motor_droop four times, worth 31
    nats at most; true ones that should show 51 to 196. In gusts with a frequency, taken for gusts that
    fade: a play or a lag of the servos on 5 of 8 clean flights, 23 to 41 nats. And times that the
    variance of the vehicle's own such numbers is larger (evidence.beside_unseen_answers)."""
    seldom_poses_inflation: float = 5.0
    """The same by poses alone that come seldom, where neither is seen in time. Measured by a camera
    (`study_diagnosis.py --arms camera`, seeds 790 and 791): on four clean flights the strongest was
    worth 47 to 58 nats before, a play or a motor lag; three plays of 45 to 62 had had a name."""
    beyond_even_spread: float = 10.0
    """nats beyond an even spread over time that such a cause must gain where the flights show most of
    it, to be worth what it seems (where_shown.py). 32 that nobody hid gained 2 at most; ours."""
    tie: float = 6.0
    """nats within which alternatives are confounded: odds of 400 to 1, ours."""
    form_share: float = 0.1
    """Of a servo's evidence, within which its lag and its delay are confounded, if more than a tie; by
    poses alone of any cause's, and what is never named beside it. Measured: by 5 and 7 % of it a delay
    won where a lag of another form was hidden; where either was true it won by 12 and 13 %. By 5 % a
    swash phase won by smoothed poses where the frame was turned by the same angle."""
    form_error: float = 1e-4
    """Of what all causes explain, at the noise as it is: what one whose form is right to 1 % leaves to
    another that is not there. More than `evidence` only where they explain 140,000 nats. Measured on
    840 s and 3,492 s of flight with a motor lag of another form: beside it a servo's lag and delay
    and a rate damping, which nobody hid, were worth up to 5e-5 of it, what was hidden 1.4e-4 and
    more."""
    oscillating_form: float = 0.0225
    """The same where the control loop oscillates through the flight: of a form that is right to 15 %.
    Everything is at one frequency there, so that what forms are wrong by does not cancel. Measured on
    flights by blade elements whose heading swings at 6.5 Hz: false names had 0.2 and 1.4 % of what all
    causes explained, true ones 4 % and more."""
    limited_form: float = 0.0225
    """The same of what a cause explains that stands at its limit: of a form that is right to 15 %. A
    motor's lag of 0.58 s that is held to 0.5 s leaves a droop of 106 nats (of 54,000; `--arms
    sizes_large --seed 859`, one 502, **synthetic**)."""
    against_share: float = 0.001
    """Of what a cause is worth in all, that the readings of a channel that should show it must be
    likelier without it, and `evidence`, to speak against its name. Measured: at most 6 nats of true
    causes, 0.4 to 2.6 % of what a motor lag was worth that was the rotor speeds' own filter; ours: ten
    times `form_error`."""
    most_causes: int = 10
    """Ours; a bound on time."""

    # --- fits --------------------------------------------------------------------------------------
    step_gain: float = 2.0
    """nats: a Gauss-Newton step with a smaller predicted gain is not worth its time; ours."""
    most_steps: int = 4
    """Gauss-Newton steps of one fit during the search; ours."""
    most_turns: int = 6
    """Turns of noise levels and parameters until both have converged; ours."""
    noise_fit_seconds: float = 60.0
    """s of flight on which noise levels are fitted at least while the search goes on; ours."""
    noise_fit_share: float = 1.0 / 3.0
    """Share of the flight on which they are fitted at least.

    Levels from a part cost the whole about half a nat each, times the whole over the part: with a
    third 1.5 each; with 60 s of 840 s it was 160 nats in all, which effects that are not there took up.
    """
    noise_gain: float = 0.2
    """nats that the slopes of the noise levels must promise in all, for these to be fitted once more on
    all of a flight with slow rows; elsewhere `step_gain`. Where slopes scatter they promise too little:
    less than 2 where 15 came, beside a swash offset that the gusts' memory had taken up
    (`study_diagnosis.py --arms telemetry --seed 845`, one 372)."""
    noise_evaluations: int = 5
    """Likelihoods of a fit of the noise levels from where they stand; ours."""
    first_noise_evaluations: int = 10
    """The same from a guess; ours."""
    refinement_gain: float = 0.02
    """nats that the last step of a final fit may still predict: a fifth of a standard deviation.

    step_gain would leave two, and always on the side that the search came from.
    """
    most_refinements: int = 4
    """Newton steps of the final refinement; ours."""
    difference_step: float = 0.3
    """std: step of a difference of log-likelihoods; ours."""
    std_ratio_bounds: tuple[float, float] = (0.5, 2.0)
    """What the likelihood's own curvature may do to a standard deviation; ours."""

    # --- moves of the search -----------------------------------------------------------------------
    trial_share: float = 0.5
    """Share of `evidence` from which an effect that the quadratic does not carry is fitted as a trial.

    Measured: a damping worth 29 nats once fitted had a predicted gain of 11.
    """
    noise_trial_share: float = 0.25
    """The same of one that is fitted with the noise, which may have taken it up: a swash offset worth
    35 nats then had a score of 7.1, 18.5 once its numbers were fitted (as under `noise_gain`)."""
    most_noise_trials: int = 6
    """Such effects that are fitted at once, best first; ours."""
    damping_probe: float = 4.0
    """std by the signatures, at which a damping is given to the likelihood itself; ours."""
    add_before_fitted: float = 10.0
    """An effect with a score of so many times the predicted gain of another step is added at once."""
    most_failures: int = 3
    """Additions in a row that do not hold before the search ends; ours."""
    most_trials: int = 3
    """Swaps, additions and confounded alternatives that are fitted at once, best first; ours."""
    clear_evidence: float = 10.0
    """Thresholds that a cause is worth after a first refit without it, to need no closer one; ours."""

    # --- white process noise and drifts of trim -------------------------------------------------------
    latent_noise_score: float = 2.0
    """std of the score by which such noise must want to be more before its levels are fitted; ours."""

    # --- generic terms -----------------------------------------------------------------------------
    term_evidence: float = 28.0
    """nats a generic term must be worth: twice an effect, of which there are a tenth as many."""
    term_evidence_white: float = 56.0
    """nats, on an axis whose innovations are white. Measured: on a clean gusty flight of eight runs
    the best of all terms on all axes reached 4, a moment a sin(3 psi) of the gusts' own rms 155."""
    term_share: float = 0.4
    """Share of an axis' estimated disturbance that a term must follow: on real flights everything is
    a little coloured, and some term is always worth a few nats."""
    terms_screened: int = 10
    """Candidates of an axis that are looked at by their signatures; ours."""
    most_terms: int = 4
    """Taken in all; ours."""

    # --- when a name may be believed ---------------------------------------------------------------
    return_quantile: float = 1.645
    """std: a cause that is spread evenly returns in 95 % of the parts of the flights."""
    return_least: float = 2.0
    """std by which a name must stand on a part at least: by chance, and the same way, 2 % do."""
    least_runs: float = 0.75
    """Share of left-out runs without which a name must return: it may rest on one of four runs, as a
    ground effect on the only low one, and not on one of two or three."""
    least_kept: float = 0.8
    """Share of the halves in which a name must return. Of 20 halves a cause at the threshold, spread
    evenly, misses so many once in 400; what one run alone made is in half of them."""
    splits: int = 10
    """Random splits of the runs, two halves each; ours."""
    piece_seconds: float = 5.0
    """s of the pieces that a few runs are cut into; each loses a second to its filter's start; ours."""
    noise_factor: float = 2.0
    """Times which, and part of which, every noise level must leave a name standing."""
    noise_share: float = 0.35
    """Share of the information on each cause that the runs flown again with other noise have; ours."""
    noise_clear: float = 14.0
    """Thresholds: of a cause that is worth more, as much is enough as is a share of so many; ours."""
    felt_change: float = 1.0
    """Sum of squared changes of whitened innovations under which no score moves by a std: such a
    level, one at its floor above all, is not felt and not varied."""
    sure_evidence: float = 42.0
    """nats: three thresholds. Measured (`study_diagnosis.py --arms all`, seeds 50 to 52, 310 flights):
    so 92 of 110 true names stay sure, and 1 of 8 false ones; of four for effects in no list, none.

    And nats that a cause must be worth to have a name where that it began, ended or changed in flight
    is worth less: any effect could have, at any moment. Measured: four of some 940 clean flights had
    such a cause, of 18, 26, 27 and 29 (the last: `--arms mixed`, seed 805, clean 100), and by poses
    alone another, of 33."""
    holding_evidence: float = 28.0
    """nats: two thresholds. Worth less, what does not hold under other noise has no name. Measured
    (`--arms all`, seeds 825 to 829): of 14 names of less two did not, a true one and a false one."""
    shocks: float = 3.0
    """Excess kurtosis of the gusts' increments from which they come in shocks: that of a Laplace
    distribution. Measured: 0.1 to 2.4 of gusts that do not, 5.9 to 154 of those that do (shocks.py)."""
    undetermined: float = 0.7
    """Posterior std over the prior's beyond which a number is not determined: the flights have then
    told less than the prior knew."""

    # --- hold-out, gain and report -----------------------------------------------------------------
    horizon: float = 1.0
    """s flown open loop for the gain."""
    fewest_runs: int = 4
    """With fewer runs, the last third of each is held out."""
    white_noise_reported: float = 5.0
    """Times its floor above which a level of white process noise is reported; ours."""
    moved_by_unseen: float = 5.0
    """std that an effect which these flights cannot show must move a number to be reported; ours."""
    moved_by_undecided: float = 2.0
    """std by which one that they neither show nor rule out must move it; ours."""
    most_warnings: int = 3
    """Such remarks; ours."""

    @property
    def clear(self) -> float:
        """Evidence [nats] of a cause that is clear."""
        return self.clear_evidence * self.evidence


SETTINGS = Settings()
"""What the diagnosis uses, and what its calibration and studies were measured with."""
