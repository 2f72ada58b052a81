"""Figures that decide about touch, by made-up readings and losses."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from dexsim.gap.effects.catalogue import TOUCH_CATALOGUE, TOUCH_EFFECTS
from dexsim.gap.finding import Finding
from dexsim.gap.rules import JUDGE
from dexsim.gap.touch import judge, read
from dexsim.gap.touch import search as pad_search
from dexsim.gap.touch.diagnosis import Pad, Touch
from dexsim.gap.touch.judge import PadAnswer
from dexsim.gap.touch.search import PadFit, PadSearch, TouchTrial
from dexsim.recording.schema import TACTILE, Series


class Felt(PadSearch):
    """A search of one pad whose trials say themselves what they lose on the presses left out."""

    def __init__(self):
        self.rng = np.random.default_rng(0)

    def cross(self, trial):
        return np.full(20, trial)


def test_a_touch_effect_must_remove_a_least_share():
    assert not Felt()._earns(0.9, 1.0) and Felt()._earns(0.86, 1.0)


def rest(gains, width=0.05):
    """Return what is said of taxels that felt nothing, the others' gains [n] being these."""
    count = len(gains)
    pad = SimpleNamespace(
        silent={}, runs=[SimpleNamespace(z=np.ones((3, count)))], gain_width=lambda t: np.full(count, width)
    )
    return PadAnswer._rest(SimpleNamespace(search=pad, best=SimpleNamespace(gains=np.array(gains), order=None)))


def test_taxels_that_agree_speak_for_the_rest():
    assert rest([0.8] * 5) is not None and rest([0.8] * 4) is None
    assert rest([0.89] * 12) is not None and rest([0.91] * 12) is None
    assert rest([0.8] * 9) is not None and rest([0.8] * 3) is None
    assert rest([0.8] * 9, width=0.09) is not None and rest([0.8] * 9, width=0.11) is None


def test_a_pad_must_be_touched_for_a_while():
    for seconds, judged_ in ((2.9, False), (3.1, True)):
        touch = Touch([], SimpleNamespace(sensors=SimpleNamespace(names=["a", "b"])), set())
        t = np.arange(0.0, seconds, 0.01)
        touch.pads = [Pad(1, [SimpleNamespace(recording="a", name="index", t=t, z=np.ones((len(t), 4)))])]
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("dexsim.gap.touch.diagnosis.PadSearch", lambda *_: "search")
            touch.plant()
        assert (touch.pads[0].search == "search") is judged_, seconds


class Choosing(PadSearch):
    """A search of one pad that is offered some effects, whose losses are given."""

    def __init__(self, losses, offered=()):
        """Take losses of a reading, by what is left out and where it was fitted, from the effects of a hypothesis."""
        self.losses, self.offered = losses, [TOUCH_EFFECTS[e] for e in offered]
        self.rng, self.train, self.scale_known, self.runs = (
            np.random.default_rng(0), np.ones(100, bool), False, [SimpleNamespace(pad=1)])  # fmt: skip

    def fit(self, ids, values, where=None, gains=None, order=None, evaluations=60, still=()):
        out, here = self.losses(ids)
        return TouchTrial(ids, values, gains, order, left_out=np.full(20, 5.0 * out), res=np.full(100, np.sqrt(here)))

    def cross(self, trial):
        return trial.left_out

    def scan(self, current, most=4):
        return [e for e in self.offered if e.id not in current.ids]

    def _possible(self, current, effect):
        return effect in self.offered and effect.id not in current.ids

    def _try(self, current, effect):
        gains = np.ones(4) if effect.by_taxel else None
        return self.fit((*current.ids, effect.id), {}, gains=gains) if self._possible(current, effect) else None

    def _drop(self, current, trials):
        return current

    def _rivals(self, current, e, trials):
        return [], 1.0


def chosen(losses, *offered):
    return Choosing(losses, offered).run().best.ids


def test_within_the_noise_no_touch_effect_is_looked_for():
    for loss, found in ((1.38, ()), (1.5, ("tactile_delay",))):  # squared
        assert chosen(lambda ids, loss=loss: (0.5 if ids else loss,) * 2, "tactile_delay") == found, loss


def test_a_pad_has_at_most_so_many_effects():
    offered = [e.id for e in TOUCH_CATALOGUE if not e.by_taxel]
    assert len(chosen(lambda ids: (1e6 * 0.5 ** len(ids),) * 2, *offered)) == 4 < len(offered)


def test_a_gain_for_every_taxel_has_a_price():
    for one, found in ((1.6, ("tactile_delay",)), (1.8, ("tactile_gain",))):
        loss = lambda ids, one=one: ({(): 10.0, ("tactile_delay",): one}.get(ids, 1.0),) * 2  # noqa: E731
        pair = chosen(loss, "tactile_delay", "tactile_gain")
        assert pair[:1] == found, one


def test_of_touch_effects_that_are_close_the_one_that_follows_better_is_taken():
    for other, found in ((1.01, "thermal"), (1.03, "tactile_delay")):
        known = {(): (10.0, 10.0), ("tactile_delay",): (1.0, 2.0)}
        loss = lambda ids, known=known, other=other: known.get(ids, (other, 1.0))  # noqa: E731
        assert chosen(loss, "tactile_delay", "thermal")[0] == found, other


class Mapped(PadSearch):
    """A search of one pad that has a gain for every taxel, and one for the pad, to choose from."""

    def __init__(self, ratio):
        self.ratio, self.train, self.scale_known, self.allowed, self.shear = ratio, np.ones(50, bool), True, None, False

    def fit(self, ids, values, where=None, gains=None, order=None, evaluations=60, still=()):
        return TouchTrial(ids, dict(values), gains, order, res=np.ones(50))

    def residual(self, values, gains=None, order=None):
        return np.full(50, np.sqrt(self.ratio))

    def gain_map(self, trial, where):
        return np.ones(4)

    def _possible(self, current, effect):
        return True

    def _swaps(self, values):
        return None

    def _common(self, effect, current, evaluations):
        return self.fit((*current.ids, "tactile_gain"), {})


def test_a_gain_for_every_taxel_must_follow_clearly_better_than_one():
    gain = next(e for e in TOUCH_CATALOGUE if e.by_taxel)
    for loss, mapped in ((0.58, True), (0.6, False)):  # x what one gain leaves
        assert (Mapped(loss)._try(TouchTrial((), {}), gain).gains is not None) is mapped, loss


def claimed(after=0.5, share=0.0):
    """Return the finding of a pad's gain that leaves so much of 1 N on what was held out, its like having a share of
    the draws."""
    of = lambda x: (x, np.full(20, x * x), np.arange(20))  # noqa: E731
    loss_of = lambda _, trial, stage: of(after if trial == "best" else 1.0)  # noqa: E731
    best = SimpleNamespace(ids=("tactile_gain",))
    answer = SimpleNamespace(search=SimpleNamespace(load=False), best=best, none="none", name="thumb", pad=0, notes=[],
                             outcome=SimpleNamespace(rivals={"tactile_gain": [("contact_stiffness", share)]},
                                                     confidence={"tactile_gain": 1.0}),
                             _parameters=lambda e: ([], {}))  # fmt: skip
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(judge, "held_out", lambda s, trial, stage: loss_of(s, "best" if trial is best else trial, stage))
        patch.setattr(judge, "when", lambda *_: [])
        return PadAnswer._finding(answer, "tactile_gain")


def test_a_touch_rival_of_the_same_class_makes_a_set():
    for share, together in ((0.045, False), (0.055, True)):
        assert (len(claimed(share=share).indistinguishable) == 2) is together, share


def test_a_touch_effect_that_earns_next_to_nothing_is_not_claimed():
    assert claimed(after=0.981) is None and claimed(after=0.979) is not None


def sigma_of(z, t):
    """Return the noise [N] that the fit gives readings z [S, 1] at times t [S], a sensor without noise or counts."""
    run = SimpleNamespace(t=t, z=z, lsb=0.0, full=np.zeros(z.shape, bool), recording="a")
    pad = SimpleNamespace(runs=[run], base={}, silent={}, noise=1e-9, load=False, shear=False)
    pad._sample = lambda *given: PadFit._sample(pad, *given)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pad_search, "readings", lambda r, *_: r.z)
        return PadFit._samples(pad, set())[0].sigma[:, 0]


def test_a_plant_of_touch_is_trusted_to_so_much_of_a_reading():
    t = np.arange(50) * 0.01
    assert sigma_of(np.full((50, 1), 10.0), t) == pytest.approx(0.2)


def test_the_time_of_a_reading_is_uncertain():
    t = np.arange(50) * 1e-4
    assert sigma_of(100.0 * t[:, None], t) == pytest.approx(0.3, rel=1e-3)  # 100 N/s, up to 0.5 N


def test_the_gain_of_a_taxel_is_believed_to_be_one():
    """A taxel whose readings of 0 weigh as much as what is believed before."""
    count, sigma = 40, 0.3 * np.sqrt(0.1 * 40)  # a tenth of them counts as independent
    sample = SimpleNamespace(stage="taxels", mask=np.ones((count, 1), bool), sigma=np.full((count, 1), sigma),
                             run=SimpleNamespace(z=np.zeros((count, 1))))  # fmt: skip
    pad = SimpleNamespace(runs=[sample.run], samples=[sample])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pad_search, "readings", lambda r, *_: np.ones_like(r.z))
        assert PadFit.gain_map(pad, TouchTrial((), {}), np.ones(count, bool)) == pytest.approx(0.5)


def test_what_is_left_of_a_pad_has_structure():
    for loss, remaining, structure in ((1.8, 1.4, True), (1.6, 1.4, False), (1.8, 1.2, False)):
        search = SimpleNamespace(cross=lambda _, loss=loss: np.full(10, loss), train=np.ones(10, bool))
        answer = SimpleNamespace(search=search, best=None, left=remaining, floor=1.0)
        assert PadAnswer.structured(answer) is structure, (loss, remaining)


class Recorded:
    """Readings [T, F, K, 3] of a recording."""

    def __init__(self, value):
        self.value = value

    def __len__(self):
        return len(self.value)


def test_taxels_that_never_change_are_named_surely():
    assert judge.pressed({3: 0.0}, 1).confidence == JUDGE.surest
    force = np.zeros((30, 1, 4, 3))
    force[:, 0, 1:, 2] = np.arange(30.0)[:, None]
    sensors = SimpleNamespace(layout=SimpleNamespace(pads=1),
                              beside=lambda f: [[j for j in range(4) if j != k] for k in range(4)])  # fmt: skip
    (found,) = judge.constant_taxels([SimpleNamespace(tactile=Recorded(force))], sensors)
    assert found.taxels == ["0:0"] and found.confidence == JUDGE.sure


def test_what_is_left_of_a_pad_goes_with_something():
    rng, n = np.random.default_rng(0), 4000
    t, load = np.arange(float(n)), rng.uniform(1.0, 2.0, n)
    for part, said in ((0.42, True), (0.32, False)):  # squares of correlations of about 0.16 and 0.09
        order = part * (load - 1.5) / 0.289 + np.sqrt(1 - part**2) * rng.normal(size=n)
        error = np.argsort(np.argsort(order)) / n
        run = SimpleNamespace(t=t, grid=t, z=load[:, None], depth=np.zeros(n), error=error[:, None])
        pad, trial = SimpleNamespace(runs=[run]), TouchTrial((), {})
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(judge, "readings", lambda r, *_: r.z - r.error)
            assert (len(judge.depends_on(pad, trial, "thumb")) == 1) is said, part


def test_a_little_crosstalk_may_be_another_law():
    crosstalk = TOUCH_EFFECTS["tactile_crosstalk"]
    doubt = lambda low: crosstalk.doubt(Finding("", 1.0, "", parameters={"fraction": {"low": low}}))  # noqa: E731
    assert doubt(0.13) and not doubt(0.17)


def test_a_drift_needs_a_temperature_or_a_second_recording():
    for thermometer, runs, possible in ((True, 1, True), (False, 2, True), (False, 1, False)):
        search = SimpleNamespace(thermometer=thermometer, runs=["one"] * runs)
        assert TOUCH_EFFECTS["thermal"].possible(search) is possible, (thermometer, runs)


class Scanned(PadSearch):
    """A search of one pad whose one effect would take a share of what is left, by a linear score."""

    def __init__(self, share):
        self.train, residual = np.ones(100, bool), np.ones(100)
        across = np.tile([1.0, -1.0], 50)
        self.changed = np.sqrt(share) * residual + np.sqrt(1 - share) * across
        self.current = TouchTrial((), {}, keys=(), jac=np.zeros((100, 0)), res=residual)

    def _possible(self, current, effect):
        return effect.id == "tactile_delay"

    def residual(self, values, gains=None, order=None):
        return self.current.res - self.changed


def test_a_touch_effect_must_promise_something():
    for share, tried in ((0.035, True), (0.025, False)):
        search = Scanned(share)
        assert (search.scan(search.current) != []) is tried, share


def silent(pressed=1.0, beside=1.0, lsb=0.0, reading=0.0):
    """Return the taxels that are called silent, the second of three reading the same for ever: with what the plant
    presses it and what its neighbours read at most, in a noise of 0.01 N."""
    rise = np.linspace(0.0, 1.0, 20)[:, None]
    run = SimpleNamespace(z=rise * [beside, 0.0, beside] + [0.0, reading, 0.0], lsb=lsb, beside=[[1], [0, 2], [1]])
    pad = SimpleNamespace(runs=[run], noise=0.01, base={})
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pad_search, "readings", lambda *_: rise * [1.0, pressed, 1.0])
        return PadFit._silent(pad)


def test_a_silent_taxel_is_pressed_and_its_neighbours_feel():
    assert silent(pressed=0.055) == {1: 0.0} and silent(pressed=0.045) == {}
    assert silent(beside=0.055) == {1: 0.0} and silent(beside=0.045) == {}
    assert silent(pressed=0.45, lsb=0.1) == {1: 0.0} and silent(pressed=0.35, lsb=0.1) == {}


def test_a_reading_that_never_changes_is_stuck():
    assert silent(pressed=0.0, lsb=0.1, reading=0.25) == {1: 0.25} and silent(pressed=0.0, lsb=0.1, reading=0.15) == {}


def test_a_little_force_is_no_touch():
    t = 0.01 * np.arange(200)
    on = (t > 0.5) & (t < 1.0)
    taxel = lambda newtons: np.stack([newtons * on] * 12, 1).reshape(-1, 1, 4, 3)  # noqa: E731
    for newtons, touched in ((0.12, 0), (0.18, 1)):
        r = SimpleNamespace(tactile=Series(t, taxel(newtons), TACTILE), external_force=None)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(read, "newtons", lambda r: (r.tactile.value, True))
            assert len(read.stretches(r)) == touched, newtons
    for newtons, touched in ((0.25, 0), (0.4, 1)):
        force = np.stack([newtons * on, 0 * t, 0 * t], 1)
        assert len(read.stretches(SimpleNamespace(tactile=None, external_force=Series(t, force, "")))) == touched
