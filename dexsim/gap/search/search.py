"""Which effects a joint has: a priced scan of the catalogue, fits of the best, judged on conditions left out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from dexsim.gap.effects.catalogue import CATALOGUE, compatible, confusable
from dexsim.gap.effects.effect import Effect, Variant
from dexsim.gap.effects.presliding import give
from dexsim.gap.plant.batch import JointPlant, Windows
from dexsim.gap.plant.case import BELIEF, PHYSICAL, Case
from dexsim.gap.plant.columns import INDEX
from dexsim.gap.plant.param import Param, expand
from dexsim.gap.plant.scales import Scales
from dexsim.gap.search.time_limit import Deadline
from dexsim.gap.search.fit import AWAY, Fitted, Fitter, Residuals, disbelief, prior_weight, slopes_of

USUAL = ("kp", "kd", "torque_limit", "no_load_speed", "efficiency", "coulomb_friction", "viscous_friction", "load_friction",
         "load_friction_backdriven", "lag", "delay", "stribeck_peak", "stribeck_speed", "friction_asymmetry", "deadband",
         "position_offset", "position_scale", "speed_lag", "backlash", "softness")  # fmt: skip
WITH_OTHERS = ("torque_ripple", "ripple_per_turn", "ripple_phase", "deadband_kind", "coupling", "coupling_from", "warmth")
SHORT, LONG = 1.0, 2.0  # s: windows of the scan and of the comparisons
LEAST = 0.12  # an effect must remove this part of the squared error on conditions left out, or it is not claimed
CHANCE = 0.03  # of the bootstraps in which an effect may be of no use to what was left out
PRICE = 0.05  # chance that the scan's best effect is there by accident, at most
BOOTSTRAPS = 300
DOUBT, OFF = 0.015, 0.025  # relative: what a fitted effect, and a refitted belief, is off by whatever the residuals say
SCAN_BUDGET, BUDGET = 30.0, 48.0  # s of a joint's recordings that the scan, and the comparisons, simulate
BALANCE = 0.03  # of its misfit without any effect: the least a signal counts as noise where motion and effort are fitted
EXTREMES = ("saturation", "speed", "acceleration", "load", "position error")  # regime variables whose largest values are never thinned out
RESTLESS = 10.0  # x the noise of a resting torque: what changes from sample to sample counts as noise up to as much
SECOND = 0.02  # of what earlier effects removed: what a further one must remove
ENOUGH = 1.08  # x the noise: an error within it needs no effect
HINT = 0.03  # of the squared error with what the beliefs give for it: an effect that the scan sees to save as much is tried, whatever its price
ROUGH = 3.0  # x the noise squared: above it every effect that helps is tried, whatever its price
CLOSELY = 2  # hypotheses of a level that are looked for nearby and with their beliefs back home
AGAIN = 2  # hypotheses from which the fit without any effect is begun again before one is claimed
TIE = 0.02  # of the loss: nearer than this the one that lasts better on what was left out is taken without a closer look
ALIKE = 0.06  # of the loss on what was left out: laws of one effect that come within as much may each be the true one
CLEAR = 0.11  # of the squared error: what an effect must remove where the error is within the noise without it
SWEEPS = 60  # over the beliefs, by which the scan moves them
MOST = 4  # effects on one joint
FINER = 2  # steps of whole recordings, where an effect was found, in one of the windows'
MAYBE = {"limit_speed": 0.0}  # beliefs about a drive near its limits that the simulator that trains has at these values
PIN = 1e-6  # of room for what is held at a value
LATE = 0.75  # periods of its loop by which any drive may act on its commands late
FILTER = 3e-3  # s: a filter of the measured speed that any drive may have


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
    refitted: bool = False  # whether `left_out` is of fits of their own without each condition

    @property
    def ids(self) -> tuple[str, ...]:
        return tuple(m.id for m in self.members)


@dataclass
class Outcome:
    """What the search of one joint ends with."""

    joint: str
    none: Trial
    best: Trial
    rivals: dict[str, list[tuple[str, float]]]  # by effect: what else would do, with its share of bootstraps
    confidence: dict[str, float]
    gains: dict[str, float]  # by effect: share of the squared left-out error that it removes
    price: dict[str, float]
    scanned: list[tuple[str, float, float]]  # (effect, share of squared error in the scan, its price)
    folds: dict[str, list[float]] = field(default_factory=dict)  # by effect: relative cost of dropping it, by condition left out
    note: str = ""


def unknown(name: str, s: Scales) -> tuple[Param, list[float]] | None:
    """How a servo column that is said to be unknown is fitted with every hypothesis, as the effect that writes it would be, and from where.
    None where no effect does, or where the column says nothing without others (`WITH_OTHERS`): it is taken as absent, and the effect
    looked for."""
    if name in WITH_OTHERS:
        return None
    for effect in CATALOGUE:
        for v in effect.variants(s):
            for i, p in enumerate(v.params):
                if p.columns == (name,):
                    starts = list(dict.fromkeys(x[i] for x in v.starts))
                    return Param(name, p.columns, p.mode, p.low, p.high, starts[min(1, len(starts) - 1)], p.unit, nuisance=True), starts
    return None


class JointSearch:
    """The search on one joint. train: run indices; span: part of each run to use; folds [R]: condition of each run."""

    def __init__(self, case: Case, train: list[int], span: dict[int, tuple[float, float]] | None, conditions: list[int],
                 seed: int = 0, allowed: set[str] | None = None, long: float = LONG, tell: Callable[[float], None] | None = None,
                 deadline: Deadline | None = None):
        self.case, self.train, self.span = case, train, span
        self.rng = np.random.default_rng(seed)
        self.allowed = allowed
        self.deadline = deadline or Deadline()
        self.unasked: set[str] = set()  # effects whose likenesses the deadline left untried
        self.tell, self._part = tell or (lambda _: None), 0.0
        plant = self.whole = case.plant
        self.short = plant.windows(SHORT, train, span=span)
        self.long = plant.windows(long, train, span=span)
        self.short, self.long = _thin(self.short, case, SCAN_BUDGET), _thin(self.long, case, BUDGET)
        self.short_slopes: dict[str, np.ndarray] = {}
        sigma = case.sigma
        self.r = Residuals(sigma, case.sigma_torque, sigma_q0=0.7 * sigma, sigma_v0=max(sigma / 0.02, 0.02 * case.scales.speed))
        self.scan_fitter = Fitter(plant, self.short, self.r)
        self.fitter = Fitter(plant, self.long, self.r)
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
        self.blocks = self._blocks(self.fitter, self.long)
        self.by_law: dict[str, list[Trial]] = {}  # by effect: the hypothesis by every law that the effect may have
        self._polished: dict[int, tuple[Trial, Trial]] = {}  # by the trial's id, which is kept so that it stays its own
        self.all_nuisances = self._nuisances()
        self.nuisances = self.all_nuisances
        believed = [p for p in self.all_nuisances if p.key not in case.unknown and p.key not in MAYBE and not (p.mode == "factor" and p.span > 0.3)]
        self.wide = {c for p in self.all_nuisances if p not in believed for c in p.columns}

    def _on(self, share: float) -> None:
        """Tells that about this share of the work that was left is done: how many effects there are to look for is not known before."""
        self._part += (1 - self._part) * share
        self.tell(self._part)

    # -- pieces ------------------------------------------------------------------------------------------------------------
    def _blocks(self, fitter: Fitter, w: Windows) -> np.ndarray:
        """Block of each residual [m]: half-second stretches of one window."""
        t = self.case.plant.t[w.sample_row]
        start = np.zeros(len(w.window))
        np.minimum.at(start := np.full(len(w.window), np.inf), w.sample_window, t)
        b = w.sample_window * 1000 + ((t - start[w.sample_window]) / 0.5).astype(int)
        _, b = np.unique(b, return_inverse=True)
        return np.concatenate([b, b]) if fitter.use_torque else b

    def _nuisances(self) -> list[Param]:
        """What is refitted with every hypothesis: believed figures inside +- 5 %, stated ranges, unknowns."""
        c, s = self.case, self.case.scales
        out = []
        for name in (*USUAL, *(n for n in c.unknown if n not in USUAL)):
            value = s.nominal[name]
            if name in c.unknown:
                guess = unknown(name, s)
                if guess is not None:
                    out.append(guess[0])
            elif name in c.ranges:
                low, high = c.ranges[name]
                if name in ("kp", "kd") or (value > 0 and name in ("torque_limit", "no_load_speed")):
                    out.append(Param(name, (name,), "factor", low / value, high / value, 1.0, nuisance=True))
                else:
                    out.append(Param(name, (name,), "set", low, high, value, nuisance=True))
            elif name in ("kp", "kd", "torque_limit", "no_load_speed", "coulomb_friction", "viscous_friction", "load_friction",
                          "load_friction_backdriven", "stribeck_peak") and 0 < value < 1e8:
                out.append(Param(name, (name,), "factor", 1 - BELIEF, 1 + BELIEF, 1.0, nuisance=True, sd=0.5 * BELIEF))
        rate = c.loop_rate or 1000.0
        taken = {p.columns[0] for p in out}
        # a command waits for the loop's next period, half of one on average, and a clock is read when it is read; more is an effect, which
        # training is given
        if "delay" not in taken:
            d, most = s.nominal["delay"], (LATE if c.loop_rate else 2 * LATE) / rate  # of a loop that nothing is known of, twice as much
            out.append(Param("delay", ("delay",), "add", -min(d, most), most, 0.0, "s", nuisance=True, sd=most / (3 if c.loop_rate else 2)))
        if "lag" not in taken:
            out.append(Param("lag", ("lag",), "add", 0.0, 1.0 / rate, 0.25 / rate, "s", nuisance=True, sd=(0.25 if c.loop_rate else 0.5) / rate))
        # a drive tells its speed from its encoder through some filter
        if s.nominal["kd"] > 0 and "speed_lag" not in taken:
            f, most = s.nominal["speed_lag"], max(FILTER, 2.0 / rate)
            out.append(Param("speed_lag", ("speed_lag",), "set", max(f - most, 0.0), f + most, f + 1.0 / rate, "s", nuisance=True, sd=0.3 * FILTER))
        # what it acts on was sampled up to a period ago, and acts until the next sample: half a period on average
        out.append(Param("feedback_delay", ("feedback_delay",), "set", 0.0, 1.5 / rate, 0.5 / rate, "s", nuisance=True, sd=0.5 / rate))
        # what holds a joint gives a little before it slides
        small = give(s)
        out.append(Param("presliding", ("presliding",), "set", 0.0, small, 0.1 * small, nuisance=True))
        if not s.voltage and s.nominal["no_load_speed"] < 1e8:
            if "braking_slope" not in taken and "braking_slope" not in c.stated:
                out.append(Param("braking_slope", ("braking_slope",), "set", -1.0, 1.0, PHYSICAL, nuisance=True))
            if s.nominal["kd"] > 0:  # a limit of the motor, or of a firmware that goes by its own reading
                out.append(Param("limit_speed", ("limit_speed",), "set", 0.0, 1.0, 0.5, nuisance=True))
        low, high = c.factors.get("inertia", (1 - BELIEF, 1 + BELIEF))
        out.append(Param("inertia", ("inertia_scale",), "factor", low, high, 0.5 * (low + high), nuisance=True, sd=0.25 * (high - low)))
        if s.gravity > 0.01 * s.tau:
            out.append(Param("gravity", ("gravity_scale",), "factor", 1 - BELIEF, 1 + BELIEF, 1.0, nuisance=True, sd=0.5 * BELIEF))
        if c.constants.damping > 0:
            d = BELIEF * c.constants.damping
            out.append(Param("damping", ("viscous_friction",), "add", -d, d, 0.0, nuisance=True))
        if c.sigma_torque > 0:
            out.append(Param("effort_gain", ("effort_gain",), "factor", 1 - BELIEF, 1 + BELIEF, 1.0, nuisance=True, sd=0.5 * BELIEF))
            # a drive may show what it last asked for, or what acts meanwhile
            out.append(Param("effort_fresh", ("effort_fresh",), "set", 0.0, 1.0, 0.5, nuisance=True))
        return out

    def _params(self, members: tuple[Member, ...]) -> list[Param]:
        """Effects' parameters, then the nuisances that act on no column of theirs."""
        mine = [p for m in members for p in _named(m)]
        taken = {c for p in mine for c in p.columns}
        # what left no trace without them may with them: a motor that rattles behind its joint turns faster than the loop knows
        others = self.all_nuisances if any(m.effect.parts_motor for m in members) else self.nuisances
        return mine + [p for p in others if not taken & set(p.columns)]

    def _fix(self, members: tuple[Member, ...], plant: JointPlant | None = None):
        """Constants of the variants, written to the plant's nominal for the time of a fit."""
        return _Fixed(plant or self.case.plant, [f for m in members for f in m.variant.fixed])

    # -- stages ------------------------------------------------------------------------------------------------------------
    def start(self) -> Trial:
        """No effect: the nuisances alone. Those without a trace are left out from here on."""
        params = self.all_nuisances
        f = self.scan_fitter.fit(params, x0=self._begin(params), iterations=6, lazy=True)
        if self.scan_fitter.use_torque:  # neither signal drowns the other: what is missing shows in both
            n = self.scan_fitter.w.n
            parts = [float(np.sqrt(np.mean(x**2))) for x in (f.residual[:n], f.residual[n:][self.scan_fitter.tau_on])]
            self.r.sigma_q *= max(1.0, BALANCE * parts[0])
            restless = _restless(f.residual[n:], self.scan_fitter.w.sample_window)
            self.r.sigma_torque *= max(1.0, BALANCE * parts[1], min(restless, RESTLESS))
            f = self.scan_fitter.fit(params, x0=f.x, iterations=4, lazy=True)
        if params:
            span = np.array([p.span for p in params])
            trace = np.sqrt((f.jacobian**2).mean(0)) * span
            self.nuisances = [p for p, size in zip(params, trace, strict=True) if size > 0.02]
        keep = [i for i, p in enumerate(params) if p in self.nuisances]
        x = f.x[keep]
        # large residuals are effects still to be named: the knee follows them down
        self.r.knee = 3.0 * max(1.0, float(np.sqrt(np.median(f.residual**2))) / 0.67)
        fit = self.fitter.fit(self.nuisances, x0=x, iterations=8, lazy=True)
        return Trial((), self.fitter.homeward(self.nuisances, self._shaken(self.nuisances, fit)))

    def _begin(self, params: list[Param]) -> np.ndarray:
        """[P] starts; of what is unknown the size that follows best: of play or a dead zone no slope leads to the next."""
        x = np.array([p.start for p in params], float)
        for i, p in enumerate(params):
            found = unknown(p.key, self.case.scales) if p.key in self.case.unknown else None
            if p.key == "braking_slope":  # kinked: the paper's line, full torque and the line that goes on are each tried
                found = (p, [PHYSICAL, 1.0, -1.0])
            if found is not None and len(found[1]) > 1:
                tries = np.repeat(x[None], len(found[1]), 0)
                tries[:, i] = np.clip(found[1], p.low, p.high)
                s = self.scan_fitter.init_directions(params, x)[1] if self.scan_fitter.eliminate else None
                x = tries[int(np.argmin(self.scan_fitter.loss(self.scan_fitter.eliminated(self.scan_fitter.residuals(params, tries), s))))]
        return x

    def _shaken(self, params: list[Param], fit: Fitted) -> Fitted:
        """The fit, looked for nearby too, where it does not follow the data yet."""
        return self.fitter.shake(params, fit, self.rng) if fit.loss > ENOUGH**2 else fit

    def scan(self, current: Trial) -> list[tuple[float, float, Member, np.ndarray]]:
        """Every effect against what `current` leaves: (share of squared error removed, price, member, start)."""
        case = self.case
        params = current.fit.params
        fitter = self.scan_fitter
        with self._fix(current.members):
            here = fitter.fit(params, x0=current.fit.x, iterations=0)
            self.short_slopes = slopes_of(here)
            x = current.fit.x
            raw, s = fitter.init_directions(params, x)
            r0 = fitter.eliminated(raw[None], s)[0] if fitter.eliminate else raw
        base = expand_one(case, params, x)
        taken = {m.id for m in current.members}
        guesses, owners = [], []
        for effect in CATALOGUE:
            if effect.id in taken or (self.allowed is not None and effect.id not in self.allowed):
                continue
            for variant in effect.variants(case.scales):
                variant = None if variant.refines else self._narrow(variant)
                if variant is None:
                    continue
                member = Member(effect, variant)
                for start in variant.starts:
                    g = base.copy()
                    for name, value in variant.fixed:
                        g[:, INDEX[name]] = value
                    for p, value in zip(variant.params, start, strict=True):
                        value = float(np.clip(value, p.low, p.high))
                        p.apply(g[None], np.array([value]), case.plant.base())
                    guesses.append(_legal(g))
                    owners.append((member, np.array(start)))
        rows, dots, squares, cross = [], [], [], []
        J = here.jacobian * np.array([p.span for p in params]) if params else np.zeros((len(r0), 0))
        k = self.r.knee
        weight = np.minimum(1.0, k / np.maximum(np.abs(r0), 1e-9)) if k > 0 else np.ones_like(r0)
        sw = np.sqrt(weight)
        Jw, rw = J * sw[:, None], r0 * sw
        all_J = Jw
        # nuisances absorb what they may: a prior of a quarter of their span
        low, high = np.array([p.low for p in params]), np.array([p.high for p in params])
        inside = (x > low + 0.02 * (high - low)) & (x < high - 0.02 * (high - low)) if params else np.zeros(0, bool)
        Jw = Jw[:, inside]  # one at its bound has nothing left to give
        gram = Jw.T @ Jw + 16.0 * float(np.mean(rw**2)) * np.eye(Jw.shape[1])
        project = lambda y: y - Jw @ np.linalg.solve(gram, Jw.T @ y) if Jw.shape[1] else y  # noqa: E731
        total = float(rw @ rw)
        clean = project(rw)
        block = fitter.window
        count = fitter.count
        flips = self.rng.choice([-1.0, 1.0], size=(BOOTSTRAPS, count))
        null = np.zeros(BOOTSTRAPS)
        size = max(1, int(2e7 // max(len(r0), 1)))
        for a in range(0, len(guesses), size):
            with self._fix(()):
                q = self._simulate(fitter, np.stack(guesses[a : a + size]), s)
            for i, res in enumerate(q):
                d = project((r0 - res) * sw)
                dd = float(d @ d)
                if not np.isfinite(dd) or dd < 1e-6 * total * 1e-3 + 1e-12:
                    continue
                part = np.bincount(block, d * clean, count)
                dot = float(part.sum())
                c = np.clip(dot / dd, 0.0, 2.0)
                gain = (2 * c * dot - c * c * dd) / total
                null = np.maximum(null, np.maximum(flips @ part, 0.0) ** 2 / dd / total)
                member, start = owners[a + i]
                rows.append((gain, member, start))
                raw_d = (r0 - res) * sw
                dots.append(float(raw_d @ rw))
                squares.append(float(raw_d @ raw_d))
                cross.append(all_J.T @ raw_d)
        self.saved = self._saved([(m, st) for _, m, st in rows], np.array(dots), np.array(squares), np.array(cross), all_J, rw, params, x)
        best: dict[tuple, tuple] = {}
        self.other_start: dict[str, np.ndarray] = {}
        for gain, member, start in sorted(rows, key=lambda r: -r[0]):
            key = (member.id, member.variant.label)
            if key not in best:
                best[key] = (gain, member, start)
            elif member.id not in self.other_start and best[key][1] is member:
                self.other_start[member.id] = start
        out = [(g, float(np.mean(null >= g)), m, st) for g, m, st in best.values()]
        return sorted(out, key=lambda o: -o[0])

    def _saved(self, owners, dots: np.ndarray, squares: np.ndarray, cross: np.ndarray, J: np.ndarray, r: np.ndarray, params: list[Param], x: np.ndarray):
        """What each guess of the scan would save where beliefs, moved out to follow the data, may go back: [(share of the squared error
        with what beliefs gave for it, member, start)] by member, the best first.

        owners [H]: (member, start); dots, squares [H]: of the residuals' change d by the guess with the residuals and itself; cross [H, P]:
        J' d. Least squares over the guess's size (0 to 2) and every belief inside its bounds, by coordinates."""
        if not owners:
            return []
        P = len(params)
        span = np.array([p.span for p in params])
        centre, believed = np.array([p.start for p in params], float), prior_weight(params) * span**2
        low, high = (np.array([p.low for p in params]) - x) / span, (np.array([p.high for p in params]) - x) / span
        off = (x - centre) / span
        A = J.T @ J + np.diag(believed + 1e-9 * max(float(r @ r), 1e-12))
        b = -(J.T @ r) - believed * off  # of the beliefs' moves z: A z = b + c * cross
        total = float(r @ r) + float(believed @ off**2)
        H = len(owners)
        z, c = np.zeros((H + 1, P)), np.zeros(H + 1)  # the last: without any guess
        d_r, d_d, d_J = np.r_[dots, 0.0], np.r_[squares, 1.0], np.vstack([cross, np.zeros((1, P))])
        for _ in range(SWEEPS):
            for i in range(P):
                push = b[i] + c * d_J[:, i] - z @ A[:, i] + A[i, i] * z[:, i]
                z[:, i] = np.clip(push / A[i, i], low[i], high[i])
            c[:-1] = np.clip((d_r + (z * d_J).sum(1)) / d_d, 0.0, 2.0)[:-1]
        left = total - 2 * c * d_r + c * c * d_d - 2 * c * (z * d_J).sum(1) - 2 * z @ b + np.einsum("hi,ij,hj->h", z, A, z)
        saved = (left[-1] - left[:-1]) / max(left[-1], 1e-30)
        best: dict[str, tuple] = {}
        for gain, (member, start) in sorted(zip(saved.tolist(), owners, strict=True), key=lambda o: -o[0]):
            best.setdefault(member.id, (gain, member, start))
        return sorted(best.values(), key=lambda o: -o[0])

    def _narrow(self, variant: Variant) -> Variant | None:
        """The variant without parameters that are fitted anyway, because nothing in particular is believed of them."""
        keep = [i for i, p in enumerate(variant.params) if not set(p.columns) & self.wide]
        if len(keep) == len(variant.params):
            return variant
        # without its size nothing is left of an effect, but for friction (its directions may differ) and gains (there are two)
        if not keep or (keep[0] > 0 and variant.params[0].key not in ("torque", "kp_factor")):
            return None
        starts = tuple(dict.fromkeys(tuple(s[i] for i in keep) for s in variant.starts))
        return replace(variant, params=tuple(variant.params[i] for i in keep), starts=starts)

    def _simulate(self, fitter: Fitter, plants: np.ndarray, s) -> np.ndarray:
        q, tau = self.case.plant.simulate(plants, fitter.w)
        return fitter.eliminated(fitter.compare(q, tau, plants), s)

    def draft(self, members: tuple[Member, ...], starts: np.ndarray, like: Trial | None = None):
        """(members, where it began, fit on short windows) of a hypothesis, from `starts` of the members' parameters."""
        params = self._params(members)
        x0 = np.array([p.start for p in params], float)
        if like is not None:
            known = {p.key: v for p, v in zip(like.fit.params, like.fit.x, strict=True)}
            x0 = np.array([known.get(p.key, v) for p, v in zip(params, x0, strict=True)])
        x0[: len(starts)] = starts
        low, high = np.array([p.low for p in params]), np.array([p.high for p in params])
        n = sum(len(m.variant.params) for m in members)
        # an optimizer stalls at a bound: start inside it
        inside = np.clip(x0, low + 0.02 * (high - low), high - 0.02 * (high - low))
        free = np.array([p.mode == "add" for p in params[:n]], bool)
        x0[:n] = np.where(free, x0[:n], inside[:n])
        with self._fix(members):
            return members, x0, self.scan_fitter.fit(params, x0=x0, iterations=5, tolerance=1e-2, slopes=self.short_slopes, exact=False)

    def finish(self, members: tuple[Member, ...], x0: np.ndarray, short: Fitted, like: Trial | None = None, quick: bool = False) -> Trial:
        """The draft refitted on long windows. quick: fewer steps, and beliefs are not asked back home."""
        params, slopes = short.params, slopes_of(like.fit) if like is not None else None
        with self._fix(members):
            a = self.fitter.fit(params, x0=short.x, iterations=4 if quick else 7, tolerance=5e-3, slopes=slopes, lazy=True)
            if like is not None and not quick and a.loss > like.fit.loss:
                b = self.fitter.fit(params, x0=x0, iterations=7, tolerance=5e-3, slopes=slopes, lazy=True)
                a = b if b.loss < a.loss else a
        return Trial(members, a)

    def thorough(self, trial: Trial) -> Trial:
        """The trial looked for nearby, and with its beliefs asked back home."""
        with self._fix(trial.members):
            return Trial(trial.members, self.fitter.homeward(trial.fit.params, self._shaken(trial.fit.params, trial.fit)))

    def fit(self, members: tuple[Member, ...], starts: np.ndarray, like: Trial | None = None, quick: bool = False) -> Trial:
        """Fit of a hypothesis: short windows first from `starts` (values of the members' parameters), then long ones."""
        return self.finish(*self.draft(members, starts, like), like, quick)

    def _score(self, trial: Trial) -> float:
        """Left-out loss with a price on parameters: 3 % each."""
        return float(self._left(trial).sum()) * (1 + 0.03 * sum(len(m.variant.params) for m in trial.members)) * _dear(trial)

    def _left(self, trial: Trial) -> np.ndarray:
        """Losses by block [B] on what was left out, and what the beliefs had to give for them, spread over the blocks."""
        out = self.cross(trial)
        return out + disbelief(trial.fit.params, trial.fit.x) / len(out)

    def cross(self, trial: Trial) -> np.ndarray:
        """Losses by block [B] when the block's condition is left out of the fit: from the optimum of all, one bounded
        Gauss-Newton step on the other conditions, its length chosen there."""
        if trial.left_out is not None:
            return trial.left_out
        f, fitter = trial.fit, self.fitter
        P = len(f.params)
        out = np.zeros(int(self.blocks.max()) + 1)
        low, high = np.array([p.low for p in f.params]), np.array([p.high for p in f.params])
        span = high - low
        folds = np.unique(self.fold_of)
        fold = self.fold_of[fitter.window]
        k = self.r.knee
        weight = np.minimum(1.0, k / np.maximum(np.abs(f.residual), 1e-12)) if k > 0 else np.ones(len(f.residual))
        guesses = [f.x]
        believed, centre = prior_weight(f.params), np.array([p.start for p in f.params], float)
        lengths = (0.35, 1.0)
        for number in folds:
            on = fold != number if len(folds) > 1 else fold == number
            if P == 0:
                continue
            J = f.jacobian[on] * span
            w = weight[on]
            A, b = (J * w[:, None]).T @ J, -(J * w[:, None]).T @ f.residual[on] - believed * (f.x - centre) * span
            A[np.diag_indices(P)] += believed * span**2
            free = ~(((f.x <= low + 1e-12) & (b < 0)) | ((f.x >= high - 1e-12) & (b > 0)))
            step = np.zeros(P)
            i = np.flatnonzero(free)
            if len(i):
                M = A[np.ix_(i, i)] + np.diag(1e-3 * np.diag(A)[i] + 1e-9 * np.trace(A) + 1e-12)
                step[i] = np.linalg.solve(M, b[i])
            step = np.clip(step, -0.3, 0.3)
            guesses += [np.clip(f.x + length * step * span, low, high) for length in lengths]
        with self._fix(trial.members):
            _, s = fitter.init_directions(f.params, f.x) if fitter.eliminate else (None, None)
            res = fitter.eliminated(fitter.residuals(f.params, np.array(guesses)), s)
        a = np.abs(res)
        a = np.where(a <= k, a * a, 2 * k * a - k * k) if k > 0 else a * a
        for n, number in enumerate(folds):
            test = fold == number
            on = ~test if len(folds) > 1 else test
            options = [0] if P == 0 else [0, *range(1 + n * len(lengths), 1 + (n + 1) * len(lengths))]
            best = min(options, key=lambda o: a[o][on].sum())
            trial.folds.append(np.array(guesses)[best])
            out += np.bincount(self.blocks[test], a[best][test], len(out))
        trial.left_out = out
        return out

    def refold(self, trial: Trial) -> Trial:
        """The trial with its losses on what was left out from fits of their own: where an effect is kinked (a limit, a sag, play),
        one step from the optimum of all lands anywhere."""
        f = trial.fit
        out = np.zeros(int(self.blocks.max()) + 1)
        folds, parts = np.unique(self.fold_of), []
        if len(folds) < 2 or not len(f.params):
            return trial
        with self._fix(trial.members):
            for number in folds:
                on = self.fold_of != number
                fitter = Fitter(self.case.plant, subset(self.long, on), self.r)
                rows = on[self.fitter.window]
                known = {key: v[rows] for key, v in slopes_of(f).items()}
                x = fitter.fit(f.params, x0=f.x, iterations=4, tolerance=1e-2, slopes=known, exact=False).x
                r = self.fitter.evaluate(f.params, x)
                a, k = np.abs(r), self.r.knee
                a = np.where(a <= k, a * a, 2 * k * a - k * k) if k > 0 else a * a
                test = ~on[self.fitter.window]
                out += np.bincount(self.blocks[test], a[test], len(out))
                parts.append(x)
        return replace(trial, left_out=out, folds=parts, refitted=True)

    # -- the search ------------------------------------------------------------------------------------------------------------
    def run(self, shortlist: int = 6) -> Outcome:
        """Adds effects while they earn it on left-out conditions, swaps and drops, and prices what is claimed."""
        self.fitted: dict[frozenset, Trial] = {}
        none = self.start()
        self.none_loss = self._left(none)
        self._on(0.1)
        current = none
        gains, price, scanned = {}, {}, []
        rivals: dict[str, list[tuple[str, float]]] = {}
        confidence: dict[str, float] = {}
        per = len(self.blocks)
        pool: dict[str, tuple[Member, np.ndarray]] = {}
        level: list[Trial] = []
        for _ in range(MOST):
            loss = self._left(current).sum() / per
            enough = loss < ENOUGH**2
            if (enough and current.members) or self.deadline.over():
                break
            scan = self.scan(current)
            self._on(0.06)
            if not scanned:
                scanned = [(m.id + (f" ({m.variant.label})" if m.variant.label else ""), g, p) for g, p, m, _ in scan]
            if not scan:
                break
            listed = self._shortlist(scan, shortlist, loss, current.members)
            if loss < ROUGH:
                listed = self._hinted([] if enough else listed, current.members, HINT)
            if not listed:
                break
            drafts = []
            for _, p, member, start in listed:
                if drafts and self.deadline.over():
                    break
                if member.id not in pool or price.get(member.id, 1.0) > p:
                    pool[member.id] = (member, start)
                price[member.id] = p
                begin = lambda x, current=current: np.concatenate([self._values(current), x])  # noqa: E731
                tries = [self.draft((*current.members, member), begin(start), current)]
                if len(drafts) < 4 and member.id in self.other_start and len(start) == len(self.other_start[member.id]):
                    tries.append(self.draft((*current.members, member), begin(self.other_start[member.id]), current))
                drafts.append(min(tries, key=lambda d: d[2].loss))
                self._on(0.03)
            drafts.sort(key=lambda d: d[2].loss)
            good = [d for k, d in enumerate(drafts) if k < 2 or (k < 6 and d[2].loss < 1.3 * drafts[0][2].loss + 0.15)]
            for _, p, member, start in scan:  # what a candidate is confused with is asked in its place, seen or not
                if member.id not in pool and any(confusable(member.id, row[2].id) for row in listed[:3]):
                    pool[member.id], price[member.id] = (member, start), p
            trials = sorted((self.finish(*d, current) for k, d in enumerate(good) if k == 0 or not self.deadline.over()), key=lambda t: t.fit.loss)
            least = trials[0].fit.loss
            # those that may still be the best are looked at closely
            trials = [self.thorough(t) if not self.deadline.over() and (k == 0 or (k < CLOSELY and t.fit.loss < 1.3 * least + 0.1)) else t for k, t in enumerate(trials)]
            for trial in trials:
                self._on(0.06)
                known = self.fitted.get(frozenset(trial.ids))
                if known is None or trial.fit.loss < known.fit.loss:
                    self.fitted[frozenset(trial.ids)] = trial
            for trial in trials:
                self.cross(trial)
            best, close = min(trials, key=self._score), min(trials, key=lambda t: t.fit.loss)
            if close.fit.loss < (1 - TIE) * best.fit.loss:  # what follows best seems to last less: fits of their own decide
                two = [self.refold(t) for t in (best, close)]
                for t in two:
                    self.fitted[frozenset(t.ids)] = t
                best = min(two, key=self._score)
            if not self._earns(best, current):  # a good fit that seems not to last: is it the fit's, or the step's from it?
                close = min(trials, key=lambda t: t.fit.loss)
                if close.fit.loss < (1 - LEAST) * current.fit.loss:
                    best = self.refold(close)
                    self.fitted[frozenset(best.ids)] = best
            less = self._begun_again(current, trials)
            if less is not current:
                if not current.members:
                    none, self.none_loss = less, self._left(less)
                    self.fitted.clear()
                else:
                    self.fitted[frozenset(less.ids)] = less
                current = less
                if not self._earns(best, current):  # the fit without it had stopped short: what is missing is looked for anew
                    continue
                self.fitted.update({frozenset(t.ids): t for t in (*trials, best)})
            if enough and self.gain(best, current) < CLEAR:
                break
            if not self._earns(best, current):
                # a pair may be there where neither of its halves is seen alone
                best = current if enough or self.deadline.over() else self._pair(current, listed[:3]) or current
                if best is current:
                    break
            current, level = best, trials
            if len(current.members) > 1 and not self.deadline.over():
                current, level = self._swap(current, pool, level)
        if not self.deadline.over():
            current = self._lawful(self._refine(self._drop(current)))
        self._on(0.1)
        final = self.rivals(current, pool)
        for _ in range(len(current.members)):  # one that only seemed worse before it was fitted in full takes the place
            better = self._overtaken(current, final)
            if better is None:
                break
            self.fitted[frozenset(current.ids)] = current
            current = self._drop(better) if len(better.members) > 1 else better  # what went with the other may not be needed with it
            final = self.rivals(current, pool)
        for m in current.members:
            rivals[m.id], confidence[m.id], gains[m.id] = final[m.id]
        return Outcome(self.case.joint, none, current, rivals, confidence, gains, price, scanned, self.costs)

    def _begun_again(self, current: Trial, trials: list[Trial]) -> Trial:
        """The hypothesis fitted again from where those with one effect more ended that follow better: what they refitted, and of that effect what
        is inside the bounds of a belief. The fit without it may have stopped in a hollow beside; `current` where it had not."""
        best, params = current, current.fit.params
        columns = [INDEX[p.columns[0]] for p in params]
        believed = self.case.plant.base()[0][columns]
        ahead = [t for t in trials if t.fit.loss < (1 - TIE) * current.fit.loss]
        for trial in sorted(ahead, key=lambda t: t.fit.loss)[:AGAIN]:
            own = {p.key: x for p, x in zip(trial.fit.params, trial.fit.x, strict=True) if not p.nuisance}
            at = expand_one(self.case, trial.fit.params, trial.fit.x)[0][columns]
            x0 = [own.get(p.key, p.start) if not p.nuisance else a / b if p.mode == "factor" else a - b if p.mode == "add" else a
                  for p, a, b in zip(params, at, believed, strict=True)]  # fmt: skip
            with self._fix(current.members):
                new = Trial(current.members, self.fitter.fit(params, x0=np.array(x0), iterations=8, slopes=slopes_of(current.fit)))
            if self._here(new) < (1 - 0.5 * TIE) * self._here(best):
                with self._fix(current.members):
                    new = Trial(current.members, self.fitter.homeward(params, new.fit))
            if self._here(new) < (1 - 0.5 * TIE) * self._here(best) and not self._shrunk(new):
                best = new
        return best

    def _shortlist(self, scan, size, loss, members):
        """The best variants of the best effects, and what the first is confused with."""
        seen: dict[str, int] = {}
        out = []
        for row in scan:
            g, p, m, _ = row
            if g < 0.25 * LEAST * min(1.0, ROUGH / loss) or (p > 4 * PRICE and loss < ROUGH):
                continue
            if seen.get(m.id, 0) >= m.effect.kinds:
                continue
            if any(not _compatible(m, other) for other in members):
                continue
            leader = out[0][2].id if out else None
            if len(out) < size or (leader and confusable(leader, m.id) and len(out) < size + 2):
                seen[m.id] = seen.get(m.id, 0) + 1
                out.append(row)
        return out

    def _hinted(self, listed, members, least: float):
        """The list, and up to four more that, by the scan, save at least `least` of the squared error with what the beliefs give for it: where
        those moved out to follow the data, what is left shows little, and the right effect lets them go back."""
        known = {row[2].id for row in listed}
        more = [row for row in self.saved if row[0] >= least and row[1].id not in known and all(_compatible(row[1], m) for m in members)]
        return listed + [(gain, 1.0, member, start) for gain, member, start in more[:4]]

    def _values(self, trial: Trial) -> np.ndarray:
        n = sum(len(m.variant.params) for m in trial.members)
        return trial.fit.x[:n]

    def _earns(self, new: Trial, old: Trial, further: bool = True) -> bool:
        a, b = self._left(old), self._left(new)
        gain = 1 - b.sum() / a.sum()
        # what was left out may be lost by the step to it alone: what is fitted must be followed better too
        if gain < LEAST or self._here(new) > (1 - 0.5 * LEAST) * self._here(old) or self._shrunk(new):
            return False
        if old.members and further:  # what follows must matter beside what was found
            rms = lambda x: np.sqrt(x.sum() / len(self.blocks))  # noqa: E731
            if rms(a) - rms(b) < SECOND * (rms(self.none_loss) - rms(a)):
                return False
        # what only a few moments show (a limit, a sag) varies much between draws, and more of the error goes with it
        chance = CHANCE if old.members or gain < 2 * LEAST else (2.5 if gain < 4 * LEAST else 5.0) * CHANCE
        return bool(np.quantile(self._boot(a - b), chance) > 0)

    def _shrunk(self, trial: Trial) -> bool:
        """Whether an effect was fitted down to the size at which it begins: what it gained is another's."""
        at = dict(zip([p.key for p in trial.fit.params], trial.fit.x, strict=True))
        for m in trial.members:
            first = m.variant.params[0]
            sizes = [p for p in m.variant.params if p.key.startswith(first.key)]  # of a friction with load one direction may have none
            if first.mode == "set" and first.start == first.low and all(at[f"{m.id}.{p.key}"] <= p.low + 1e-3 * p.span for p in sizes):
                return True
        return False

    def _boot(self, x: np.ndarray) -> np.ndarray:
        """Sums of a block bootstrap of x [B]: 2-s stretches of neighbouring half-second blocks."""
        n = len(x)
        size = min(4, n)
        starts = self.rng.integers(0, n, (BOOTSTRAPS, -(-n // size)))
        index = (starts[..., None] + np.arange(size)) % n
        return x[index.reshape(BOOTSTRAPS, -1)].sum(1)

    def _pair(self, current: Trial, listed) -> Trial | None:
        best = None
        for i, (_, _, m1, s1) in enumerate(listed):
            for _, _, m2, s2 in listed[i + 1 :]:
                if m1.id == m2.id or not _compatible(m1, m2):
                    continue
                trial = self.fit((*current.members, m1, m2), np.concatenate([self._values(current), s1, s2]), current, quick=True)
                if best is None or trial.fit.loss < best.fit.loss:
                    best = trial
        if best is not None and self._earns(best, current):
            return best
        return None

    def _swap(self, current: Trial, pool, level):
        """Each earlier member replaced by others of the pool, while the rest stays."""
        best = current
        for i, member in enumerate(current.members[:-1]):
            rest = [m for k, m in enumerate(current.members) if k != i]
            values = np.split(self._values(current), np.cumsum([len(m.variant.params) for m in current.members])[:-1])
            kept = [v for k, v in enumerate(values) if k != i]
            for key, (other, start) in list(pool.items()):
                if key in current.ids or not confusable(key, member.id) or any(not _compatible(other, m) for m in rest):
                    continue
                trial = self.fit((*rest, other), np.concatenate([*kept, start]), current, quick=True)
                if trial.fit.loss < best.fit.loss and self._left(trial).sum() < self._left(best).sum() and not self._shrunk(trial):
                    best = trial
        return best, level

    def _drop(self, current: Trial) -> Trial:
        """Members that no longer earn their place are let go."""
        changed = True
        while changed and len(current.members) > 1:
            changed = False
            for i in range(len(current.members)):
                rest = tuple(m for k, m in enumerate(current.members) if k != i)
                values = np.split(self._values(current), np.cumsum([len(m.variant.params) for m in current.members])[:-1])
                kept = np.concatenate([v for k, v in enumerate(values) if k != i])
                less = self.fit(rest, kept, current, quick=True)
                if not self._earns(current, less):
                    current, changed = less, True
                    break
        return current

    def _refine(self, current: Trial) -> Trial:
        """Members with more parameters (an elasticity that hardens), where those earn their place."""
        for i, member in enumerate(current.members):
            for variant in member.effect.variants(self.case.scales):
                variant = self._narrow(variant) if variant.refines else None
                if variant is None or {p.key for p in member.variant.params} - {p.key for p in variant.params}:
                    continue
                sizes = np.cumsum([len(m.variant.params) for m in current.members])[:-1]
                values = np.split(self._values(current), sizes)
                known = dict(zip([p.key for p in member.variant.params], values[i], strict=True))
                members = tuple(replace(m, variant=variant) if k == i else m for k, m in enumerate(current.members))
                extra = {tuple(v for p, v in zip(variant.params, start, strict=True) if p.key not in known): start for start in variant.starts}
                tries = []
                for start in extra.values():
                    values[i] = np.array([known.get(p.key, v) for p, v in zip(variant.params, start, strict=True)])
                    tries.append(self.draft(members, np.concatenate(values), current))
                more = self.finish(*min(tries, key=lambda d: d[2].loss), current, quick=True)
                if self._earns(more, current, further=False) and self._score(more) < self._score(current):
                    current = more
                    break
        return current

    def _lawful(self, current: Trial) -> Trial:
        """Each member by every law that its effect may have: the hypothesis by the one that lasts best, the fits by the others kept beside
        it, so that intervals hold what the law is not known to be."""
        for i, member in enumerate(current.members):
            tries = [current]
            for variant in member.variant.by_law():
                members = tuple(replace(m, variant=variant) if k == i else m for k, m in enumerate(current.members))
                tries.append(self.fit(members, self._values(current), current, quick=True))
            current = min(tries, key=self._score)
            self.by_law[member.id] = tries
        return current

    def law_spread(self, trial: Trial) -> np.ndarray:
        """[P, 2] lowest and highest value of each parameter over the laws that do about as well (`ALIKE` of the loss on what was left out)."""
        x = trial.fit.x
        out = np.stack([x, x], 1)
        at = {p.key: i for i, p in enumerate(trial.fit.params)}
        for tries in self.by_law.values():
            least = min(float(self._left(t).sum()) for t in tries)
            for t in tries:
                if t.ids != trial.ids or float(self._left(t).sum()) > (1 + ALIKE) * least:
                    continue
                for p, value in zip(t.fit.params, t.fit.x, strict=True):
                    if not p.nuisance and p.key in at:
                        out[at[p.key]] = min(out[at[p.key], 0], value), max(out[at[p.key], 1], value)
        return out

    def _overtaken(self, current: Trial, final: dict[str, tuple[list[tuple[str, float]], float, float]]) -> Trial | None:
        """The hypothesis in which a rival stands in the place of the member that it beats in most bootstraps; None where each holds its own."""
        ahead = []
        for k, m in enumerate(current.members):
            others, share, _ = final[m.id]
            if others:
                rival = others[0][0]  # draws that its like wins, which the recording cannot tell from it, are not lost to the rival
                like = sum(s for e, s in others[1:] if confusable(e, m.id) and not confusable(e, rival)) if not confusable(rival, m.id) else 0.0
                ahead.append((others[0][1] - share - like, k, rival))
        for lead, k, rival in sorted(ahead, reverse=True):
            better = self.fitted.get(frozenset((rival, *(m.id for i, m in enumerate(current.members) if i != k))))
            if lead > 0.1 and better is not None and not self._shrunk(better):
                return better
        return None

    def rivals(self, current: Trial, pool) -> dict[str, tuple[list[tuple[str, float]], float, float]]:
        """For each member: what else in its place would do (its share of bootstraps), its confidence, its gain."""
        out = {}
        self.costs: dict[str, list[float]] = {}
        mine = self._left(current)
        sizes = np.cumsum([len(m.variant.params) for m in current.members])[:-1]
        values = np.split(self._values(current), sizes)
        with self._fix(current.members):
            short = float(self.scan_fitter.loss(self.scan_fitter.evaluate(current.fit.params, current.fit.x)[None])[0])
        for i, member in enumerate(current.members):
            rest = tuple(m for k, m in enumerate(current.members) if k != i)
            kept = [v for k, v in enumerate(values) if k != i]
            without = self.fit(rest, np.concatenate(kept) if kept else np.zeros(0), current, quick=True) if rest else None
            lost = self._left(without) if without else self.none_loss
            self.costs[member.id] = self._by_condition(lost, mine)
            others: list[Trial] = []
            for key, (other, start) in pool.items():
                if key == member.id or key in current.ids or any(not _compatible(other, m) for m in rest):
                    continue
                known = self.fitted.get(frozenset((key, *(m.id for m in rest))))
                if known is None and len(others) >= 3 and not confusable(key, member.id):
                    continue
                if known is None and self.deadline.over():
                    self.unasked |= {member.id} if confusable(key, member.id) else set()
                    continue
                trial = known
                if trial is None:
                    draft = self.draft((*rest, other), np.concatenate([*kept, start]), current)
                    if draft[2].loss > 2.5 * short + 0.4:  # one that cannot follow even short stretches is no rival
                        continue
                    trial = self.finish(*draft, current, quick=True)
                self._on(0.05)
                self.fitted[frozenset(trial.ids)] = trial
                # one that cannot follow even what it was fitted to is no rival
                if trial.fit.loss < 2.0 * current.fit.loss + 0.2:
                    self.cross(trial)
                    others.append(trial)
            table = np.stack([mine * _dear(current), *[self._left(t) * _dear(t) for t in others], lost])
            n = table.shape[1]
            size = min(4, n)
            starts = self.rng.integers(0, n, (BOOTSTRAPS, -(-n // size)))
            index = ((starts[..., None] + np.arange(size)) % n).reshape(BOOTSTRAPS, -1)
            sums = table[:, index].sum(-1)
            # a rival within 3 % of the best counts for half: finer than the plant is to be trusted
            weight = np.exp(-np.clip((sums / sums.min(0) - 1) / 0.03, 0, 50))
            shares = (weight / weight.sum(0)).mean(1)
            rows = [(next(x for x in t.ids if x not in {m.id for m in rest}), float(s)) for t, s in zip(others, shares[1:-1], strict=True)]
            rows.sort(key=lambda r: -r[1])
            out[member.id] = (rows, float(shares[0]), float(1 - mine.sum() / lost.sum()))
        return out

    def _by_condition(self, lost: np.ndarray, mine: np.ndarray) -> list[float]:
        """Relative gain of `mine` over `lost` (losses by block [B]) on each condition that was left out."""
        fold = self.fold_of[self.fitter.window]
        out = []
        for number in np.unique(fold):
            pick = np.unique(self.blocks[fold == number])
            out.append(float(1 - mine[pick].sum() / max(float(lost[pick].sum()), 1e-30)))
        return out

    def idle(self) -> Outcome:
        """No search: the nuisances alone."""
        self.fitted = {}
        none = self.start()
        self.none_loss = self._left(none)
        return Outcome(self.case.joint, none, none, {}, {}, {}, {}, [])

    def settle(self, found: Outcome) -> None:
        """What was found, and nothing, as they are judged: on whole recordings, in shorter steps where an effect was found (where a joint
        sticks, or rattles in a dead zone, a millisecond leaves errors beyond the noise)."""
        if found.best.members:
            if not self.deadline.over():
                found.best = self._simpler(found.best)
            self.whole = self.case.plant.refined(FINER)
        self._on(0.3)
        self.polish(found.best), self.polish(found.none)  # kept for the judgement

    def _simpler(self, trial: Trial) -> Trial:
        """The trial without what may be so or otherwise in a drive near its limits (`MAYBE`), where it follows as well without: slopes
        stall at such kinks, and what was kept out may go beyond what told them."""
        params = trial.fit.params
        away = [p.key for p, x in zip(params, trial.fit.x, strict=True) if p.key in MAYBE and abs(x - MAYBE[p.key]) > AWAY * p.span]
        best = trial
        for back in [{k} for k in away] + [set(away)] * (len(away) > 1):
            pinned = [replace(p, low=MAYBE[p.key] - PIN, high=MAYBE[p.key] + PIN, start=MAYBE[p.key]) if p.key in back else p for p in params]
            with self._fix(trial.members):
                f = self.fitter.fit(pinned, x0=trial.fit.x, iterations=6)
            new = Trial(trial.members, f)
            if self._here(new) < (1 + 2 * TIE) * self._here(trial):  # the more of them go back, the better
                best = new
        if best is not trial:
            self.cross(best)
        return best

    def polish(self, trial: Trial) -> Trial:
        """The trial refitted on whole training recordings run free from their first sample, where that follows them
        better than the windows' fit: state carried over windows is right there. Done once a trial."""
        if id(trial) not in self._polished:
            self._polished[id(trial)] = trial, self._polish(trial)
        return self._polished[id(trial)][1]

    def _polish(self, trial: Trial) -> Trial:
        if self.deadline.over():
            return trial
        plant = self.whole
        whole = plant.windows(None, self.train, span=self.span)
        r = Residuals(self.r.sigma_q, self.r.sigma_torque, knee=max(self.r.knee, 3.0))
        fitter = Fitter(plant, whole, r)
        params = trial.fit.params
        with self._fix(trial.members, plant):
            here = fitter.residuals(params, trial.fit.x[None])[0]
            fitter.r.knee = 3.0 * max(1.0, float(np.sqrt(np.median(here**2))) / 0.67)
            # slopes in the windows' own steps serve for shorter ones
            slopes = slopes_of(Fitter(self.case.plant, self.case.plant.windows(None, self.train, span=self.span), r).fit(params, x0=trial.fit.x, iterations=0))
            f = fitter.fit(params, x0=trial.fit.x, iterations=3, tolerance=1e-2, slopes=slopes, exact=False)
        if fitter.loss(f.residual[None])[0] < 0.97 * fitter.loss(here[None])[0]:
            with self._fix(trial.members):
                again = self.fitter.fit(params, x0=f.x, iterations=0)
            polished = Trial(trial.members, again, trial.left_out, trial.folds)
            if again.loss < 1.5 * trial.fit.loss and not self._shrunk(polished):
                return polished
        return trial

    def gain(self, new: Trial, old: Trial) -> float:
        """Share of the squared error that `new` removes, with what the beliefs give for it: on conditions left out or where it was
        fitted, whichever is less."""
        return 1 - max(float(self._left(new).sum() / self._left(old).sum()), self._here(new) / self._here(old))

    def _here(self, trial: Trial) -> float:
        """Mean square where it was fitted, with what the beliefs give for it."""
        return trial.fit.loss + disbelief(trial.fit.params, trial.fit.x) / len(self.blocks)

    def by_run(self, trial: Trial) -> np.ndarray:
        """[R] mean Huber square of each run's windows where it was fitted; 0 for runs without."""
        with self._fix(trial.members):
            r = self.fitter.evaluate(trial.fit.params, trial.fit.x)
        a, k = np.abs(r), self.r.knee
        a = np.where(a <= k, a * a, 2 * k * a - k * k) if k > 0 else a * a
        run, count = self.long.run[self.fitter.window], self.case.plant.runs
        return np.bincount(run, a, count) / np.maximum(np.bincount(run, minlength=count), 1)

    def in_windows(self, trial: Trial, runs: list[int], span: dict[int, tuple[float, float]] | None) -> float:
        """Mean Huber square, in sigmas, over windows of `runs` that begin anew at smoothed measured states."""
        windows = self.case.plant.windows(LONG, runs, span=span)
        if not len(windows.window):
            return np.nan
        fitter = Fitter(self.case.plant, windows, self.r)
        with self._fix(trial.members):
            return float(fitter.loss(fitter.evaluate(trial.fit.params, trial.fit.x)[None])[0])

    def widen(self, trial: Trial, bounds: np.ndarray) -> np.ndarray:
        """Intervals that also hold what the residuals do not show, added in squares: the disagreement of the fits without
        one condition each (a jackknife); the believed figures being off by more than their fit says (OFF each, the
        effects' parameters answering); and DOUBT of the value itself, the plant being no truer."""
        f = trial.fit
        x, P = f.x, len(f.x)
        if P == 0:
            return bounds
        low, high = np.array([p.low for p in f.params]), np.array([p.high for p in f.params])
        span = high - low
        square = (0.75 * (bounds[:, 1] - bounds[:, 0])) ** 2
        folds = np.array([g for g in trial.folds if len(g) == P])
        if len(folds) >= 2:
            n = len(folds)
            square += 1.645**2 * (n - 1) / n * ((folds - folds.mean(0)) ** 2).sum(0)
        mine = np.array([not p.nuisance for p in f.params])
        J = f.jacobian * span
        A = J.T @ J
        i, k = np.flatnonzero(mine), np.flatnonzero(~mine)
        if len(i) and len(k):
            M = A[np.ix_(i, i)] + 1e-9 * np.trace(A) * np.eye(len(i))
            answer = np.linalg.solve(M, A[np.ix_(i, k)]) * span[i][:, None] / span[k][None]  # d effect / d nuisance
            off = np.array([OFF * abs(v) if p.mode == "factor" else 0.25 * min(p.span, 4 * OFF * abs(v) + 1e-3 * p.span)
                            for p, v in zip(np.array(f.params, object)[k], x[k], strict=True)])  # fmt: skip
            square[i] += ((1.645 * answer * off) ** 2).sum(1)
        itself = np.array([0.03 if p.key.endswith(("kp_factor", "kd_factor")) else DOUBT for p in f.params])
        square += (1.645 * itself * np.abs(x)) ** 2
        half, laws = np.sqrt(square), self.law_spread(trial)
        return np.stack([np.maximum(laws[:, 0] - half, low), np.minimum(laws[:, 1] + half, high)], 1)


class _Fixed:
    """Constants set on a plant's nominal inside a `with`."""

    def __init__(self, plant, pairs):
        self.plant, self.pairs = plant, pairs

    def __enter__(self):
        self.saved = self.plant.nominal
        if self.pairs:
            self.plant.nominal = [row.copy() for row in self.saved]
            for name, value in self.pairs:
                for row in self.plant.nominal:
                    row[INDEX[name]] = value

    def __exit__(self, *exc):
        self.plant.nominal = self.saved


def _named(member: Member) -> list[Param]:
    """The member's parameters with keys unique in a hypothesis."""
    return [replace(p, key=f"{member.id}.{p.key}") for p in member.variant.params]


def _dear(trial: Trial) -> float:
    """Factor on the losses of a hypothesis that can imitate simpler ones."""
    return float(np.prod([1 + m.variant.dear for m in trial.members]))


def _compatible(a: Member, b: Member) -> bool:
    return compatible(a.effect, a.variant, b.effect, b.variant)


def expand_one(case: Case, params: list[Param], x: np.ndarray) -> np.ndarray:
    """[R, C] plant parameters at one guess."""
    return expand(case.plant, params, x[None])[0]


def _legal(g: np.ndarray) -> np.ndarray:
    for name in ("coulomb_friction", "viscous_friction", "delay", "backlash", "softness", "deadband"):
        g[:, INDEX[name]] = np.maximum(g[:, INDEX[name]], 0.0)
    return g


def _restless(r: np.ndarray, window: np.ndarray) -> float:
    """What of residuals [n] in windows [n] changes from sample to sample, as a standard deviation: by second differences, whose variance
    is six times that of white noise; the largest, of jumps, are cut. A loop's torque is as restless as the encoder that it reads."""
    inner = (window[2:] == window[:-2])
    d = np.abs(r[2:] - 2 * r[1:-1] + r[:-2])[inner]
    if len(d) < 20:
        return 0.0
    return float(np.sqrt(np.mean(np.minimum(d, 4 * np.quantile(d, 0.75)) ** 2) / 6))


def _thin(w: Windows, case: Case, budget: float) -> Windows:
    """At most `budget` seconds of windows: more would say little more. Half of them are those in which a regime variable is most extreme
    (a limit that is reached in one recording of ten must not be thinned out), the others are spread evenly."""
    count, seconds = len(w.window), float(w.window[:, 1].sum()) * case.plant.dt
    if seconds <= budget:
        return w
    most = max(int(count * budget / seconds), 8)
    size = np.maximum(np.bincount(w.sample_window, minlength=count), 1)
    chosen: list[int] = []
    orders = [np.argsort(-np.bincount(w.sample_window, np.abs(case.regimes[name][w.sample_row]), count) / size, kind="stable")
              for name in EXTREMES if name in case.regimes]  # fmt: skip
    for k in range(count):
        for order in orders:
            if len(chosen) < most // 2 and order[k] not in chosen:
                chosen.append(int(order[k]))
    rest = np.setdiff1d(np.arange(count), chosen)
    keep = np.zeros(count, bool)
    keep[chosen] = True
    keep[rest[np.unique(np.linspace(0, len(rest) - 1, most - len(chosen)).astype(int))]] = True
    return subset(w, keep)


def subset(w: Windows, keep: np.ndarray) -> Windows:
    """The windows where keep [W] bool holds."""
    pick = np.flatnonzero(keep)
    new = np.full(len(w.window), -1)
    new[pick] = np.arange(len(pick))
    samples = keep[w.sample_window]
    window = w.window[pick].copy()
    if len(pick):
        window[:, 3] = np.concatenate([[0], np.cumsum(window[:-1, 4])])
    return Windows(window, w.window_t[pick], w.sample_step[samples], w.sample_part[samples], new[w.sample_window[samples]],
                   w.sample_row[samples], w.run[pick])


__all__ = ["JointSearch", "Member", "Outcome", "Trial", "subset"]
