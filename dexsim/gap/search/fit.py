"""Bounded least squares on a joint's windows (multiple shooting, each window from its measured state): batched finite
differences, several damped steps tried at once."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

import numpy as np
from scipy.optimize import lsq_linear

from dexsim.gap.plant.batch import JointPlant, Windows
from dexsim.gap.plant.columns import INDEX, Param, expand
from dexsim.gap.rules import BELIEF, SEARCH

if TYPE_CHECKING:
    from dexsim.gap.search.hypotheses import Member

STEP_OF_VALUE = 4.0  # x the relative step of a finite difference
STEP_OF_BELIEF = 0.03  # of its range: small ones show only how rough the loss is, of sticks that come and go
PATTERN = (0.5, 0.7, 0.85, 0.95, 1.05, 1.18, 1.4, 2.0)  # sizes of an effect that are tried outright
SUMMED = 1 << 18  # residuals that are summed in one call: they stay in a core's cache
ROUNDS, GUESSES = 2, 20  # of what is tried about a fit, and guesses of each
LOOK = 2  # steps of a fit after which it may be given up
AWAY = 0.02  # of a belief's range: one that was moved farther from what is believed is tried there too

MOST = 1e6  # sigmas of a residual
EFFORT_GAIN, EFFORT_OFFSET = INDEX["effort_gain"], INDEX["effort_offset"]


def centre_of(params: list[Param]) -> np.ndarray:
    """Return [P] value at which each parameter is not there."""
    return np.array([{"add": 0.0, "factor": 1.0}.get(p.mode, p.start) for p in params], float)


class Box:
    """Where parameters may be: low, high, span and centre [P], the value that each starts from; prior [P]: weight of
    each belief on the sum of squares, per squared unit of its parameter."""

    def __init__(self, params: Sequence[Param]):
        self.low, self.high, self.centre = (
            np.array([getattr(p, k) for p in params], float) for k in ("low", "high", "start")
        )
        self.span = self.high - self.low
        self.prior = np.array([BELIEF.prior / p.sd**2 if p.sd > 0 else 0.0 for p in params])


def disbelief(params: list[Param], x: np.ndarray) -> float:
    """Return how far x [P] is from what is believed, on the scale of a sum of squared residuals."""
    box = Box(params)
    return float(box.prior @ (x - box.centre) ** 2) if params else 0.0


def robust(res: np.ndarray, k: float) -> np.ndarray:
    """Return weights [m] of residuals by which least squares count them linearly from `k` on; 1 where k is 0."""
    return np.minimum(1.0, k / np.maximum(np.abs(res), 1e-12)) if k > 0 else np.ones(len(res))


def huber_square(res: np.ndarray, k: float) -> np.ndarray:
    """Return Huber's square of residuals of any shape, from `k` on linear; plain squares where k is 0."""
    size = np.abs(res)
    far, out = size > k, size * size
    if k > 0 and far.any():
        size *= 2 * k
        size -= k * k
        np.copyto(out, size, where=far)
    return out


@dataclass
class Residuals:
    """How residuals are weighed: sigma_q rad, sigma_torque N.m (0: not used), spread of the initial state,
    Huber threshold."""

    sigma_q: float
    sigma_torque: float = 0.0
    sigma_q0: float = 0.0
    sigma_v0: float = 0.0
    huber: float = 0.0  # threshold in sigmas from which a residual counts linearly (Huber 1964); 0: plain squares


@dataclass
class Fitted:
    """A fit: x [P]; residual [m], jacobian [m, P] in sigmas at x with the initial states eliminated; of each residual
    the window [m]; loss, the mean (Huber) square."""

    params: list[Param]
    x: np.ndarray
    residual: np.ndarray
    jacobian: np.ndarray
    window: np.ndarray
    loss: float
    iterations: int = 0

    def value(self, key: str) -> float:
        return float(self.x[[p.key for p in self.params].index(key)])


class Fitter:
    """Fits parameter sets of one joint on given windows. passed: whether time is up: a fit then ends where it is."""

    def __init__(
        self, plant: JointPlant, windows: Windows, residuals: Residuals, passed: Callable[[], bool] = lambda: False
    ):
        self.plant, self.w, self.r, self.passed = plant, windows, residuals, passed
        self.q = plant.q[windows.sample_row]
        tau = plant.torque[windows.sample_row]
        self.use_torque = residuals.sigma_torque > 0 and bool(np.isfinite(tau).any())
        self.tau = np.where(np.isfinite(tau), tau, 0.0)
        self.tau_on = np.isfinite(tau)
        n = windows.n
        self.window = (
            np.concatenate([windows.sample_window, windows.sample_window]) if self.use_torque else windows.sample_window
        )
        self.count = len(windows.window)
        order = np.flatnonzero(np.r_[True, np.diff(windows.sample_window) != 0])
        self.starts = np.concatenate([order, order + n]) if self.use_torque else order
        self.eliminate = residuals.sigma_q0 > 0
        # samples of each window, one signal's after the other's
        self._signals = 2 if self.use_torque else 1
        self._sizes = np.tile(np.bincount(windows.sample_window, minlength=self.count), self._signals)
        self.fixed: tuple[tuple[str, float], ...] = ()  # constants of a hypothesis (`given`)

    def given(self, members: Sequence[Member]) -> Self:
        """This fitter with the constants of a hypothesis' variants."""
        fixed = tuple(f for m in members for f in m.variant.fixed)
        if fixed == self.fixed:
            return self
        twin = copy.copy(self)
        twin.fixed = fixed
        return twin

    def residuals(self, params: list[Param], x: np.ndarray, inits: np.ndarray | None = None) -> np.ndarray:
        """Return [H, m] measured minus simulated, in sigmas."""
        plants = expand(self.plant, params, x, self.fixed)
        q, tau = self.plant.simulate(plants, self.w, inits)
        return self.compare(q, tau, plants)

    def compare(self, q: np.ndarray, tau: np.ndarray, plants: np.ndarray) -> np.ndarray:
        """Return [H, m] measured minus simulated position [H, n] and effort [H, n], in sigmas; plants [H, R, C] for
        what the effort's sensor makes of it."""
        n = q.shape[1]
        out = np.empty((len(q), 2 * n if self.use_torque else n))
        with np.errstate(invalid="ignore", over="ignore"):
            position = np.subtract(self.q, q, out=out[:, :n])
            position /= self.r.sigma_q
            if self.use_torque:
                gain, offset = plants[:, 0, EFFORT_GAIN, None], plants[:, 0, EFFORT_OFFSET, None]
                effort = np.subtract(self.tau, gain * tau, out=out[:, n:])
                effort -= offset
                effort /= self.r.sigma_torque
                effort[:, ~self.tau_on] = 0.0
            # what is no number counts as the most: `fmin` takes the other
            np.fmin(out, MOST, out=out)
            return np.maximum(out, -MOST, out=out)

    def init_directions(self, params: list[Param], x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return residuals at x [m], and their change [2, m] per sigma of the initial position and speed."""
        r = self.r
        inits = np.array([[0.0, 0.0], [r.sigma_q0, 0.0], [0.0, r.sigma_v0]])
        res = self.residuals(params, np.repeat(x[None], 3, 0), inits)
        return res[0], res[1:] - res[0]

    def eliminated(self, res: np.ndarray, s: np.ndarray | None) -> np.ndarray:
        """Return res [H, m] after the best initial state of each window (with its prior) is taken out."""
        if s is None:
            return res
        a11, a22, a12 = self.by_window(np.stack([s[0] ** 2, s[1] ** 2, s[0] * s[1]]))
        a11, a22 = a11 + 1.0, a22 + 1.0
        det = a11 * a22 - a12**2
        out = np.empty_like(res)
        some = max(SUMMED // max(res.shape[1], 1), 1)
        room = np.empty((min(some, len(res)), res.shape[1]))
        for a in range(0, len(res), some):  # some at a time: what is made in between stays in a core's cache
            rows, left = res[a : a + some], out[a : a + some]
            part = room[: len(rows)]
            b1, b2 = (self.by_window(np.multiply(rows, one, out=part)) for one in s)
            for k, (c, one) in enumerate((((a22 * b1 - a12 * b2) / det, s[0]), ((a11 * b2 - a12 * b1) / det, s[1]))):
                taken = np.repeat(np.tile(c, self._signals), self._sizes, axis=1)
                taken *= one
                np.subtract(left if k else rows, taken, out=left)
        return out

    def by_window(self, x: np.ndarray) -> np.ndarray:
        """Return [H, W] sums of x [H, m] by window."""
        return np.add.reduceat(x, self.starts, axis=1).reshape(len(x), self._signals, -1).sum(1)

    def loss(self, res: np.ndarray) -> np.ndarray:
        """Return [H] mean of Huber's square."""
        return huber_square(res, self.r.huber).mean(-1)

    def evaluate(self, params: list[Param], x: np.ndarray) -> np.ndarray:
        """Return [m] residuals at x, initial states taken out."""
        if not self.eliminate:
            return self.residuals(params, x[None])[0]
        res, s = self.init_directions(params, x)
        return self.eliminated(res[None], s)[0]

    def perturbed_restarts(self, params: list[Param], f: Fitted, rng: np.random.Generator) -> Fitted:
        """Return the fit again from the best of random guesses about it, where one is better: stick, play and limits
        make the loss rough, and slopes stop at the first dent. Guesses spread as the fit is uncertain, and wider."""
        P = len(params)
        if P == 0:
            return f
        box = Box(params)
        for _ in range(ROUNDS):
            if self.passed():
                break
            J = f.jacobian * box.span
            A = (J * robust(f.residual, self.r.huber)[:, None]).T @ J + np.diag(box.prior * box.span**2)
            # what a rise of the loss by 5 % allows
            A = A / (0.05 * max(f.loss, 1e-12) * len(f.residual)) + 4.0 * np.eye(P)
            values, vectors = np.linalg.eigh(A)
            size = np.where(np.arange(GUESSES) % 2, 1.0, 0.3)[:, None]
            way = vectors / np.sqrt(np.maximum(values, 1e-12))
            z = (rng.standard_normal((GUESSES, P)) / np.sqrt(P) * size) @ way.T
            trial = np.clip(f.x + z * box.span, box.low, box.high)
            s = self.init_directions(params, f.x)[1] if self.eliminate else None
            tried, here = self._tried(box, params, trial, s), float(self._score(box, f.x, f.residual))
            best = int(np.argmin(tried))
            start = trial[best] if tried[best] < here else f.x
            again = self.fit(params, x0=start, iterations=4, tolerance=5e-3, slopes=slopes_of(f))
            if not float(self._score(box, again.x, again.residual)) < here * (1 - 5e-3):
                break
            f = again
        return f

    def toward_prior(self, params: list[Param], f: Fitted) -> Fitted:
        """Return the fit again from where one belief, or all of them, are back at what is believed, all else following
        by its slopes, where that is better: in a valley of what acts alike (a damping in the loop, a viscous friction),
        and at kinks, steps end before they are there."""
        P = len(params)
        nuisance = np.array([p.nuisance for p in params], bool)
        if not nuisance.any():
            return f
        box = Box(params)
        low, high, span, centre, believed = box.low, box.high, box.span, box.centre, box.prior
        for _ in range(ROUNDS):
            if self.passed():
                break
            J = f.jacobian * span
            weighed = J * robust(f.residual, self.r.huber)[:, None]
            A = weighed.T @ J
            A[np.diag_indices(P)] += believed * span**2 + 1e-3 * np.diag(A) + 1e-9 * max(np.trace(A), 1e-30)
            b = -weighed.T @ f.residual - believed * (f.x - centre) * span
            away = nuisance & (np.abs(f.x - centre) > AWAY * span)
            guesses = []
            if not away.any():
                return f
            for back in [np.arange(P) == i for i in np.flatnonzero(away)] + [nuisance]:
                # all else follows, or an effect alone: an inertia's takes over exactly, slopes of rough losses say so
                # only nearly
                for rest, pull in ((np.flatnonzero(~back), 1.0), (np.flatnonzero(~back & ~nuisance), 0.0)):
                    z = (centre - f.x) / span * back
                    if len(rest):
                        right = pull * b[rest] - A[np.ix_(rest, np.flatnonzero(back))] @ z[back]
                        room = ((low - f.x)[rest] / span[rest] - 1e-9, (high - f.x)[rest] / span[rest] + 1e-9)
                        z[rest] = bounded(A[np.ix_(rest, rest)], right, *room)
                    guesses.append(np.clip(f.x + z * span, low, high))
            moved = np.array(guesses)
            s = self.init_directions(params, f.x)[1] if self.eliminate else None
            tried = self._tried(box, params, moved, s)
            here, best = float(self._score(box, f.x, f.residual)), int(np.argmin(tried))
            if not tried[best] < here * (1 - 5e-3):
                return f
            f = self.fit(params, x0=moved[best], iterations=4, tolerance=5e-3, slopes=slopes_of(f))
        return f

    def pattern(self, params: list[Param], x: np.ndarray) -> np.ndarray:
        """Return [H, P] guesses about x [P]: each effect's parameter scaled, each belief moved, one at a time."""
        out = []
        for i, p in enumerate(params):
            zero = p.low if p.mode == "set" and p.low >= 0 else centre_of([p])[0]
            moves = (
                [0.1 * p.span, -0.1 * p.span, 0.03 * p.span, -0.03 * p.span]
                if p.nuisance
                else [(f - 1) * (x[i] - zero) for f in PATTERN]
            )
            for d in moves:
                g = x.copy()
                g[i] += d
                out.append(g)
        return np.array(out)

    def _score(self, box: Box, x: np.ndarray, res: np.ndarray) -> np.ndarray:
        """Return loss and disbelief at x [.., P], where res [.., m] is left."""
        return self.loss(res) + ((x - box.centre) ** 2 @ box.prior) / res.shape[-1]

    def _tried(self, box: Box, params: list[Param], trial: np.ndarray, s: np.ndarray | None) -> np.ndarray:
        """Return [K] loss and disbelief at each of trial [K, P], the initial states eliminated along s."""
        return self._score(box, trial, self.eliminated(self.residuals(params, trial), s))

    def fit(
        self,
        params: list[Param],
        x0: np.ndarray | None = None,
        iterations: int = 10,
        tolerance: float = 2e-3,
        step: float = 0.01,
        slopes: dict[str, np.ndarray] | None = None,
        lazy: bool = False,
        exact: bool = True,
        hopeless: float = np.inf,
    ) -> Fitted:
        """Fit by Levenberg-Marquardt inside the bounds from x0 [P] (the params' starts).

        slopes: change [m] of the residuals per span of a parameter, by its key, known from a fit nearby on the same
        windows. lazy: once known, from there or from the first batch, the slopes of beliefs and of these parameters
        follow the steps by Broyden's rank-one updates (C. G. Broyden, Math. Comp. 19, 1965) and are simulated anew only
        where they lead no further: a third of the simulations; and what is `late` is held, and let go for one more
        step where the others end, if exact. That lowers the loss by `SEARCH.apart` for each, or they are left out of
        the fit: it never ends higher than one without them. Where the others miss by more than `SEARCH.astray` x the
        noise, too: what is missing would be laid on them. exact: end with slopes that were simulated at the end.
        hopeless: what leaves more than this after `LOOK` steps ends there."""
        box = Box(params)
        low, high, span, centre, believed = box.low, box.high, box.span, box.centre, box.prior
        x = np.clip(centre if x0 is None else np.array(x0, float), low, high)
        belief = np.array([p.nuisance for p in params], bool)
        damping = 1e-2
        P = len(params)
        jac, known = self._known(params, slopes)  # known: slopes that were not simulated here
        follow = (belief | known) if lazy or slopes is not None else np.zeros(P, bool)
        held = np.array([lazy and p.late for p in params], bool)
        known &= ~held
        moved = last = s = None
        fresh, done, let_go, least = True, False, False, 1e-6
        it = 0
        while True:
            if fresh:
                delta = _differences(params, x, step)
                anew = ~(known | held)
                res, columns, s = self._slopes(params, x, delta, np.flatnonzero(anew))
                if known.any() and moved is not None:
                    rise = np.outer((res - last) - jac @ moved, moved)
                    rise /= max(float(moved @ moved), 1e-30)
                    jac += rise
                jac[:, anew] = columns / (delta / span)[anew]
                loss = float(self.loss(res)) + float(believed @ (x - centre) ** 2) / len(res)
            done |= it >= iterations or (it >= LOOK and loss > hopeless)
            if done and held.any() and exact and loss <= SEARCH.astray**2 and not self.passed():
                jac[:, held] = self._slopes(params, x, delta, np.flatnonzero(held))[1] / (delta / span)[held]
                least = max(SEARCH.apart * int((held & (x == centre)).sum()), 1e-6)
                held, let_go, done, iterations, damping = np.zeros(P, bool), True, False, it + 1, 1e-2
            if done or P == 0 or self.passed():
                break
            weighed = jac * robust(res, self.r.huber)[:, None]
            A = weighed.T @ jac
            b = -weighed.T @ res - believed * (x - centre) * span
            A[np.diag_indices(P)] += believed * span**2
            at_low, at_high = x <= low + 1e-12, x >= high - 1e-12
            free = np.flatnonzero(~(held | (at_low & (b < 0)) | (at_high & (b > 0))))
            if len(free) == 0:
                done, fresh = True, False
                continue
            lambdas = damping * np.array([1e-2, 0.1, 1.0, 10.0, 100.0, 1000.0])
            trial = np.clip(x + _damped(A, b, free, lambdas) * span, low, high)
            tried = self._tried(box, params, trial, s)
            best = int(np.argmin(tried))
            gain = (loss - float(tried[best])) / max(loss, 1e-30)
            # by slopes from elsewhere: here they are simulated before this is the end
            if known.any() and gain < tolerance and not let_go:
                if gain > 0:
                    x = trial[best]
                known[:], fresh, moved, damping = False, True, None, 1e-2
                if not exact:
                    iterations = min(iterations, it + 2)
                continue
            if not tried[best] < loss * (1 - least):
                if damping <= 1e2:
                    damping *= 1e3
                    fresh = False
                    it += 1
                    continue
                # a kinked loss has no slope to follow: try sizes outright
                trial = np.clip(self.pattern(params, x), low, high)
                tried = self._tried(box, params, trial, s)
                best = int(np.argmin(tried))
                if not tried[best] < loss * (1 - tolerance):
                    done, fresh = True, False
                    continue
                x, damping, fresh, moved = trial[best], 1e-2, True, None
                it += 1
                continue
            moved, last = (trial[best] - x) / span, res
            x, damping, fresh = trial[best], max(lambdas[best] * 0.3, 1e-6), True
            it += 1
            if gain < tolerance:
                # one more Jacobian at the new point, for the intervals
                iterations = min(iterations, it)
            known = follow & ~held
        if exact and known.any() and not self.passed():
            res, jac, s = self._slopes(params, x, delta, np.arange(P))
            jac = jac / (delta / span)
        keep = [i for i, p in enumerate(params) if not (lazy and exact and p.late and x[i] == centre[i])]
        return Fitted(
            [params[i] for i in keep],
            x[keep],
            res,
            (jac / span)[:, keep] if P else np.zeros((len(res), 0)),
            self.window,
            float(self.loss(res)),
            iterations=it,
        )

    def _known(self, params: list[Param], slopes: dict[str, np.ndarray] | None) -> tuple[np.ndarray, np.ndarray]:
        """Return (slopes [m, P] per span as far as they are known, which are [P])."""
        m = len(self.window)
        jac, known = np.zeros((m, len(params))), np.zeros(len(params), bool)
        for i, p in enumerate(params):
            if slopes is not None and p.key in slopes and len(slopes[p.key]) == m:
                jac[:, i], known[i] = slopes[p.key], True
        return jac, known

    def _slopes(
        self, params: list[Param], x: np.ndarray, delta: np.ndarray, which: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
        """Return (residuals [m] at x, their changes [m, k] by delta of the parameters `which` [k], by initial states
        [2, m]), by one batch of simulations: here, each of them moved, the initial state moved."""
        k = len(which)
        guesses = np.repeat(x[None], k + 3, 0)
        guesses[1 + np.arange(k), which] += delta[which]
        inits = np.zeros((k + 3, 2))
        inits[k + 1, 0], inits[k + 2, 1] = self.r.sigma_q0, self.r.sigma_v0
        if not self.eliminate:
            guesses, inits = guesses[: k + 1], inits[: k + 1]
        raw = self.residuals(params, guesses, inits)
        s = raw[k + 1 :] - raw[0] if self.eliminate else None
        clean = self.eliminated(raw[: k + 1], s)
        return clean[0], (clean[1:] - clean[0]).T, s


def _differences(params: list[Param], x: np.ndarray, step: float) -> np.ndarray:
    """Return [P] steps of the finite differences at x, backward where forward would leave the bounds: `step` of a
    range, and small beside the value too, for a range may be wide and many effects are kinked where they begin."""
    box, belief = Box(params), np.array([p.nuisance for p in params], bool)
    high, span = box.high, box.span
    size = step * np.minimum(span, np.maximum(STEP_OF_VALUE * np.abs(x - centre_of(params)), 0.03 * span))
    size = np.where(belief, STEP_OF_BELIEF * span, size)
    return np.where(x + size <= high, size, -size)


def _damped(A: np.ndarray, b: np.ndarray, free: np.ndarray, lambdas: np.ndarray) -> np.ndarray:
    """Return [K, P] steps of the normal equations A step = b in the `free` parameters, in spans and at most half of
    one, each damped by one of lambdas [K]."""
    scale = np.diag(A) + 1e-9 * max(np.trace(A), 1e-30)
    steps = np.zeros((len(lambdas), len(b)))
    M = A[np.ix_(free, free)] + lambdas[:, None, None] * np.diag(scale[free])
    try:
        steps[:, free] = np.linalg.solve(M, np.repeat(b[None, free, None], len(lambdas), 0))[..., 0]
    except np.linalg.LinAlgError:  # one of them at least: each by itself
        for i, one in enumerate(M):
            steps[i, free] = _solved(one, b[free])
    return np.clip(steps, -0.5, 0.5)


def bounded(A: np.ndarray, b: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return [F] the least of x' A x / 2 - b' x with low <= x <= high, A [F, F] being positive definite: by which
    bounds hold, in a tenth of the time of SciPy's interior steps."""
    root = np.linalg.cholesky(A).T
    return lsq_linear(root, np.linalg.solve(root.T, b), (low, high), method="bvls").x


def _solved(M: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return [F] x of M x = b, the shortest of them where there are many."""
    try:
        return np.linalg.solve(M, b)
    except np.linalg.LinAlgError:
        return np.linalg.lstsq(M, b, rcond=None)[0]


def slopes_of(f: Fitted) -> dict[str, np.ndarray]:
    """Return slopes [m] of a fit's residuals per span of each parameter, by its key, as `Fitter.fit` takes them."""
    return {p.key: f.jacobian[:, i] * p.span for i, p in enumerate(f.params)}


def intervals(fitted: Fitted, blocks: np.ndarray, huber: float = 0.0) -> np.ndarray:
    """Return [P, 2] 90 % intervals that let residuals be correlated inside a block: the sandwich over blocks [m] of
    each residual, with the small-sample factor of the number of blocks."""
    P = len(fitted.params)
    if P == 0:
        return np.zeros((0, 2))
    J, r = fitted.jacobian, fitted.residual
    psi = r if huber <= 0 else np.clip(r, -huber, huber)
    box = Box(fitted.params)
    low, high, span = box.low, box.high, box.span
    Js = J * span
    # the bounds are priors: a parameter is not known worse than its range
    A = Js.T @ Js
    ridge = np.full(P, 1e-9 * max(np.trace(A), 1e-30))
    count = int(blocks.max()) + 1
    scores = np.stack([np.bincount(blocks, Js[:, i] * psi, count) for i in range(P)], 1)
    centre = scores.mean(0)
    B = (scores - centre).T @ (scores - centre) * count / max(count - 1, 1)
    # prior of a quarter of the span on nuisances, which are known to that
    prior = np.array([12.0 if p.nuisance else 0.0 for p in fitted.params])
    typical = float(np.mean(psi**2)) * max(len(r) / max(count, 1) * 0.1, 1.0)
    inverse = np.linalg.pinv(A + np.diag(ridge) + np.diag(prior * typical))
    cov = inverse @ (B + np.diag(prior * typical)) @ inverse
    se = np.sqrt(np.maximum(np.diag(cov), 0.0)) * span
    x = fitted.x
    return np.stack([np.maximum(x - 1.645 * se, low), np.minimum(x + 1.645 * se, high)], 1)
