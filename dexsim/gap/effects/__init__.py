"""Effects, a file for each family, gathered in `catalogue.py`. Here is what an entry holds: everything that the
diagnosis needs to know of one effect, on a joint (`Effect`) or of touch and contact (`TouchEffect`), and what a touch
effect writes for training.

Of an effect that training has no use for the columns stand in `dexsim.gap.plant.columns`, of all others in
`dexsim.actuator.columns`; how to add one, step by step, is in docs/howto/extending.md.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from dexsim.actuator.columns import INDEX as SERVO_INDEX
from dexsim.gap.finding import Finding
from dexsim.gap.plant.columns import Param, Scales
from dexsim.gap.touch.plant import contact, readings
from dexsim.gap.touch.read import FRICTION, STIFFNESS

if TYPE_CHECKING:
    import mujoco

    from dexsim.actuator.table import ServoTable
    from dexsim.gap.plant.case import Case
    from dexsim.gap.search.inverse_dynamics import Columns
    from dexsim.gap.touch.read import PadRun
    from dexsim.gap.touch.search import PadSearch, TouchTrial


Fit = tuple[float, float, float]  # value, low, high


@dataclass
class PadFacts:
    """Of a judged pad, beside its findings: silent: constant taxels and their reading [N] (0: dead); common: gain of
    all its taxels; rest: of those that a map of single gains does not name; chord: contact stiffness [N/m] that stands
    for a fitted rubber; warmest: where a drift ends (degC above the coldest, or s); stiffness [N/m], friction: what was
    believed; slid: whether friction could be judged."""

    silent: dict[int, float] = field(default_factory=dict)
    common: Fit | None = None
    rest: Fit | None = None
    chord: Fit | None = None
    warmest: float = 0.0
    stiffness: float = STIFFNESS
    friction: float = FRICTION
    slid: bool = False
    judged: bool = True

    def believed(self, setting: str) -> float | None:
        """Return what was believed of a setting of the whole world (`PadSettings.shared`), None where this pad cannot
        say."""
        told = {"object.friction": (self.friction, self.slid), "contact.stiffness": (self.stiffness, True)}
        value, known = told[setting]
        return value if self.judged and known else None


@dataclass
class PadSettings:
    """What is written of one pad: its facts; values: by key of `tactile.yaml`'s pads; shared: settings of the whole
    world (`object.friction`, `contact.stiffness`) by name, as this pad has them."""

    fact: PadFacts
    values: dict[str, Any] = field(default_factory=dict)
    shared: dict[str, Fit] = field(default_factory=dict)


def wide(fit: Fit, believed: float | None) -> Fit:
    """Return a fit whose range also holds what was believed."""
    return fit if believed is None else (fit[0], min(fit[1], believed), max(fit[2], believed))


def absent(fit: Fit, believed: float) -> Fit:
    """Return what the other effect of a set would be in the place of the one named: best guess that it is not there, in
    a range that holds it."""
    return believed, min(fit[1], believed), max(fit[2], believed)


def fitted(p: dict[str, Any], believed: float | None, factor: float = 1.0) -> Fit:
    """Return (value, low, high) of a parameter, widened to what was believed (in the parameter's unit), times a
    factor."""
    value, low, high = (float(p[k]) for k in ("value", "low", "high"))
    return times((factor, factor, factor), wide((value, low, high), believed))


def times(a: Fit | None, b: Fit) -> Fit:
    """Return products of values and of ends."""
    return b if a is None else (a[0] * b[0], a[1] * b[1], a[2] * b[2])


def ranged(fit: Fit, lowest: float, highest: float) -> dict[str, float]:
    """Return a fit as the file holds it, inside what is physical."""
    value, low, high = (float(f"{np.clip(x, lowest, highest):.6g}") for x in fit)
    return {"value": value, "low": min(low, value), "high": max(high, value)}


@dataclass(frozen=True)
class Variant:
    """One way an effect may be there: its parameters, starts [n][P], and constants set on the plant."""

    params: tuple[Param, ...]
    starts: tuple[tuple[float, ...], ...]
    label: str = ""
    fixed: tuple[tuple[str, float], ...] = ()
    note: dict = field(default_factory=dict)
    refines: bool = False  # adds parameters to a variant before it: tried only where that one was found
    approximate: bool = False  # the servo table has it less exactly: tried only where what stands in for it leaves much
    complexity_price: float = 0.0  # of the loss: by as much it must do better than simpler effects that it can imitate
    laws: tuple[tuple[str, tuple[tuple[str, float], ...]], ...] = ()  # other laws of the same effect: (name, constants)

    def by_law(self) -> list[Variant]:
        """Return the variant by its other laws, each with its constants in the place of those of the same columns."""
        label = lambda name: f"{self.label}, {name}" if self.label else name  # noqa: E731
        kept = lambda by: tuple(f for f in self.fixed if f[0] not in {name for name, _ in by})  # noqa: E731
        return [replace(self, label=label(name), fixed=(*kept(by), *by), laws=()) for name, by in self.laws]


@dataclass(frozen=True)
class FittedEffect:
    """What a fit says of one effect on one joint: values and 90 % intervals by `Param.key`."""

    variant: Variant
    value: dict[str, float]
    interval: dict[str, tuple[float, float]]
    case: Case
    table: ServoTable

    @property
    def force(self) -> str:
        """Unit of a torque on this joint; a slide has a force."""
        return "N" if self.case.scales.slide else "N.m"

    @property
    def length(self) -> str:
        """Unit of the joint's position."""
        return "m" if self.case.scales.slide else "rad"

    def entry(self, key: str, unit: str, add: float = 0.0, times: float = 1.0) -> dict[str, Any]:
        """Return a parameter as `diagnosis.json` has it, (x + add) * times."""
        value, low, high = ((x + add) * times for x in (self.value[key], *self.interval[key]))
        return entry(value, low, high, unit)


@dataclass(frozen=True)
class ByTorque:
    """What inverse dynamics say of one effect on one joint: its coefficient with a 90 % interval, the speed that its
    law has beside it (0: none), figures of the joint that were fitted with it, by `inverse_dynamics.NAMES`; units of
    a torque and of the joint's position."""

    value: float
    low: float
    high: float
    speed: float
    joint: dict[str, float]
    force: str
    length: str

    def entry(self, unit: str, times: float = 1.0, over: float = 1.0) -> dict[str, Any]:
        """Return the coefficient as `diagnosis.json` has it, times x / over."""
        return entry(times * self.value / over, times * self.low / over, times * self.high / over, unit)


def entry(value: float, low: float, high: float, unit: str) -> dict[str, Any]:
    """Return a number with its interval as `diagnosis.json` has it."""
    low, high = min(low, high), max(low, high)
    return {"value": float(value), "low": float(low), "high": float(high), "unit": unit}


def word(value: str) -> dict[str, Any]:
    """Return a parameter that is a word."""
    return {"value": value, "low": None, "high": None, "unit": ""}


def param(
    key: str, column: str | tuple[str, ...], mode: str, low: float, high: float, start: float = 0.0, unit: str = "1"
) -> Param:
    """Return a `Param` of one column or several."""
    columns = (column,) if isinstance(column, str) else tuple(column)
    return Param(key, columns, mode, float(low), float(high), float(start), unit)


class Effect:
    """An entry of the catalogue.

    id: as `diagnosis.json` has it; words: a phrase after "joint X ..."; shows: the regime in which it leaves its trace;
    experiment: what shows it best; classes: those of `catalogue.CLASSES` that it belongs to.
    """

    id: ClassVar[str]
    words: ClassVar[str]
    shows: ClassVar[str]
    experiment: ClassVar[str]
    classes: ClassVar[tuple[str, ...]] = ()
    motions: ClassVar[tuple[str, ...]] = ("steps", "chirp", "triangles")  # kinds of `recording.excitation` that show it
    model_columns: ClassVar[tuple[str, ...]] = ()  # columns of the plant that are fields of the model
    kinds: ClassVar[int] = 1  # variants that one short list may hold
    every_kind: ClassVar[bool] = False  # listed with one of its kinds, all are: the scan's slopes rank them badly
    fitted_anyway: ClassVar[dict[str, str]] = {}  # servo column that may be unknown -> the parameter that it is
    demo: ClassVar[dict[str, float]] = {}  # servo columns of a drive that hides it, for `demo=`
    misreads: ClassVar[bool] = False  # the encoder does not show where the joint is
    parts_motor: ClassVar[bool] = False  # the motor's speed is not what the loop reads
    rings: ClassVar[bool] = False  # may make a loop ring by itself
    leads: ClassVar[bool] = False  # acts ahead of the target, as a drive does whose commands are stamped late
    from_poses: ClassVar[bool] = False  # told from the pose and the motion of other joints
    also_sizes: ClassVar[tuple[str, ...]] = ()  # parameters by which it is there though its first size is nothing
    # its columns say nothing without one another: one that is unknown is taken as absent, and the effect looked for
    whole: ClassVar[bool] = False
    simulated: ClassVar[bool] = True  # the plant has a law of it
    effort_only: ClassVar[bool] = False  # in the reading of the effort alone, the motion is unaffected
    # what is left of it without its size, which is fitted anyway, is an effect too
    parts_stand: ClassVar[bool] = False
    couples: ClassVar[bool] = False  # another joint, `from_joint` of its parameters, has part in it
    alike_by_torque: ClassVar[tuple[str, ...]] = ()  # ids that logged torque does not tell apart, its own among them
    by_torque: ClassVar[str] = ""  # what `search.inverse_dynamics` calls it, where that has a column of it
    # whether that column names it; else it only keeps others from taking its trace for their own
    named_by_torque: ClassVar[bool] = True
    # columns of the plant that training has no like of, and is given others in the place of (`columns_beside`)
    approximated: ClassVar[tuple[str, ...]] = ()
    by_warmth: ClassVar[tuple[str, ...]] = ()  # columns with which training is given the recorded temperatures

    def variants(self, s: Scales) -> list[Variant]:
        """Return the ways in which it may be there on a joint of these scales; none where its motion cannot show it."""
        raise NotImplementedError

    def unseen(self, s: Scales) -> str:
        """Return why a joint's motion cannot show it; empty where it can."""
        return "" if self.variants(s) else "these recordings cannot show it"

    def without(self, s: Scales) -> dict[str, str]:
        """Return kinds of it that are left out on a joint that can show others, each with the reason."""
        return {}

    def signal(self, case: Case, values: dict[str, float], note: dict) -> np.ndarray:
        """Return [n] how strongly it acts at each measured sample: its own torque, or the signal that it changes."""
        return np.ones_like(case.regimes["speed"])

    def parameters(self, fit: FittedEffect) -> dict[str, Any]:
        """Return parameters by the keys of `diagnosis.json`, with 90 % intervals: those that are fitted."""
        slide = fit.case.scales.slide
        return {p.key: fit.entry(p.key, p.unit_on(slide)) for p in fit.variant.params}

    def torque_columns(self, own: Columns) -> dict[str, Callable[[Columns], np.ndarray]]:
        """Return what it adds to the torque per unit of its coefficient, as columns [m] of what inverse dynamics
        filtered; by `by_torque`, behind it in brackets what else its law was given. own: what is fitted."""
        return {}

    @property
    def shows_by_torque(self) -> str:
        """The regime of what logged torque names."""
        return self.shows

    def parameters_by_torque(self, found: ByTorque) -> dict[str, Any]:
        """Return the same where logged torque showed it and not the motion: for those of `search.inverse_dynamics`."""
        raise NotImplementedError

    def size_by_torque(self, found: ByTorque) -> str:
        """Return its size for the line about logged torque, with its unit; empty where the coefficient says it."""
        return ""

    def refused_by_torque(self, value: float, joint: dict[str, float], slowest: float) -> str | None:
        """Return why a coefficient of inverse dynamics cannot be what it is called; empty where that is passed over,
        None where it can. joint: as of `ByTorque`; slowest: the lowest cutoff [Hz] of what was filtered."""
        return None

    def columns_beside(self, variant: Variant, joints: Sequence[str], row: np.ndarray, case: Case) -> dict[str, float]:
        """Return servo columns that go with a kind of it beside its fitted ones: what that kind sets, of one that
        another joint has part in the number of that joint among the mechanism's, and what stands in the place of those
        `approximated`. row [C]: the plant's, as fitted."""
        out = {name: value for name, value in variant.fixed if name in SERVO_INDEX}
        if "coupling_from" in out:
            out["coupling_from"] = float(joints.index(variant.note["from_joint"]))
        return out

    def lacks(self, variant: Variant) -> tuple[str, str] | None:
        """Return of what training has no law as it was fitted, and what it is given in its place; None where it has
        all."""
        return None

    def said(self, finding: Finding, believed: dict[str, float]) -> str:
        """Return what it does, in words, with its direction where its size tells that. believed: columns of the joint,
        its model's friction included."""
        return self.words

    def impossible(self, values: dict[str, float], case: Case) -> str:
        """Say why it cannot be of this size; empty where it can."""
        return ""

    def doubts(self, case: Case, runs: Sequence[int]) -> list[str]:
        """Return reasons of its own to doubt it, from the recordings that were used."""
        return []

    def excludes(self, mine: Variant, other: Effect, theirs: Variant) -> bool:
        """Return whether it and another effect replace one another: both at once mean nothing."""
        return False

    def to_model(self, spec: mujoco.MjSpec, case: Case, values: dict[str, float], note: dict) -> list[str]:
        """Writes what is a field of the model into its spec; returns what was changed, in words."""
        return []


class TouchEffect:
    """An entry of the catalogue of touch.

    id, words, shows, experiment as of `Effect`; fits: parameters of `touch.plant.PARAMS`; starts: values of them
    to begin from; stage: `cell` where a load cell judges it alone, `taxels`, `shear`; report: parameter -> key in
    `diagnosis.json`; classes: those of `catalogue.TOUCH_CLASSES`.
    """

    id: ClassVar[str]
    words: ClassVar[str]
    shows: ClassVar[str]
    experiment: ClassVar[str]
    fits: ClassVar[tuple[str, ...]]
    starts: ClassVar[tuple[tuple[float, ...], ...]]
    stage: ClassVar[str] = "taxels"
    report: ClassVar[tuple[tuple[str, str], ...]] = ()
    classes: ClassVar[tuple[str, ...]] = ()
    simulated: ClassVar[bool] = True  # the plant has a law of it
    by_taxel: ClassVar[bool] = False  # may be another on each taxel
    rubber: ClassVar[tuple[str, ...]] = ()  # its figures of a rubber's law, which training has a linear contact for
    widens: ClassVar[bool] = False  # with a wider contact beside it one such follows much of the other: all are tried
    replaces: ClassVar[frozenset[str]] = frozenset()  # refitted figures that it takes the place of
    excludes: ClassVar[frozenset[str]] = frozenset()  # effects that it replaces: both at once mean nothing
    words_beside: ClassVar[dict[str, str]] = {}  # parameters that are words

    def possible(self, search: PadSearch) -> bool:
        """Return whether the recordings of a pad can show it."""
        return True

    def begin(self, search: PadSearch) -> list[dict[str, float]]:
        """Return values of its parameters to begin from."""
        return [dict(zip(self.fits, s, strict=True)) for s in self.starts]

    def in_place(self, values: dict[str, float], base: TouchTrial, current: TouchTrial) -> dict[str, float]:
        """Return where its fit begins in the place of a member of `current`; values: of its own trial so far; base:
        `current` without that member."""
        return values

    def changes(self, run: PadRun, t: TouchTrial, base: dict[str, float]) -> np.ndarray:
        """Return [S] by how much it changes the readings of a recording [N]; base: values at which nothing is there."""
        neutral = t.values | {k: base[k] for k in self.fits}
        if self.stage == "cell" and run.load is not None:
            return np.interp(run.t, run.grid, np.abs(contact(run, t.values)[0] - contact(run, neutral)[0]))
        return np.abs(readings(run, t.values, t.gains, t.order) - readings(run, neutral, t.gains, t.order)).max(1)

    def doubt(self, finding: Finding) -> str:
        """Return a reason of its own to doubt a finding; empty for none."""
        return ""

    def drift(self, finding: Finding, fact: PadFacts) -> Fit | None:
        """Return factor on all gains of the pad over the recordings; None where it is none."""
        return None

    def hand_on(self, finding: Finding, pad: PadSettings, doubt: bool) -> str:
        """Writes a finding into the settings of its pad; returns what of it is left out, in words.

        doubt: whether its ranges are to hold what was believed."""
        return ""
