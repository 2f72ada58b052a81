"""Hypotheses of one joint: its windows, what is refitted with each, and fits of effects together."""

from __future__ import annotations

from collections.abc import Callable, Set
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import SimpleNamespace

import numpy as np

from dexsim.gap.compute import Deadline
from dexsim.gap.effects import Effect, Variant
from dexsim.gap.effects.catalogue import CATALOGUE, compatible
from dexsim.gap.effects.friction import give
from dexsim.gap.plant.batch import Windows
from dexsim.gap.plant.case import PHYSICAL, Case
from dexsim.gap.plant.columns import INDEX, Param, Scales
from dexsim.gap.read import BLOCK
from dexsim.gap.rules import BELIEF, SEARCH
from dexsim.gap.search.fit import Box, Fitted, Fitter, Residuals, disbelief, slopes_of

# -- a hypothesis -----------------------------------------------------------------------------------------------------

@dataclass(frozen=True)
class Member:
    """One effect in a hypothesis: the effect, its variant."""

    effect: Effect
    variant: Variant

    @property
    def id(self) -> str:
        return self.effect.id


@dataclass
class Trial:
    """A hypothesis that was fitted: its members, the fit on all training windows, losses on left-out blocks [B]."""

    members: tuple[Member, ...]
    fit: Fitted
    left_out: np.ndarray | None = None
    folds: list[np.ndarray] = field(default_factory=list)

    @property
    def ids(self) -> tuple[str, ...]:
        return tuple(m.id for m in self.members)

    @property
    def fixed(self) -> tuple[tuple[str, float], ...]:
        """Constants that its effects set on the plant."""
        return tuple(f for m in self.members for f in m.variant.fixed)

    @property
    def values(self) -> list[np.ndarray]:
        """Fitted values of each member's parameters."""
        ends = np.cumsum([0, *(len(m.variant.params) for m in self.members)])
        return [self.fit.x[a:b] for a, b in zip(ends[:-1], ends[1:], strict=True)]

    def but(self, *gone: int) -> tuple[tuple[Member, ...], np.ndarray]:
        """Return the members without those of these numbers, and the fitted values of their parameters."""
        stay = [k for k in range(len(self.members)) if k not in gone]
        values = self.values
        return tuple(self.members[k] for k in stay), np.concatenate([np.zeros(0), *(values[k] for k in stay)])


@dataclass
class Outcome:
    """What the search of one joint ends with."""

    joint: str
    none: Trial
    best: Trial
    rivals: dict[str, list[tuple[str, float]]]  # by effect: what else would do, with its share of bootstraps
    confidence: dict[str, float]
    scanned: list[tuple[str, float, float]]  # (effect, share of squared error in the scan, its price)


def named(member: Member) -> list[Param]:
    """Return the member's parameters with keys unique in a hypothesis."""
    return [replace(p, key=f"{member.id}.{p.key}") for p in member.variant.params]


def complexity_price(trial: Trial) -> float:
    """Return factor on the losses of a hypothesis that can imitate simpler ones."""
    return float(np.prod([1 + m.variant.complexity_price for m in trial.members]))


def fits_beside(a: Member, b: Member) -> bool:
    return compatible(a.effect, a.variant, b.effect, b.variant)


# -- what is refitted with every hypothesis ---------------------------------------------------------------------------
# believed figures within their tolerance, stated ranges, what nobody knows

# figures of a drive, by column of the servo table: what is believed of them, no effect, is refitted; in this order
USUAL = (
    "kp", "kd", "torque_limit", "no_load_speed", "efficiency", "coulomb_friction", "viscous_friction", "load_friction",
    "load_friction_backdriven", "lag", "delay", "stribeck_peak", "stribeck_speed", "friction_asymmetry", "deadband",
    "position_offset", "position_scale", "speed_lag", "backlash", "softness", "profile_speed", "profile_acceleration",
)  # fmt: skip
MEASURED = (
    "kp", "kd", "torque_limit", "no_load_speed", "coulomb_friction", "viscous_friction", "load_friction",
    "load_friction_backdriven", "stribeck_peak", "profile_speed", "profile_acceleration",
)  # fmt: skip
"""Columns whose believed figures are off by a few percent; those of others are what they are."""


def unknown(name: str, s: Scales) -> tuple[Param, list[float]] | None:
    """Return how a servo column that is said to be unknown is fitted with every hypothesis, as the effect that writes
    it would be, and from where. None where no effect does, or where the column says nothing without others
    (`Effect.whole`): it is taken as absent, and the effect looked for."""
    for effect in (e for e in CATALOGUE if not e.whole):
        for v in effect.variants(s):
            for i, p in enumerate(v.params):
                if p.columns == (name,):
                    starts = list(dict.fromkeys(x[i] for x in v.starts))
                    return Param(
                        name, p.columns, p.mode, p.low, p.high, starts[min(1, len(starts) - 1)], p.unit, nuisance=True
                    ), starts
    return None


def refitted(case: Case) -> list[Param]:
    """Return what is refitted with every hypothesis: believed figures within `BELIEF.tolerance`, stated ranges,
    unknowns."""
    out = _figures(case)
    taken = {p.columns[0] for p in out}
    return [*out, *_timing(case, taken), *_of_the_drive(case, taken), *_of_the_body(case), *_of_the_sensors(case)]


def _within(key: str, *columns: str) -> Param:
    """Return a factor on what is believed, within its tolerance."""
    off = BELIEF.tolerance
    return Param(key, columns, "factor", 1 - off, 1 + off, 1.0, nuisance=True, sd=0.5 * off)


def _figures(case: Case) -> list[Param]:
    """Return the drive's figures that are believed, stated as a range or unknown."""
    out, s = [], case.scales
    for name in (*USUAL, *(n for n in case.unknown if n not in USUAL)):
        value = s.nominal[name]
        if name in case.unknown:
            guess = unknown(name, s)
            if guess is not None:
                out.append(guess[0])
        elif name in case.ranges:
            low, high = case.ranges[name]
            if name in ("kp", "kd") or (value > 0 and name in ("torque_limit", "no_load_speed")):
                columns = s.damping if name == "kd" else (name,)
                out.append(Param(name, columns, "factor", low / value, high / value, 1.0, nuisance=True))
            else:
                out.append(Param(name, (name,), "set", low, high, value, nuisance=True))
        elif name in MEASURED and 0 < value < 1e8:
            out.append(_within(name, *(s.damping if name == "kd" else (name,))))
    return out


def _timing(case: Case, taken: Set[str]) -> list[Param]:
    """Return when a drive acts and reads. taken: columns that are refitted already.

    A command waits for the loop's next period, half of one on average, and a clock is read when it is read; more is an
    effect, which training is given. Of a loop that nothing is known of, it may be twice as much."""
    known, rate = bool(case.loop_rate), case.loop_rate or 1000.0
    nominal, out = case.scales.nominal, []
    if "delay" not in taken:
        most = (BELIEF.late if known else 2 * BELIEF.late) / rate
        least, sd = -min(nominal["delay"], most), most / (3 if known else 2)
        out.append(Param("delay", ("delay",), "add", least, most, 0.0, "s", nuisance=True, sd=sd))
    if "lag" not in taken:
        sd = (0.25 if known else 0.5) / rate
        out.append(Param("lag", ("lag",), "add", 0.0, 1.0 / rate, 0.25 / rate, "s", nuisance=True, sd=sd))
    # a drive tells its speed from its encoder through some filter
    if nominal["kd"] > 0 and "speed_lag" not in taken:
        f, most = nominal["speed_lag"], max(BELIEF.filter, 2.0 / rate)
        low, start, sd = max(f - most, 0.0), f + 1.0 / rate, 0.3 * BELIEF.filter
        out.append(Param("speed_lag", ("speed_lag",), "set", low, f + most, start, "s", nuisance=True, sd=sd))
    # what it acts on was sampled up to a period ago, and acts until the next sample: half a period on average
    late, half = ("feedback_delay",), 0.5 / rate
    return [*out, Param("feedback_delay", late, "set", 0.0, 1.5 / rate, half, "s", nuisance=True, sd=half)]


def _of_the_drive(case: Case, taken: Set[str]) -> list[Param]:
    """Return what may be so or otherwise in any drive."""
    s = case.scales
    small = give(s)  # what holds a joint gives a little before it slides
    out = [Param("presliding", ("presliding",), "set", 0.0, small, 0.1 * small, nuisance=True)]
    if not s.voltage and s.nominal["no_load_speed"] < 1e8:
        if "braking_slope" not in taken and "braking_slope" not in case.stated:
            out.append(Param("braking_slope", ("braking_slope",), "set", -1.0, 1.0, PHYSICAL, nuisance=True))
        if s.nominal["kd"] > 0:  # a limit of the motor, or of a firmware that goes by its own reading
            out.append(Param("limit_speed", ("limit_speed",), "set", 0.0, 1.0, 0.5, nuisance=True))
    return out


def _of_the_body(case: Case) -> list[Param]:
    """Return what the model says of inertia, gravity and friction."""
    s, c = case.scales, case.constants
    low, high = case.factors.get("inertia", (1 - BELIEF.tolerance, 1 + BELIEF.tolerance))
    middle, sd = 0.5 * (low + high), 0.25 * (high - low)
    out = [Param("inertia", ("inertia_scale",), "factor", low, high, middle, nuisance=True, sd=sd)]
    if s.gravity > 0.01 * s.tau:
        out.append(_within("gravity", "gravity_scale"))
    for name in (f"tilt_{k}" for k, size in s.tilt.items() if size > 0.01 * s.tau):
        sd = BELIEF.tilt  # axes, centres of mass and the stand are off by as much
        out.append(Param(name, (name,), "add", -3 * sd, 3 * sd, 0.0, "rad", nuisance=True, sd=sd, late=True))
    if c.damping > 0:
        d = BELIEF.tolerance * c.damping
        out.append(Param("damping", ("viscous_friction",), "add", -d, d, 0.0, nuisance=True))
    if c.friction > 0 or c.damping > 0:
        # on which side of a play a model's friction acts it does not say; without a play it makes no difference
        out.append(Param("motor_share", ("motor_share",), "set", 0.0, 1.0, 0.5, nuisance=True))
    return out


def _of_the_sensors(case: Case) -> list[Param]:
    """Return what a second encoder and a reading of the effort show."""
    s, out = case.scales, []
    if s.apart:  # two encoders have two zeros, set to a count or two
        z = BELIEF.zero * max(case.quantum, case.sigma)
        out.append(Param("zero", ("readout_offset",), "add", -z, z, 0.0, nuisance=True, sd=0.5 * z))
    if case.sigma_torque > 0:
        o = s.effort_zero
        out.append(Param("effort_zero", ("effort_offset",), "add", -o, o, 0.0, nuisance=True, sd=0.5 * o))
        out.append(_within("effort_gain", "effort_gain"))
        # a drive may show what it last asked for, or what acts meanwhile
        out.append(Param("effort_fresh", ("effort_fresh",), "set", 0.0, 1.0, 0.5, nuisance=True))
    return out


SHORT, LONG = 1.0, 2.0  # s: windows of the scan and of the comparisons
SCAN_BUDGET, BUDGET = 30.0, 48.0  # s of a joint's recordings that the scan, and the comparisons, simulate
SHARE, MOST = 0.16, 2.0  # of recordings that are longer as much is simulated, up to so many times the budget
EXTREMES = (
    "saturation",
    "speed",
    "acceleration",
    "load",
    "position error",
)  # regime variables whose largest values are never thinned out
EXTREME, OF_RUN = 12, 3  # windows that are kept for their extremes, and of one recording
PROBE = 0.3  # of its range by which a belief is moved to see whether it leaves a trace
MAYBE = {"limit_speed": 0.0, "motor_share": 0.0}  # beliefs about a drive of which none is likelier: the simplest values


class JointSearch:
    """The recordings of one joint, fits to them, and what a search of its effects (`search.search_joint`) finds.
    train: run indices; span: part of each run to use; conditions [R]: of each run."""

    def __init__(
        self,
        case: Case,
        train: list[int],
        span: dict[int, tuple[float, float]] | None,
        conditions: list[int],
        seed: int = 0,
        allowed: set[str] | None = None,
        tell: Callable[[str], None] | None = None,
        deadline: Deadline | None = None,
    ):
        self.case, self.train, self.span = case, train, span
        self.seed, self.rng = seed, np.random.default_rng(seed)
        self.allowed = allowed
        self.deadline = deadline or Deadline()
        self.took = 0.0  # s that the search took
        self.unasked: set[str] = set()  # effects whose stand-ins the deadline left untried
        self.tell = tell or (lambda _: None)
        plant = self.whole = case.plant
        self.short = plant.windows(SHORT, train, span=span)
        self.long = plant.windows(LONG, train, span=span)
        self.short, self.long = thin(self.short, case, SCAN_BUDGET), thin(self.long, case, BUDGET)
        self.short_slopes: dict[str, np.ndarray] = {}
        sigma = case.sigma
        self.r = Residuals(
            sigma, case.sigma_torque, sigma_q0=0.7 * sigma, sigma_v0=max(sigma / 0.02, 0.02 * case.scales.speed)
        )
        self.scan_fitter = Fitter(plant, self.short, self.r, self.deadline.passed)
        self.fitter = Fitter(plant, self.long, self.r, self.deadline.passed)
        groups = sorted({conditions[r] for r in train})
        if len(groups) >= 3:
            self.fold_of = np.array([groups.index(conditions[r]) for r in self.long.run])
            if len(groups) > 4:
                self.fold_of %= 4
            self.fold_by = "conditions"
        else:
            count = len(self.long.window)
            self.fold_of = np.minimum(np.arange(count) * 3 // max(count, 1), 2)
            self.fold_by = "time"
        # by fold: runs to fit without it, and its own
        self.folded: list[tuple[list[int], list[int]]] = []
        if self.fold_by == "conditions":
            fold = {r: groups.index(conditions[r]) % (4 if len(groups) > 4 else len(groups)) for r in train}
            self.folded = [
                ([r for r in train if fold[r] != k], [r for r in train if fold[r] == k])
                for k in sorted(set(fold.values()))
            ]
        self.blocks = self._blocks(self.fitter, self.long)
        # what it finds as it goes: losses by block without any effect; the best fit by effects; the first of an
        # effect's laws, by effect and label; what a scan's guesses save in hindsight, and other starts; by effect
        # the hypothesis by every law that it may have
        self.none_loss = np.zeros(0)
        self.fitted: dict[frozenset[str], Trial] = {}
        self.first_laws: dict[tuple[str, str], Variant] = {}
        self.other_start: dict[str, np.ndarray] = {}
        self.by_law: dict[str, list[Trial]] = {}
        # made once: by the trial's id, which is kept so that it stays its own, its polished fit and errors of free runs
        self.polished: dict[int, tuple[Trial, Trial]] = {}
        self.run_free: dict[int, tuple[Trial, np.ndarray]] = {}
        self.plain: list[tuple[list[Param], np.ndarray] | None] = []
        self.all_nuisances = refitted(case)
        self.nuisances = self.all_nuisances
        believed = [
            p
            for p in self.all_nuisances
            if p.key not in case.unknown and p.key not in MAYBE and not (p.mode == "factor" and p.span > 0.3)
        ]
        self.wide = {c for p in self.all_nuisances if p not in believed for c in p.columns}

    @cached_property
    def fitted_whole(self) -> Windows:
        """What is fitted, whole recordings: made once, with what is known of them."""
        return self.case.plant.windows(None, self.train, span=self.span)

    def _blocks(self, fitter: Fitter, w: Windows) -> np.ndarray:
        """Return block of each residual [m]: half-second stretches of one window."""
        t = self.case.plant.t[w.sample_row]
        start = np.full(len(w.window), np.inf)
        np.minimum.at(start, w.sample_window, t)
        b = w.sample_window * 1000 + ((t - start[w.sample_window]) / BLOCK).astype(int)
        _, b = np.unique(b, return_inverse=True)
        return np.concatenate([b, b]) if fitter.use_torque else b

    def params_of(self, members: tuple[Member, ...]) -> list[Param]:
        """Return effects' parameters, then the nuisances that act on no column of theirs."""
        mine = [p for m in members for p in named(m)]
        taken = {c for p in mine for c in p.columns}
        # what left no trace without them may with them: a motor that rattles behind its joint turns faster than the
        # loop knows
        others = self.all_nuisances if any(m.effect.parts_motor for m in members) else self.nuisances
        return mine + [p for p in others if not taken & set(p.columns)]

    def start(self) -> Trial:
        """No effect: the nuisances alone. Those without a trace are left out from here on."""
        params = self.all_nuisances
        f = self.scan_fitter.fit(params, x0=self._begin(params), iterations=6, lazy=True)
        if self.scan_fitter.use_torque:  # neither signal drowns the other: what is missing shows in both
            n = self.scan_fitter.w.n
            parts = [float(np.sqrt(np.mean(x**2))) for x in (f.residual[:n], f.residual[n:][self.scan_fitter.tau_on])]
            self.r.sigma_q *= max(1.0, SEARCH.apart * parts[0])
            restless = restlessness(f.residual[n:], self.scan_fitter.w.sample_window)
            self.r.sigma_torque *= max(1.0, SEARCH.apart * parts[1], restless)
            f = self.scan_fitter.fit(f.params, x0=f.x, iterations=4, lazy=True)
        if params:
            trace = np.sqrt((f.jacobian**2).mean(0)) * Box(f.params).span
            without = [p for p, size in zip(f.params, trace, strict=True) if size <= BELIEF.trace]
            self.nuisances = [p for p in params if p not in without]
        known = dict(zip(f.params, f.x, strict=True))
        x = np.array([known.get(p, p.start) for p in self.nuisances])
        # large residuals are effects still to be named: the threshold follows them down
        self.r.huber = 3.0 * max(1.0, float(np.sqrt(np.median(f.residual**2))) / 0.67)
        fit = self.fitter.fit(self.nuisances, x0=x, iterations=8, lazy=True)
        return Trial((), self.fitter.toward_prior(fit.params, self._restarted(self.fitter, fit.params, fit)))

    def _begin(self, params: list[Param]) -> np.ndarray:
        """Return [P] starts; of what is unknown the size that follows best: of play or a dead zone no slope leads to
        the next."""
        x = np.array([p.start for p in params], float)
        for i, p in enumerate(params):
            found = unknown(p.key, self.case.scales) if p.key in self.case.unknown else None
            if (
                p.key == "braking_slope"
            ):  # kinked: the paper's line, full torque and the line that goes on are each tried
                found = (p, [PHYSICAL, 1.0, -1.0])
            if found is not None and len(found[1]) > 1:
                tries = np.repeat(x[None], len(found[1]), 0)
                tries[:, i] = np.clip(found[1], p.low, p.high)
                f = self.scan_fitter
                s = f.init_directions(params, x)[1] if f.eliminate else None
                x = tries[int(np.argmin(f.loss(f.eliminated(f.residuals(params, tries), s))))]
        return x

    def _restarted(self, fitter: Fitter, params: list[Param], fit: Fitted) -> Fitted:
        """Return the fit, looked for nearby too, where it does not follow the data yet."""
        return fitter.perturbed_restarts(params, fit, self.rng) if fit.loss > SEARCH.enough**2 else fit

    def simulate(self, fitter: Fitter, plants: np.ndarray, s: np.ndarray | None) -> np.ndarray:
        q, tau = self.case.plant.simulate(plants, fitter.w)
        return fitter.eliminated(fitter.compare(q, tau, plants), s)

    def draft(
        self,
        members: tuple[Member, ...],
        starts: np.ndarray,
        like: Trial | SimpleNamespace | None = None,
        hopeless: float = np.inf,
    ) -> tuple[tuple[Member, ...], np.ndarray, Fitted]:
        """Return (members, where it began, fit on short windows) of a hypothesis, from `starts` of the members'
        parameters. hopeless: as of `Fitter.fit`."""
        params = self.params_of(members)
        if like is not None:  # what left a trace in that alone starts from there too, not from what was believed
            taken = {c for p in params for c in p.columns}
            more = [p for p in like.fit.params if p in self.all_nuisances and not taken & set(p.columns)]
            params = params + more
        x0 = np.array([p.start for p in params], float)
        if like is not None:
            known = {p.key: v for p, v in zip(like.fit.params, like.fit.x, strict=True)}
            x0 = np.array([known.get(p.key, v) for p, v in zip(params, x0, strict=True)])
        x0[: len(starts)] = starts
        low, high = Box(params).low, Box(params).high
        n = sum(len(m.variant.params) for m in members)
        # an optimizer stalls at a bound: start inside it
        inside = np.clip(x0, low + 0.02 * (high - low), high - 0.02 * (high - low))
        free = np.array([p.mode == "add" for p in params[:n]], bool)
        x0[:n] = np.where(free, x0[:n], inside[:n])
        fitter = self.scan_fitter.given(members)
        fit = fitter.fit(
            params, x0=x0, iterations=5, tolerance=1e-2, slopes=self.short_slopes, lazy=True, exact=False,
            hopeless=hopeless,
        )  # fmt: skip
        return members, x0, fit

    def finish(
        self, members: tuple[Member, ...], x0: np.ndarray, short: Fitted, like: Trial | None = None, quick: bool = False
    ) -> Trial:
        """Return the draft refitted on long windows. quick: fewer steps, and beliefs are not drawn back to their
        prior."""
        added, at = self._newly_identifiable(members, short)
        params, slopes = [*short.params, *added], slopes_of(like.fit) if like is not None else None
        x0, x = np.concatenate([x0, at]), np.concatenate([short.x, at])
        fitter = self.fitter.given(members)
        a = fitter.fit(params, x0=x, iterations=4 if quick else 7, tolerance=5e-3, slopes=slopes, lazy=True)
        if like is not None and not quick and a.loss > like.fit.loss:
            b = fitter.fit(params, x0=x0, iterations=7, tolerance=5e-3, slopes=slopes, lazy=True)
            a = b if b.loss < a.loss else a
        return Trial(members, a)

    def _newly_identifiable(self, members: tuple[Member, ...], short: Fitted) -> tuple[list[Param], np.ndarray]:
        """Return beliefs that left no trace without any effect and leave one with these, and what is believed of them
        [n]: a drive that turns out to be slow may reach a limit that nothing was known of. Without them a hypothesis
        that imitates another by such a belief would be the only one that may."""
        taken = {c for p in short.params for c in p.columns}
        without_trace = [p for p in self.all_nuisances if not taken & set(p.columns)]
        if not without_trace:
            return [], np.zeros(0)
        base = self.case.plant.base()[0]
        at = np.array([{"factor": 1.0, "add": 0.0}.get(p.mode, base[INDEX[p.columns[0]]]) for p in without_trace])
        params, n = [*short.params, *without_trace], len(short.params)
        x = np.repeat(np.concatenate([short.x, at])[None], len(without_trace) + 1, 0)
        for i, p in enumerate(without_trace):
            x[i + 1, n + i] += PROBE * p.span * (1.0 if at[i] < 0.5 * (p.low + p.high) else -1.0)
        r = self.scan_fitter.given(members).residuals(params, x)
        trace = np.sqrt(np.mean((r[1:] - r[0]) ** 2, 1)) / PROBE
        awake = trace > BELIEF.trace
        return [p for p, on in zip(without_trace, awake, strict=True) if on], at[awake]

    def thorough(self, trial: Trial) -> Trial:
        """Return the trial fitted again from perturbed starts, and with its beliefs drawn back to their prior."""
        fitter, params = self.fitter.given(trial.members), trial.fit.params
        return Trial(trial.members, fitter.toward_prior(params, self._restarted(fitter, params, trial.fit)))

    def fit(
        self, members: tuple[Member, ...], starts: np.ndarray, like: Trial | None = None, quick: bool = False
    ) -> Trial:
        """Fit of a hypothesis: short windows first from `starts` (values of the members' parameters), then long
        ones."""
        self.tell(f"with {', '.join(m.id for m in members) or 'none'}")
        members, x0, short = self.draft(members, starts, like)
        return self.finish(members, x0, short, like, quick)

    def asked(self, effect: Effect) -> bool:
        """Return whether an effect is looked for."""
        return self.allowed is None or effect.id in self.allowed

    def shrunk(self, trial: Trial) -> bool:
        """Return whether an effect was fitted down to the size at which it begins: what it gained is another's."""
        return any(self.nothing_of(m, trial) for m in trial.members)

    def nothing_of(self, m: Member, trial: Trial) -> bool:
        """Return whether a member of a trial was fitted down to the size at which it begins."""
        at = dict(zip([p.key for p in trial.fit.params], trial.fit.x, strict=True))
        first = m.variant.params[0]
        # of a friction with load one direction may have none
        sizes = [p for p in m.variant.params if p.key.startswith(first.key)]
        others = [p for p in m.variant.params if p.key in m.effect.also_sizes]
        return (
            first.mode == "set"
            and first.start == first.low
            and all(at[f"{m.id}.{p.key}"] <= p.low + 1e-3 * p.span for p in sizes)
            and all(abs(at[f"{m.id}.{p.key}"] - p.start) <= 1e-3 * p.span for p in others)
        )

    def objective(self, trial: Trial) -> float:
        """Mean square where it was fitted, with what the beliefs give for it."""
        return trial.fit.loss + disbelief(trial.fit.params, trial.fit.x) / len(self.blocks)


def restlessness(r: np.ndarray, window: np.ndarray) -> float:
    """Return what of residuals [n] in windows [n] changes from sample to sample, as a standard deviation: by second
    differences, whose variance is six times that of white noise; the largest, of jumps, are cut. A loop's torque is as
    restless as the encoder that it reads."""
    inner = window[2:] == window[:-2]
    d = np.abs(r[2:] - 2 * r[1:-1] + r[:-2])[inner]
    if len(d) < 20:
        return 0.0
    return float(np.sqrt(np.mean(np.minimum(d, 4 * np.quantile(d, 0.75)) ** 2) / 6))


def thin(w: Windows, case: Case, budget: float) -> Windows:
    """At most `budget` seconds of windows, of long recordings `SHARE` up to `MOST` times that: more would say little
    more. Half of them, but no more than `EXTREME`, are those in which a regime variable is most extreme (a limit that
    is reached in one recording of ten must not be thinned out), at most `OF_RUN` of one recording (the fast end of one
    sweep would outweigh all else); the others are spread evenly."""
    count, seconds = len(w.window), float(w.window[:, 1].sum()) * case.plant.dt
    budget = min(max(budget, SHARE * seconds * budget / BUDGET), MOST * budget)
    if seconds <= budget:
        return w
    most = max(int(count * budget / seconds), 8)
    size = np.maximum(np.bincount(w.sample_window, minlength=count), 1)
    chosen: list[int] = []
    of_run = np.zeros(int(w.run.max()) + 1, int)
    orders = [
        np.argsort(-np.bincount(w.sample_window, np.abs(case.regimes[name][w.sample_row]), count) / size, kind="stable")
        for name in EXTREMES
        if name in case.regimes
    ]
    for k in range(count):
        for order in orders:
            run = w.run[order[k]]
            if len(chosen) < min(most // 2, EXTREME) and of_run[run] < OF_RUN and order[k] not in chosen:
                chosen.append(int(order[k]))
                of_run[run] += 1
    rest = np.setdiff1d(np.arange(count), chosen)
    keep = np.zeros(count, bool)
    keep[chosen] = True
    keep[rest[np.unique(np.linspace(0, len(rest) - 1, most - len(chosen)).astype(int))]] = True
    return subset(w, keep)


def subset(w: Windows, keep: np.ndarray) -> Windows:
    """Return the windows where keep [W] bool holds."""
    pick = np.flatnonzero(keep)
    new = np.full(len(w.window), -1)
    new[pick] = np.arange(len(pick))
    samples = keep[w.sample_window]
    window = w.window[pick].copy()
    if len(pick):
        window[:, 3] = np.concatenate([[0], np.cumsum(window[:-1, 4])])
    return Windows(
        window,
        w.window_t[pick],
        w.sample_step[samples],
        w.sample_part[samples],
        new[w.sample_window[samples]],
        w.sample_row[samples],
        w.run[pick],
    )
