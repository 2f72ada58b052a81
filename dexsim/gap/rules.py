"""Figures that decide, each with its meaning; where each value came from is in lab/results/figures.md.

Not here: figures that decide no name, confidence or verdict by themselves. These are sizes, bounds and starts of an
effect (in its class), figures of the numerics (steps, damping, filters, grids, draws of a bootstrap), and how much is
searched (windows, budgets, lengths of short lists).
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class SearchRules:
    """What the search of one joint decides by."""

    # share of the squared error on what was left out that an effect must remove, of joints, of torques and of touch; a
    # joint is searched again where what is known of the others changes its loss by as much
    least: float = 0.12
    # share of the bootstraps in which an effect, of joints, of torques or of touch, may be of no use to what was left
    # out
    chance: float = 0.03
    # chance that the scan's best effect is there by accident, at most; four times as much are still tried
    price: float = 0.05
    # relative: what a fitted effect is off by whatever the residuals say: a further one must remove more than this of
    # what the earlier ones did; of its room, a plain model's figure must differ by more from what is believed
    doubt: float = 0.015
    # relative, of its loss: what a hypothesis must do better that can imitate simpler ones, as an eccentricity whose
    # zero is anywhere imitates a zero error
    imitates: float = 0.08
    bounded: float = 1.5  # x its loss: what a hypothesis counts for whose size stopped at the end of what is physical
    enough: float = 1.08  # x the noise: an error within it needs no effect
    # x the noise: where a further effect leaves more, whole recordings run free may speak for it, too, and gravity's
    # direction is believed
    astray: float = 10.0
    # of the loss: nearer than this, fits without each condition decide; of the squared error on what was held out:
    # nearer than this it speaks neither for an effect nor against it
    tie: float = 0.02
    # relative, of a loss: finer than this nothing is to be trusted. A rival as much worse than the best counts for a
    # third of it in one draw, and laws of one effect that come within twice as much may each be the true one; a
    # parameter costs as much, and an effect must promise as much in the scan; of its misfit without any effect a signal
    # counts as much as noise, beside another
    apart: float = 0.03
    # x the noise squared: what leaves more has not been followed: every effect that helps is tried, whatever its price,
    # laws that training has less exactly too, and of several joints each again with what was found in the others
    unsettled: float = 1.7
    # share of what stand-ins leave beyond the noise, on what was left out, that a law which training has less exactly
    # may leave in their place
    approximate: float = 0.5
    most: int = 4  # effects on one joint or pad
    # x the loss, or the noise squared where less is left: a hypothesis that leaves more, as a draft on short windows or
    # where it was fitted, is no rival
    rival: float = 2.5
    lead: float = 0.1  # share of the bootstraps by which a rival must win more often to be taken in an effect's place
    # x `chance` for a first effect that removes from twice `least` on, twice that from four times on: few moments show
    # it, and draws vary
    rare: float = 2.5
    warmth: float = 2.0  # degC: a smaller change of temperature tells nothing of heat
    # x how much a joint shakes in its quietest stretch, and simulated without any effect: it shakes by itself
    loud: float = 3.0
    # windows of a second in which a joint must shake for that to tell of an effect; one of them held out where it is
    # judged
    shaking: int = 3
    # weight of the square by which the mean position is missed, in usual misses, beside squares of the logarithm by
    # which the shaking is
    resting: float = 1.0 / 9.0
    # of a joint's typical torque: what reaches it from the motion of others: from it on it matters how well that is
    # known, and joints are searched again with what was found in the others
    coupled: float = 0.03
    # share that an effect must remove of what is missed of how a joint rings to be named by it
    plainly: float = 0.24


@dataclass(frozen=True)
class JudgeRules:
    """What the verdict and the confidence of a name of the drives are decided by; touch has its own beside the
    verdict's."""

    # x the noise: an error within it asks for no effect, and is as good as any; beyond it it is said what it depends
    # on; two that differ by less are the same: of repeats, of two engines, of one regime and
    # the rest, of a taxel in its own place and in another's, of a gain for every taxel and one for all
    within: float = 1.3
    # x the noise floor: an error that large is not nothing, though only a few moments show it; a taxel that is pressed
    # by as much feels it, and two that are exchanged are missed by more
    far: float = 5.0
    # share of the gap between error and floor that names must remove to count as a part of the answer; of the squared
    # error, from which on what stays costs a name `left_costs` of its confidence
    removed: float = 0.3
    firm: float = 0.5  # confidence from which a name counts; below it is a hint
    hinted: float = 0.45  # confidence that a name keeps at most which the error on what was held out does not bear out
    doubted: float = 0.7  # confidence that a name keeps at most where one reason speaks against it
    sure_of_one: float = 0.75  # confidence of at least one name, or a set, without which nothing counts as explained
    # confidence from which a name stands alone: below it training is also given what was believed before
    sure: float = 0.8
    # share of the error held out that a name must cost when dropped to keep all of its confidence; that the engine may
    # leave beside what the plant leaves, in squares
    earns: float = 0.1
    # of the largest of an effect's sizes in fits without one condition each: the least must be as large
    repeated: float = 0.2
    # of the squared error before: a further effect that removes less may be what the first one's law gets wrong
    least_share: float = 0.04
    left_costs: float = 0.5  # share of its confidence that a name loses at most by what stays unexplained
    # standard deviation over mean of the load on the gear while a joint slides: less is one load, under which friction
    # that grows with it is not told from friction that does not
    one_load: float = 0.3
    # share of the squared error on what was held out that an effect removes at least that is more than a hint; of
    # several on a joint, one that surely removes less, and without which the error is lower, is taken back
    part: float = 0.2
    # share of the bootstraps that a rival of its class wins without which the name is no set; false-discovery rate of
    # what the rest is said to depend on (Benjamini and Hochberg 1995)
    level: float = 0.05
    # intervals grow by this, times the square of what is left over the noise, of what was fitted or held out
    stretch: float = 0.5
    stretch_least: float = 0.5  # the least factor on intervals
    stretch_most: float = 4.0  # the largest factor on intervals
    settled: float = 3.0  # x the noise: a motion on which two hypotheses differ by as much settles between them alone
    surest: float = 0.99  # the largest confidence of a name
    resolved: float = 0.5  # counts of the encoder: an effect that moves the joint by less is a hint
    ordered: float = 0.9  # correlation of ranks from which on a temperature is said to follow the clock
    acts: float = 0.25  # of its most: from there on an effect acts, where stretches of time are told
    kept_end: float = 0.25  # of the time of a recording, where its end is held out
    kept_most: float = 0.45  # of all time that may be held out
    # of its large speed: from there on a joint moves, where braking is told from rest, a recording begins in motion, or
    # a torque is fitted while its joint moves
    turning: float = 0.1
    # of a joint's large speed: from there on it slides, where friction acts, and has set itself in motion; slower it
    # stands
    slides: float = 0.02
    # of the largest speed, load or acceleration, of a position's way from its middle to each end, of a temperature's
    # span at each end: what is a regime of its own
    outer: float = 0.3
    visited: float = 0.25  # s in which a regime is visited
    moved: float = 0.002  # rad or m: a joint whose positions span less has not moved


@dataclass(frozen=True)
class TouchRules:
    """What the search of one pad and its judgement decide by."""

    enough: float = 1.2  # x the noise: an error within it needs no effect
    # of what keeps all confidence: an effect that earns no more on what was held out is not claimed
    earned: float = 0.2
    agree: int = 5  # taxels with one gain from which on those that hardly felt anything are taken to have it too
    short: float = 3.0  # s of touch on a pad, at least, before anything but constant taxels is looked for
    plant: float = 0.02  # of a reading: finer than that the plant is not to be trusted
    # of a size that hangs on how a force spreads over taxels, such as the gain of one: what that law may be off by; a
    # gain that is less off is not listed, one that is known less well speaks for no other
    law: float = 0.1
    timing: float = 3e-3  # s by which a reading's time is uncertain
    gain_prior: float = 0.3  # standard deviation of a taxel's gain, before anything is seen
    touched: float = 0.15  # N of a taxel, at least, while something is touched: a joint that moves then is not judged
    loaded: float = 0.3  # N of a load cell, at least, while something is touched, where no taxels are recorded
    neighbours: int = 3  # of a taxel that never changes: as many must feel the touch for it to be dead
    # share that may pass to the taxels beside because pressure spreads by another law than the plant's: neighbours of a
    # dead taxel that change by more feel the touch themselves
    spread: float = 0.15


@dataclass(frozen=True)
class TorqueRules:
    """What is decided by where a joint's motor torque, duty or current was logged: pushes from outside, what the torque
    route says, whether a drive does what is believed of it; and by the plain model beside every answer."""

    # share of the torque's variance that a fit leaves: from it on a plain one has something else that pushes, and
    # neither the fit of the quiet rest, nor friction that the torque tells, nor the believed law of a drive is believed
    much: float = 0.3
    far: float = 5.0  # x the quiet residual: a push
    slow: float = 0.25  # of the residual's variance between half seconds: less is noise and no force
    # of the time: what pushes longer is no stretch; a joint is judged without its pushes where the rest of the time is
    # left
    most: float = 0.6
    # confidence of what the torque itself shows, at most: of a push whose rest fits, of an effect that it names
    told: float = 0.9
    # share of a logged duty's variance that the believed law must give for a drive to be sound; what is no larger than
    # the rest of its torque is no push
    fit: float = 0.95
    # of the misfit: what halving the cutoff leaves at most, where what it sheds is noise of derivatives
    shed: float = 0.8
    shortest: float = 5.0  # s of motion from which on a logged torque is fitted, and at 100 Hz as many samples
    # x what its slow motion alone shakes: a joint that shakes by as much rings, and nobody pushes it
    shakes: float = 3.0
    # x the torque that drove a joint from rest: dry friction that is larger would have held it; and x its dry friction:
    # what a joint at rest may carry
    room: float = 1.1


@dataclass(frozen=True)
class BeliefRules:
    """What any machine may be off by: it is refitted with every hypothesis, and is no finding."""

    # relative: figures of a real machine are off from its data sheet by as much, and that is no finding; after a refit
    # by half as much, whatever the residuals say; gravity that is a smaller part of a torque, or that the torque tells
    # less well, is believed, and an error that is larger by less is as good
    tolerance: float = 0.05
    # rad, one standard deviation: gravity's direction at a joint is off by as much, as axes, centres of mass and the
    # stand are; refitted where that lowers the loss by `SearchRules.apart` for each axis
    tilt: float = 0.005
    # periods of its loop by which any drive may act on its commands late, or of its readings, where those tell it
    late: float = 0.75
    filter: float = 0.003  # s: a filter of the measured speed that any drive may have
    # rad by which what holds a joint gives before it slides; more is an effect, and a motion from rest
    gives: float = 0.002
    gives_slide: float = 5e-05  # m by which what holds a slide gives before it slides
    # x the noise where a joint moves as fast or faster: what it shakes by beyond it is motion, not noise
    rings: float = 5.0
    # x the usual noise of the other joints of a machine: a joint that scatters by more, and not as white noise or its
    # motor's torque by as much more again, rings all the time
    noisier: float = 2.5
    # by how much the autocorrelation of third differences differs from white noise's where a joint rings
    coloured: float = 0.19
    steady: float = 2.6  # kurtosis of second differences below which what scatters is a swing of steady size, not noise
    ringing: float = 0.1  # share of half seconds in which a joint must ring for its noise to be told by the others
    # half seconds that may be quieter by accident than what is usual where a joint moves as fast or faster
    quiet_parts: int = 2
    others: int = 3  # joints of a machine that move as far, at least, by which it is told what noise is usual
    # counts by which the zeros of two encoders, or of a taxel, may differ: a taxel that never changes is stuck beyond
    # it, and dead where it is pressed and its neighbours feel twice as much
    zero: float = 2.0
    effort_zero: float = 0.01  # of the torque limit: what a reading of the effort may be off by at rest
    prior: float = 30.0  # samples that one belief weighs, at one standard deviation
    trace: float = 0.02  # sigmas of the residuals that a belief must move over its range to be refitted at all


@dataclass(frozen=True)
class SignalRules:
    """By what a signal is told that is not what it says, and an end of a joint's motion that the model does not
    have."""

    told: float = 0.9  # confidence that a signal is not what it says, where the recording shows it
    stopped: float = 0.7  # confidence that an encoder is dead where a position stops for good
    far: float = 3.0  # x a joint's range (and more than a turn) beyond which a position or a target is not that joint's
    late: float = 0.75  # of a recording: a position that stands still from later on has not stopped for good
    stirred: float = 1e-3  # rad or m that a position has moved before it stopped for good: less is an encoder's count
    # of the way that a joint and its target went before: by more its target goes on where its position has stopped
    further: float = 0.3
    # correlation of the speeds of a joint and its target from which they are one motion at some shift in time
    leads: float = 0.6
    beyond: float = 0.15  # more of it than at any shift at which the target comes first: only then does the joint lead
    # correlation of a position with the negative of its target from which its direction is another
    against: float = 0.7
    follows: float = 0.2  # of the way of its target, at least, that a position must go for its direction to be told
    early: float = 0.015  # s by which a joint that moves before its target is on another clock
    blind: float = 0.5  # s without a reading, or with an old one, over which the motion is not known
    still: float = 0.1  # rad (m) that the target of a joint that never moves must span for its encoder to be dead
    holds: float = 1.5  # x the error at which dry friction has held the joint before: what it does not hold
    rest: float = 0.05  # s of equal readings that are a rest
    held: float = 0.06  # s: readings that stay the same for as long while a joint moves, and then jump, are old ones
    jump: float = 2.5  # x the step of nine in ten moving samples: a jump after readings that stood
    moving: float = 0.1  # of that step, at least, before readings froze: the joint was moving
    long: float = 0.1  # s: equal readings for as long are looked at beside what the joint does elsewhere
    pulse: float = 2.0  # x the largest jump elsewhere in the recordings of the joint: one that ends frozen readings
    passed: float = 2.0  # x the way that the target has gone in any other rest of the joint
    way: float = 0.1  # of all the way of the target, at least, that it goes while readings are frozen
    # of a recording's samples that repeat the one before while the joint moves: it is said from there on
    often: float = 0.02
    few: int = 8  # repeated samples, at least
    # smallest steps of an encoder: a reading that stood and changes by as many at once has been read anew
    leap: float = 3.0
    leaps: float = 0.25  # of all changes that must be leaps
    seldom: float = 2.5  # samples, at least, from one new reading to the next
    between: float = 0.1  # of all changes that may come early in the rhythm, before the next reading is due
    # mean length of the turns of new readings round their period: 1 all in step, 0 none; of that of readings which are
    # seen with the next sample of the log
    rhythm: float = 0.85
    anew: int = 10  # new readings that make a rhythm
    # of a joint's whole motion: as near to its outermost position as a stop lets it; an error of three times as much
    near: float = 0.012
    pressed: float = 5.0  # x the usual error at rest: what no friction would hold
    hard: float = 5.0  # x gravity, at least, of the torque asked for at an end: what no load would hold
    meeting: float = 0.1  # s: the shortest meeting of an end
    times: int = 2  # separate times that a joint must meet an end


SEARCH, JUDGE, TOUCH = SearchRules(), JudgeRules(), TouchRules()
TORQUE, BELIEF, SIGNAL = TorqueRules(), BeliefRules(), SignalRules()
