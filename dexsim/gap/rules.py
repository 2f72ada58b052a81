"""The figures that decide: what each means, where its value came from, and which test fails if it is moved.

What stays elsewhere decides no name, confidence or verdict by itself: sizes, bounds and starts of an effect (in its
class), whether a reading is rounded (in `plant/case.py`: its noise then is its quantum's), figures of the numerics
(steps, damping, ridges, filters' widths, grids, caps of a misfit, what a fit trims, bootstraps' draws and blocks, the
rounding of 0), and how much is searched (windows, budgets, lengths of short lists, how many drafts are looked at
closely, whose motion is refined: more of it takes longer).
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import TypeVar

T = TypeVar("T", int, float)


def _rule(value: T, means: str, source: str, test: str) -> T:
    """A figure: what it means, where its value came from, its test in tests/test_gap_rules.py (touch:
    tests/test_gap_rules_touch.py, torque: tests/test_gap_rules_torque.py, beliefs:
    tests/test_gap_rules_belief.py, signals: tests/test_gap_rules_signal.py)."""
    made: T = field(default=value, metadata={"means": means, "source": source, "test": test})
    return made


@dataclass(frozen=True)
class SearchRules:
    """What the search of one joint decides by."""

    least: float = _rule(
        0.12,
        "share of the squared error on what was left out that an effect must remove, of joints, of torques and of "
        "touch; a joint is searched again where what is known of the others changes its loss by as much",
        "with nothing missing some effect removes a twentieth by accident; set above on planted cases",
        "test_an_effect_must_remove_a_least_share",
    )
    chance: float = _rule(
        0.03,
        "share of the bootstraps in which an effect, of joints, of torques or of touch, may be of no use to what was "
        "left out",
        "one-sided, between the customary 1 and 5 %; none of 42 empty cases of another plant alarmed with it",
        "test_an_effect_must_help_in_nearly_all_bootstraps",
    )
    price: float = _rule(
        0.05,
        "chance that the scan's best effect is there by accident, at most; four times as much are still tried",
        "the customary 5 %",
        "test_the_short_list_asks_a_price",
    )
    doubt: float = _rule(
        0.015,
        "relative: what a fitted effect is off by whatever the residuals say: a further one must remove more than this "
        "of what the earlier ones did; of its room, a plain model's figure must differ by more from what is believed",
        "planted sizes are off by 0.6 to 1.3 % in the median",
        "test_intervals_hold_what_no_residual_shows",
    )
    imitates: float = _rule(
        0.08,
        "relative, of its loss: what a hypothesis must do better that can imitate simpler ones, as an eccentricity "
        "whose zero is anywhere imitates a zero error",
        "above two of what nothing is trusted finer than (`apart`); at 0.2 an eccentric encoder of another plant was "
        "taken for a zero error",
        "test_what_can_imitate_another_effect_must_do_better",
    )
    bounded: float = _rule(
        1.5,
        "x its loss: what a hypothesis counts for whose size stopped at the end of what is physical",
        "above 1.1: an inertia half as large again was taken for a reading scaled by 0.7, the least that is tried, "
        "which follows it a tenth better since it scales the friction too",
        "test_a_size_at_its_bound_must_do_far_better_than_another",
    )
    enough: float = _rule(
        1.08,
        "x the noise: an error within it needs no effect",
        "noise of 300 independent samples, as a minute of recordings has, passes it once in 40",
        "test_within_the_noise_nothing_is_looked_for_nearby",
    )
    astray: float = _rule(
        10.0,
        "x the noise: where a further effect leaves more, whole recordings run free may speak for it, too",
        "between 9, the most left beside what was found in 35 cases of another plant, and 60, of a real pendulum",
        "test_far_from_the_noise_whole_recordings_decide",
    )
    tie: float = _rule(
        0.02,
        "of the loss: nearer than this, fits without each condition decide; of the squared error on what was held out: "
        "nearer than this it speaks neither for an effect nor against it",
        "twice the 1 % at which fits to what is not left out end",
        "test_where_two_fits_are_close_fits_of_their_own_do_not_decide",
    )
    clear: float = _rule(
        0.11,
        "share of the squared error where it was fitted that an effect must remove where that is within the noise "
        "without it",
        "set on benchmarks.planted: there is less to tell effects by",
        "test_within_the_noise_an_effect_must_be_clear",
    )
    apart: float = _rule(
        0.03,
        "relative, of a loss: finer than this nothing is to be trusted. A rival as much worse than the best counts for "
        "a third of it in one draw, and laws of one effect that come within twice as much may each be the true one; a "
        "parameter costs as much, and an effect must promise as much in the scan; of its misfit without any effect a "
        "signal counts as much as noise, beside another",
        "twice `doubt`, since a square is off by twice what a size is; in each of its uses the learning cases that "
        "read it (friction, empty, delay) answer the same from 0.015 to 0.06",
        "test_rivals_are_told_apart_by_what_they_lose",
    )
    unsettled: float = _rule(
        1.7,
        "x the noise squared: what leaves more has not been followed: every effect that helps is tried, whatever its "
        "price, laws that training has less exactly too, and of several joints each again with what was found in the "
        "others",
        "the square of what is within the noise (`judge.within`), rounded up",
        "test_joints_that_are_not_followed_are_looked_at_again",
    )
    approximate: float = _rule(
        0.5,
        "share of what stand-ins leave beyond the noise, on what was left out, that a law which training has less "
        "exactly may leave in their place",
        "between 0.16, the most of three where that law is the true one, and 1.5, the less of two where another "
        "friction and a late drive are: what training can be given goes before what explains a little more",
        "test_a_law_that_training_lacks_must_explain_far_more",
    )
    most: int = _rule(
        4,
        "effects on one joint or pad",
        "of ten names said fourth or later on a joint, in answers to five sets of cases, one is true",
        "test_a_joint_has_at_most_so_many_effects",
    )
    rival: float = _rule(
        2.5,
        "x the loss, or the noise squared where less is left: a hypothesis that leaves more, as a draft on short "
        "windows or where it was fitted, is no rival",
        "of 12 rivals in six learning cases drafts that left 3.7 x the loss and more ended at 5.6 x and more, and "
        "the nearest, at 1.13 x, won no draw",
        "test_what_cannot_follow_is_no_rival",
    )
    lead: float = _rule(
        0.1,
        "share of the bootstraps by which a rival must win more often to be taken in an effect's place",
        "two that win evenly differ by as much in one of 24 lots of 300 draws",
        "test_a_rival_that_wins_clearly_takes_the_place",
    )
    rare: float = _rule(
        2.5,
        "x `chance` for a first effect that removes from twice `least` on, twice that from four times on: few "
        "moments show it, and draws vary",
        "what shows in three blocks is missed by a draw in 20, in two by one in seven: 2.5 x 0.03 lies between",
        "test_a_first_effect_of_few_moments_may_be_of_no_use_to_more_draws",
    )
    warmth: float = _rule(
        2.0,
        "degC: a smaller change of temperature tells nothing of heat",
        "twice the 1 degC that servos' sensors resolve",
        "test_a_small_change_of_temperature_tells_nothing",
    )
    loud: float = _rule(
        3.0,
        "x how much a joint shakes in its quietest stretch, and simulated without any effect: it shakes by itself",
        "between 1.7, the most of joints with friction, play, delay or ripple, and 9.6, the least of one that rings",
        "test_a_joint_shakes_that_is_far_louder_than_at_its_quietest",
    )
    shaking: int = _rule(
        3,
        "windows of a second in which a joint must shake for that to tell of an effect; one of them held out where it "
        "is judged",
        "of fewer windows more than one bootstrap in 20 draws none; one that rings does in five of six",
        "test_a_joint_must_shake_in_some_windows",
    )
    resting: float = _rule(
        1.0 / 9.0,
        "weight of the square by which the mean position is missed, in usual misses, beside squares of the logarithm "
        "by which the shaking is",
        "an elasticity that rings is found within 4 % of its size from 1/9 to 4/9, a fifth off from 1/18 down, a tenth "
        "from 1 up",
        "test_how_much_a_joint_shakes_counts_before_where_it_rests",
    )

    coupled: float = _rule(
        0.03,
        "of a joint's typical torque: what reaches it from the motion of others: from it on it matters how well that "
        "is known, and joints are searched again with what was found in the others",
        "below `belief.tolerance`: were all of it wrong, the torque would be off by less than figures of a drive are",
        "test_joints_are_searched_again_that_feel_each_others_motion",
    )
    plainly: float = _rule(
        0.24,
        "share that an effect must remove of what is missed of how a joint rings to be named by it; of the squared "
        "error to be doubted only where a free run does not show it",
        "twice `least`, and below a half, which what makes a made-up loop ring removes at least",
        "test_an_effect_must_plainly_tell_how_a_joint_rings",
    )


@dataclass(frozen=True)
class JudgeRules:
    """What the verdict and the confidence of a name of the drives are decided by; touch has its own beside the
    verdict's."""

    within: float = _rule(
        1.3,
        "x the noise: an error within it asks for no effect, and is as good as any; beyond it it is said what it "
        "depends on, and a torque stands in; two that differ by less are the same: of repeats, of two engines, of one "
        "regime and the rest, of a taxel in its own place and in another's, of a gain for every taxel and one for all",
        "halved, an empty learning case is not told as such; empty cases lie at 1.0 (55 of our own plant) and 1.4 "
        "(166 of another) in the median",
        "test_an_error_within_the_noise_asks_for_nothing",
    )
    far: float = _rule(
        5.0,
        "x the noise floor: an error that large is not nothing, though only a few moments show it; a taxel that is "
        "pressed by as much feels it, and two that are exchanged are missed by more",
        "above 4.8, the most of 166 empty cases of another plant",
        "test_a_large_error_is_never_nothing",
    )
    removed: float = _rule(
        0.3,
        "share of the gap between error and floor that names must remove to count as a part of the answer; of the "
        "squared error, from which on what stays costs a name `left_costs` of its confidence",
        "what `partly_explained` says (docs/reference/files.md)",
        "test_what_counts_as_a_part_of_the_answer",
    )
    firm: float = _rule(
        0.5,
        "confidence from which a name counts; below it is a hint",
        "of names below it 34 of 267 are true, from it on 248 of 268 (answers to five sets of cases)",
        "test_names_below_firm_are_hints",
    )
    hinted: float = _rule(
        0.45,
        "confidence that a name keeps at most which the error on what was held out does not bear out",
        "below `firm`, so that it is a hint",
        "test_what_is_not_borne_out_keeps_little",
    )
    doubted: float = _rule(
        0.7,
        "confidence that a name keeps at most where one reason speaks against it",
        "below `sure`: a doubted name is not a confident one",
        "test_one_reason_against_a_name_makes_it_doubted",
    )
    sure_of_one: float = _rule(
        0.75,
        "confidence of at least one name, or a set, without which nothing counts as explained",
        "between `doubted` and `sure`",
        "test_nothing_is_explained_by_doubtful_names_alone",
    )
    sure: float = _rule(
        0.8,
        "confidence from which a name stands alone: below it training is also given what was believed before",
        "of names below, about half are true (lab/results/concealed.md)",
        "test_what_is_not_sure_is_handed_on_with_what_was_believed",
    )
    earns: float = _rule(
        0.1,
        "share of the error held out that a name must cost when dropped to keep all of its confidence; that a "
        "stand-in torque must take off; that the engine may leave beside what the plant leaves, in squares",
        "wrong names remove 3 to 8 % of the error in the median, 19 of 20 right ones a fifth and more (four sets of "
        "cases of another plant)",
        "test_a_name_earns_its_confidence_by_what_it_removes",
    )
    repeated: float = _rule(
        0.2,
        "of the largest of an effect's sizes in fits without one condition each: the least must be as large",
        "a size that a fifth of the evidence changes five-fold is not one size",
        "test_a_size_that_fits_without_a_condition_do_not_repeat_is_a_hint",
    )
    most_left_out: float = _rule(
        0.2,
        "share of what was held out that may say nothing of an effect: more of it is not a few moments",
        "made for a true dead zone that one half second at a limit, missed alike with it and without, had lost",
        "test_moments_that_nothing_follows_do_not_speak",
    )
    many_on_a_joint: int = _rule(
        3,
        "effects on one joint from which on the smaller ones are taken for a series of stand-ins",
        "of 36 names said third or later on a joint one is true, of 106 second ones 24 (five sets of cases)",
        "test_many_effects_on_one_joint_are_doubted",
    )
    least_share: float = _rule(
        0.04,
        "of the squared error before: a further effect that removes less may be what the first one's law gets wrong",
        "a law that is off by a fifth leaves as much",
        "test_what_is_small_beside_another_effect_is_doubted",
    )
    left_costs: float = _rule(
        0.5,
        "share of its confidence that a name loses at most by what stays unexplained",
        "of names that leave up to 0.05 of the squared error 149 of 216 are true, up to 0.3 (`removed`) 41 of 92, "
        "beyond it 16 of 130 (four sets of cases of another plant): there only what wins every draw is no hint "
        "(`firm`)",
        "test_what_stays_unexplained_costs_confidence",
    )
    one_load: float = _rule(
        0.3,
        "standard deviation over mean of the load on the gear while a joint slides: less is one load, under which "
        "friction that"
        " grows with it is not told from friction that does not",
        "between 0.12 (a case of another plant with one load) and 0.54 (the least of six with several)",
        "test_friction_at_one_load_is_a_set",
    )
    part: float = _rule(
        0.2,
        "share of the squared error on what was held out that an effect removes at least that is more than a hint; a "
        "half second that it changes by half as much can speak of it; of several on a joint, one that surely removes "
        "less, and without which the error is lower, is taken back",
        "wrong names remove 0.07 to 0.16 in the median, 19 of 20 right ones 0.37 and more (four sets of cases of "
        "another plant)",
        "test_an_effect_must_remove_a_part_of_what_was_held_out",
    )
    borne_out: float = _rule(
        0.15,
        "share of the squared error on what was held out that an effect removes in all but a twentieth of its draws: "
        "moving less than half a count of the encoder, or harming a recording, then makes it doubted, not a hint",
        "between 0.11, the most in 118 empty cases of another plant, and 0.19, the least of five small true effects",
        "test_what_was_held_out_surely_shows_is_doubted_only",
    )
    level: float = _rule(
        0.05,
        "share of the draws of recordings in which an effect may do more harm than good; of the bootstraps that a "
        "rival of its class wins without which the name is no set; false-discovery rate of what the rest is said to "
        "depend on (Benjamini and Hochberg 1995)",
        "the customary 5 %",
        "test_an_effect_that_harms_some_recordings_is_a_hint",
    )
    stretch: float = _rule(
        0.5,
        "intervals grow by this, times the square of what is left of what was held out over the noise",
        "coverage of 90 % intervals on concealed cases (docs/concepts/gap.md)",
        "test_intervals_grow_with_what_is_left",
    )
    stretch_least: float = _rule(
        0.5,
        "the least factor on intervals",
        "coverage on concealed cases",
        "test_intervals_grow_with_what_is_left",
    )
    stretch_most: float = _rule(
        4.0,
        "the largest factor on intervals",
        "coverage on concealed cases",
        "test_intervals_grow_with_what_is_left",
    )
    jitter: float = _rule(
        8.0,
        "gain of the log likelihood from which jitter of a delay is reported",
        "a likelihood-ratio test passes it by chance three times in 100,000",
        "test_jitter_is_reported_where_the_likelihood_gains_much",
    )
    settled: float = _rule(
        3.0,
        "x the noise: a motion on which two hypotheses differ by as much settles between them alone",
        "three standard deviations: noise passes it once in 370",
        "test_a_motion_that_settles_it_is_planned_alone",
    )
    surest: float = _rule(
        0.99,
        "the largest confidence of a name",
        "143 of 143 names said with it are true: 0.98 at least, and no number of cases shows 1",
        "test_no_name_is_certain",
    )
    resolved: float = _rule(
        0.5,
        "counts of the encoder: an effect that moves the joint by less is doubted",
        "a reading is rounded to half a count",
        "test_less_than_half_a_count_is_doubted",
    )
    ordered: float = _rule(
        0.9,
        "correlation of ranks from which on a temperature is said to follow the clock",
        "variances of what is fitted to both then grow fivefold (1 / (1 - 0.9^2)), from which on two are customarily "
        "called collinear",
        "test_a_temperature_that_follows_the_clock_is_said",
    )
    acts: float = _rule(
        0.25,
        "of its most: from there on an effect acts, where stretches of time are told",
        "from there on an effect of the concealed cases counts as acting (benchmarks/concealed/generate.py)",
        "test_when_an_effect_acts",
    )
    kept_end: float = _rule(
        0.25,
        "of the time of a recording, where its end is held out",
        "the customary quarter",
        "test_the_end_of_a_recording_is_held_out",
    )
    kept_most: float = _rule(
        0.45,
        "of all time that may be held out",
        "below a half: what is fitted must be more than what judges",
        "test_a_condition_that_is_most_of_the_time_is_fitted",
    )
    turning: float = _rule(
        0.1,
        "of its large speed: from there on a joint moves, where braking is told from rest, a recording begins in "
        "motion, or a torque is fitted while its joint moves",
        "between 0.04, which a count of 12 bits over two samples at 100 Hz is of 2 rad/s, and 0.3, slower than which "
        "a joint that swings evenly is a fifth of its time",
        "test_regimes_of_a_motion",
    )
    slides: float = _rule(
        0.02,
        "of a joint's large speed: from there on it slides, where friction acts, and has set itself in motion; slower "
        "it stands",
        "the spread of a load while it slides is the same within a tenth from 0.01 to 0.04 on ten made-up cases",
        "test_what_stands_tells_of_no_load_under_which_it_slides",
    )
    outer: float = _rule(
        0.3,
        "of the largest speed, load or acceleration, of a position's way from its middle to each end, of a "
        "temperature's span at each end: what is a regime of its own",
        "a joint that swings evenly is beyond 0.7 of its amplitude half of the time, and so of its speed, load and "
        "acceleration",
        "test_regimes_of_a_motion",
    )
    visited: float = _rule(
        0.25,
        "s in which a regime is visited",
        "half a block of the bootstraps",
        "test_a_regime_is_visited_for_a_while",
    )
    moved: float = _rule(
        0.002,
        "rad or m: a joint whose positions span less has not moved",
        "above a count of an encoder of 12 bits, 1.5 mrad",
        "test_a_recording_at_rest_tells_nothing",
    )


@dataclass(frozen=True)
class TouchRules:
    """What the search of one pad and its judgement decide by."""

    enough: float = _rule(
        1.2,
        "x the noise: an error within it needs no effect",
        "what a crosstalk of 0.1 leaves, which a wider contact hides",
        "test_within_the_noise_no_touch_effect_is_looked_for",
    )
    earned: float = _rule(
        0.2,
        "of what keeps all confidence: an effect that earns no more on what was held out is not claimed",
        "2 % of the error: within what the plant is off by",
        "test_a_touch_effect_that_earns_next_to_nothing_is_not_claimed",
    )
    agree: int = _rule(
        5,
        "taxels with one gain from which on those that hardly felt anything are taken to have it too",
        "the range of five holds the median of all with 94 %, of four with 87 %: the least for a 90 % interval",
        "test_taxels_that_agree_speak_for_the_rest",
    )
    short: float = _rule(
        3.0,
        "s of touch on a pad, at least, before anything but constant taxels is looked for",
        "doubled, the hysteresis of a learning case with recordings of 4 s is not told",
        "test_a_pad_must_be_touched_for_a_while",
    )
    plant: float = _rule(
        0.02,
        "of a reading: finer than that the plant is not to be trusted",
        "halved, sizes or intervals of the learning case touch change; doubled, sizes or intervals of the learning "
        "case touch change; the learning case taxels answers the same from 0.01 to 0.04",
        "test_a_plant_of_touch_is_trusted_to_so_much_of_a_reading",
    )
    law: float = _rule(
        0.1,
        "of a size that hangs on how a force spreads over taxels, such as the gain of one: what that law may be off "
        "by; a gain that is less off is not listed, one that is known less well speaks for no other",
        "halved, sizes or intervals of the learning case touch change; doubled, sizes or intervals of the learning "
        "case touch change",
        "test_a_size_that_hangs_on_the_spread_of_a_force_is_as_wide_as_its_law",
    )
    timing: float = _rule(
        3e-3,
        "s by which a reading's time is uncertain",
        "a reading at 90 Hz may be a period old: 11 ms over the root of 12",
        "test_the_time_of_a_reading_is_uncertain",
    )
    gain_prior: float = _rule(
        0.3,
        "standard deviation of a taxel's gain, before anything is seen",
        "above 0.23, the most that gains scatter by in the realities of dexsim/configs/reality: it holds none of them "
        "back",
        "test_the_gain_of_a_taxel_is_believed_to_be_one",
    )
    touched: float = _rule(
        0.15,
        "N of a taxel, at least, while something is touched: a joint that moves then is not judged",
        "above a count of 0.1 N, by which a taxel may flicker at rest",
        "test_a_little_force_is_no_touch",
    )
    loaded: float = _rule(
        0.3,
        "N of a load cell, at least, while something is touched, where no taxels are recorded",
        "fifteen times the 20 mN of a cell's noise, for its zero may drift by more than it",
        "test_a_little_force_is_no_touch",
    )
    neighbours: int = _rule(
        3,
        "of a taxel that never changes: as many must feel the touch for it to be dead",
        "at the edge of a touch one or two of the taxels beside a sound one feel it",
        "test_neighbours_of_a_dead_taxel_feel_the_touch",
    )
    spread: float = _rule(
        0.15,
        "share that may pass to the taxels beside because pressure spreads by another law than the plant's: neighbours "
        "of a dead taxel that change by more feel the touch themselves",
        "between 0.1, a crosstalk that a wider contact hides, and 0.3, which is named",
        "test_a_little_crosstalk_may_be_another_law",
    )


@dataclass(frozen=True)
class TorqueRules:
    """What is decided by where a joint's motor torque, duty or current was logged: pushes from outside, what the torque
    route says, whether a drive does what is believed of it; and by the plain model beside every answer."""

    much: float = _rule(
        0.3,
        "share of the torque's variance that a fit leaves: from it on a plain one has something else that pushes, and "
        "neither the fit of the quiet rest, nor friction that the torque tells, nor the believed law of a drive is "
        "believed",
        "doubled, the push of a learning case is not told; it must be above what friction's own law leaves",
        "test_a_plain_fit_must_leave_much_for_a_push",
    )
    far: float = _rule(
        5.0,
        "x the quiet residual: a push",
        "normal noise passes it less than once in a million samples",
        "test_a_push_stands_far_out_of_the_quiet_residual",
    )
    slow: float = _rule(
        0.25,
        "of the residual's variance between half seconds: less is noise and no force",
        "between a fiftieth, of white noise at 100 Hz, and 1, of a force that lasts half a second",
        "test_a_force_lasts_and_noise_does_not",
    )
    most: float = _rule(
        0.6,
        "of the time: what pushes longer is no stretch; a joint is judged without its pushes where the rest of the "
        "time is left",
        "the trimmed fit stands on half of the half seconds, so that hardly more than half may be pushed",
        "test_what_pushes_most_of_the_time_is_no_stretch",
    )
    told: float = _rule(
        0.9,
        "confidence of what the torque itself shows, at most: of a push whose rest fits, of an effect that it names",
        "surer than any fit, since the torque itself shows it; halved, the answer to the learning case pushed "
        "changes; doubled, the answer to the learning case pushed changes",
        "test_a_push_is_named_surely_where_the_rest_fits",
    )
    fit: float = _rule(
        0.95,
        "share of a logged duty's variance that the believed law must give for a drive to be sound; what is no larger "
        "than the rest of its torque is no push",
        "a sound servo's law gives all of the variance of its recorded duty (BAM's recordings)",
        "test_a_drive_is_sound_by_its_logged_duty",
    )
    shed: float = _rule(
        0.8,
        "of the misfit: what halving the cutoff leaves at most, where what it sheds is noise of derivatives",
        "between a fifth, which is left of white noise in a second derivative, and 1",
        "test_a_cutoff_is_halved_while_that_sheds_noise",
    )
    shortest: float = _rule(
        5.0,
        "s of motion from which on a logged torque is fitted, and at 100 Hz as many samples",
        "ten blocks of the bootstraps",
        "test_a_torque_is_fitted_where_enough_was_logged",
    )
    shakes: float = _rule(
        3.0,
        "x what its slow motion alone shakes: a joint that shakes by as much rings, and nobody pushes it",
        "between 2.4, the most of an arm without ringing, and 18, the least while it rings",
        "test_a_joint_that_rings_is_not_pushed",
    )
    room: float = _rule(
        1.1,
        "x the torque that drove a joint from rest: dry friction that is larger would have held it; and x its dry "
        "friction: what a joint at rest may carry",
        "gravity and limits are off by a few percent, twice over",
        "test_friction_must_let_a_recorded_motion_begin",
    )


@dataclass(frozen=True)
class BeliefRules:
    """What any machine may be off by: it is refitted with every hypothesis, and is no finding."""

    tolerance: float = _rule(
        0.05,
        "relative: figures of a real machine are off from its data sheet by as much, and that is no finding; after a "
        "refit by half as much, whatever the residuals say; gravity that is a smaller part of a torque, or that the "
        "torque tells less well, is believed, and an error that is larger by less is as good",
        "half of the gains, inertias and limits refitted in 166 empty cases of another plant end within 2.5 %; "
        "doubled, a friction of the learning cases is less sure",
        "test_a_figure_within_its_tolerance_is_no_finding",
    )
    late: float = _rule(
        0.75,
        "periods of its loop by which any drive may act on its commands late, or of its readings, where those tell it",
        "a command waits for half a period on average, and a clock is read when it is read",
        "test_any_drive_may_be_a_little_late",
    )
    filter: float = _rule(
        0.003,
        "s: a filter of the measured speed that any drive may have",
        "19 of 20 refitted in 166 empty cases of another plant end within 2.7 ms",
        "test_any_drive_may_filter_its_speed",
    )
    gives: float = _rule(
        0.002,
        "rad by which what holds a joint gives before it slides; more is an effect, and a motion from rest",
        "19 of 20 refitted in 166 empty cases of another plant end within 1.5 mrad",
        "test_what_holds_a_joint_gives_a_little",
    )
    gives_slide: float = _rule(
        5e-05,
        "m by which what holds a slide gives before it slides",
        "as `gives` at a radius of 25 mm",
        "test_what_holds_a_joint_gives_a_little",
    )
    rings: float = _rule(
        5.0,
        "x the noise where a joint moves as fast or faster: what it shakes by beyond it is motion, not noise",
        "of 158 joints (hands, other plants, benches, a real pendulum) only the four that ring meet it and `ringing`",
        "test_a_joint_that_rings_is_not_noisy",
    )
    noisier: float = _rule(
        2.5,
        "x the usual noise of the other joints of a machine: a joint that scatters by more, and not as white noise or "
        "its motor's torque by as much more again, rings all the time",
        "between 2.2, the most of a joint beside one that rings, and 3.8, the least of five that ring all the time; of "
        "the torque two of them have 4.8 or more",
        "test_a_joint_that_rings_all_the_time_has_the_others_noise",
    )
    coloured: float = _rule(
        0.19,
        "by how much the autocorrelation of third differences differs from white noise's where a joint rings",
        "between 0.13, the most of 44 joints that do not ring, and 0.25, the least of two that ring all the time",
        "test_a_joint_that_rings_all_the_time_has_the_others_noise",
    )
    steady: float = _rule(
        2.6,
        "kurtosis of second differences below which what scatters is a swing of steady size, not noise",
        "between 2.3, of one that rings all the time, and 3.2, the least of 36 joints that do not ring; a sine has 1.5",
        "test_a_joint_that_rings_all_the_time_has_the_others_noise",
    )
    ringing: float = _rule(
        0.1,
        "share of half seconds in which a joint must ring for its noise to be told by the others",
        "as `rings`",
        "test_a_joint_that_rings_is_not_noisy",
    )
    quiet_parts: int = _rule(
        2,
        "half seconds that may be quieter by accident than what is usual where a joint moves as fast or faster",
        "a stretch no longer than half a second touches two of them at most",
        "test_a_few_quiet_moments_are_no_accident_only_from_three_on",
    )
    others: int = _rule(
        3,
        "joints of a machine that move as far, at least, by which it is told what noise is usual",
        "the median of three is not moved by one that is off, that of two is",
        "test_what_noise_is_usual_is_told_by_several_joints",
    )
    zero: float = _rule(
        2.0,
        "counts by which the zeros of two encoders, or of a taxel, may differ: a taxel that never changes is stuck "
        "beyond it, and dead where it is pressed and its neighbours feel twice as much",
        "zeros are set to a count or two",
        "test_sensors_have_zeros",
    )
    effort_zero: float = _rule(
        0.01,
        "of the torque limit: what a reading of the effort may be off by at rest",
        "in concealed cases an offset of 2.8 % of the limit is named, 0.3 and 0.8 % are within what any drive has",
        "test_sensors_have_zeros",
    )
    prior: float = _rule(
        30.0,
        "samples that one belief weighs, at one standard deviation",
        "neighbouring residuals are not independent; halved, sizes or intervals of the learning case friction "
        "change; doubled, sizes or intervals of the learning case friction change; the learning case empty answers "
        "the same from 15 to 60",
        "test_a_belief_weighs_some_samples",
    )
    trace: float = _rule(
        0.02,
        "sigmas of the residuals that a belief must move over its range to be refitted at all",
        "in 2500 samples, half a minute of most recordings, a belief then changes the sum of squares by 1 over its "
        "whole range: by less than it takes to know it to one standard deviation",
        "test_a_belief_without_a_trace_is_not_refitted",
    )


@dataclass(frozen=True)
class SignalRules:
    """By what a signal is told that is not what it says, and an end of a joint's motion that the model does not
    have."""

    told: float = _rule(
        0.9,
        "confidence that a signal is not what it says, where the recording shows it",
        "surer than any fit, since the recording itself shows it; below certainty, for its clock or its units may be "
        "stated wrong",
        "test_a_wrong_signal_is_told_surely",
    )
    stopped: float = _rule(
        0.7,
        "confidence that an encoder is dead where a position stops for good",
        "more than a hint, and not sure: a jam and a drive that is off look the same",
        "test_a_wrong_signal_is_told_surely",
    )
    far: float = _rule(
        3.0,
        "x a joint's range (and more than a turn) beyond which a position or a target is not that joint's",
        "above 1, a zero that was set at the other end; degrees for radians are 57 times as far",
        "test_a_position_far_outside_its_range_is_not_that_joints",
    )
    late: float = _rule(
        0.75,
        "of a recording: a position that stands still from later on has not stopped for good",
        "the customary quarter, as of a recording's end that is held out",
        "test_a_position_stops_for_good_early_and_after_moving",
    )
    stirred: float = _rule(
        1e-3,
        "rad or m that a position has moved before it stopped for good: less is an encoder's count",
        "below a count of an encoder of 12 bits, 1.5 mrad",
        "test_a_position_stops_for_good_early_and_after_moving",
    )
    further: float = _rule(
        0.3,
        "of the way that a joint and its target went before: by more its target goes on where its position has stopped",
        "a third: less may be the end of one motion",
        "test_a_position_stops_for_good_early_and_after_moving",
    )
    leads: float = _rule(
        0.6,
        "correlation of the speeds of a joint and its target from which they are one motion at some shift in time",
        "1 of a joint that follows; two motions of other frequencies stay below a half",
        "test_a_lead_is_told_by_a_clear_correlation",
    )
    beyond: float = _rule(
        0.15,
        "more of it than at any shift at which the target comes first: only then does the joint lead",
        "a periodic motion fits at many shifts nearly as well",
        "test_a_lead_is_told_by_a_clear_correlation",
    )
    against: float = _rule(
        0.7,
        "correlation of a position with the negative of its target from which its direction is another",
        "1 without delay and friction; motions that lag by a third of a period have -0.5",
        "test_a_joint_that_follows_the_negative_of_its_target_is_named",
    )
    follows: float = _rule(
        0.2,
        "of the way of its target, at least, that a position must go for its direction to be told",
        "noise and what a joint is moved by others are a few percent of its own motion",
        "test_a_joint_that_hardly_moves_has_no_direction",
    )
    early: float = _rule(
        0.015,
        "s by which a joint that moves before its target is on another clock",
        "above the period of 10 ms of most recordings, in which a reading may seem early",
        "test_a_joint_that_moves_before_its_target_is_on_another_clock",
    )
    blind: float = _rule(
        0.5,
        "s without a reading, or with an old one, over which the motion is not known",
        "the smoothing of a motion spans a tenth of that, and a finger may go to and fro in it",
        "test_over_a_long_pause_the_motion_is_not_known",
    )
    still: float = _rule(
        0.1,
        "rad (m) that the target of a joint that never moves must span for its encoder to be dead",
        "dry friction holds small hand joints against errors of some hundredths of a radian",
        "test_a_joint_that_never_moves_must_have_been_asked_to",
    )
    holds: float = _rule(
        1.5,
        "x the error at which dry friction has held the joint before: what it does not hold",
        "breakaway friction scatters by some tens of percent from rest to rest",
        "test_dry_friction_may_hold_a_joint_as_it_has_before",
    )
    rest: float = _rule(
        0.05,
        "s of equal readings that are a rest",
        "above a period of the slowest encoders, of 30 Hz",
        "test_a_rest_lasts_a_while",
    )
    held: float = _rule(
        0.06,
        "s: readings that stay the same for as long while a joint moves, and then jump, are old ones",
        "as `rest`, and a period of 10 ms more",
        "test_readings_that_stand_while_a_joint_moves_are_old_ones",
    )
    jump: float = _rule(
        2.5,
        "x the step of nine in ten moving samples: a jump after readings that stood",
        "a reading that is sent twice makes a step of 2",
        "test_readings_that_stand_while_a_joint_moves_are_old_ones",
    )
    moving: float = _rule(
        0.1,
        "of that step, at least, before readings froze: the joint was moving",
        "a joint that comes to rest, or starts from it, goes through slower steps than a tenth in a sample or two",
        "test_readings_that_stand_while_a_joint_moves_are_old_ones",
    )
    long: float = _rule(
        0.1,
        "s: equal readings for as long are looked at beside what the joint does elsewhere",
        "twice a rest",
        "test_a_frozen_encoder_is_told_by_what_the_joint_does_elsewhere",
    )
    pulse: float = _rule(
        2.0,
        "x the largest jump elsewhere in the recordings of the joint: one that ends frozen readings",
        "noise, quantum and stick-slip make jumps of one size, an encoder that catches up one of another",
        "test_a_frozen_encoder_is_told_by_what_the_joint_does_elsewhere",
    )
    passed: float = _rule(
        2.0,
        "x the way that the target has gone in any other rest of the joint",
        "friction that held a joint so far may hold it a little further",
        "test_a_frozen_encoder_is_told_by_what_the_joint_does_elsewhere",
    )
    way: float = _rule(
        0.1,
        "of all the way of the target, at least, that it goes while readings are frozen",
        "what moves less changes no fit",
        "test_a_frozen_encoder_is_told_by_what_the_joint_does_elsewhere",
    )
    often: float = _rule(
        0.02,
        "of a recording's samples that repeat the one before while the joint moves: it is said from there on",
        "at 100 Hz two a second, which the smoothing of a motion bears",
        "test_a_few_repeated_samples_say_nothing",
    )
    few: int = _rule(
        8,
        "repeated samples, at least",
        "a short recording of half a second at 100 Hz has one in fifty by accident",
        "test_a_few_repeated_samples_say_nothing",
    )
    leap: float = _rule(
        3.0,
        "smallest steps of an encoder: a reading that stood and changes by as many at once has been read anew",
        "between 2, of a count that jitters, and the tens of a joint that moves at its usual speed",
        "test_an_encoder_that_is_read_seldom_leaps_in_a_rhythm",
    )
    leaps: float = _rule(
        0.25,
        "of all changes that must be leaps",
        "a motion to and fro is slow, and leaps by less, for up to half of the time",
        "test_an_encoder_that_is_read_seldom_leaps_in_a_rhythm",
    )
    seldom: float = _rule(
        4.0,
        "samples, at least, from one new reading to the next",
        "every second or third sample is what a bus does that is a little slower than its log",
        "test_an_encoder_that_is_read_seldom_leaps_in_a_rhythm",
    )
    between: float = _rule(
        0.1,
        "of all changes that may come early in the rhythm, before the next reading is due",
        "a log whose clock jitters puts one in twenty a sample early",
        "test_an_encoder_that_is_read_seldom_leaps_in_a_rhythm",
    )
    rhythm: float = _rule(
        0.85,
        "mean length of the turns of new readings round their period: 1 all in step, 0 none",
        "readings within a twelfth of the period have 0.87, those of a joint that sticks and slips below a half",
        "test_an_encoder_that_is_read_seldom_leaps_in_a_rhythm",
    )
    anew: int = _rule(
        10,
        "new readings that make a rhythm",
        "of ten turns at random the mean is longer than `rhythm` less than once in a thousand times",
        "test_an_encoder_that_is_read_seldom_leaps_in_a_rhythm",
    )
    near: float = _rule(
        0.012,
        "of a joint's whole motion: as near to its outermost position as a stop lets it; an error of three times as "
        "much",
        "the give of a stop and of the links is some thousandths of a motion",
        "test_an_end_is_met_hard_long_and_again",
    )
    pressed: float = _rule(
        5.0,
        "x the usual error at rest: what no friction would hold",
        "as a push (`torque.far`)",
        "test_an_end_is_met_hard_long_and_again",
    )
    hard: float = _rule(
        5.0,
        "x gravity, at least, of the torque asked for at an end: what no load would hold",
        "a hand's finger with an object weighs up to three times as much as without",
        "test_an_end_bears_more_than_a_load",
    )
    meeting: float = _rule(
        0.1,
        "s: the shortest meeting of an end",
        "as `long`",
        "test_an_end_is_met_hard_long_and_again",
    )
    times: int = _rule(
        2,
        "separate times that a joint must meet an end",
        "a jam is met once",
        "test_an_end_is_met_hard_long_and_again",
    )


@dataclass(frozen=True)
class Rules:
    """All of them."""

    search: SearchRules = SearchRules()
    judge: JudgeRules = JudgeRules()
    touch: TouchRules = TouchRules()
    torque: TorqueRules = TorqueRules()
    belief: BeliefRules = BeliefRules()
    signal: SignalRules = SignalRules()


RULES = Rules()
SEARCH, JUDGE, TOUCH, TORQUE, BELIEF = RULES.search, RULES.judge, RULES.touch, RULES.torque, RULES.belief
SIGNAL = RULES.signal


# x something: what is left of 1 is what decides
RATIOS = ("search.enough", "search.unsettled")


def moved(name: str, factor: float) -> float:
    """A rule ("search.least") times `factor`; of one that is x something the logarithm is, so that it stays above 1."""
    room, _, rule = name.partition(".")
    value = getattr(getattr(RULES, room), rule)
    return type(value)(value**factor if name in RATIOS else value * factor)


def described() -> list[tuple[str, float, str, str, str]]:
    """(name such as "search.least", value, meaning, source, test) of every rule."""
    return [
        (f"{room.name}.{f.name}", getattr(rules, f.name), *(f.metadata[k] for k in ("means", "source", "test")))
        for room in fields(RULES)
        for rules in (getattr(RULES, room.name),)
        for f in fields(rules)
    ]
