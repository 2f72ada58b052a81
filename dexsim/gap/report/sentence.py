"""The verdict in words: what was found, where it sits, how large it is."""

from __future__ import annotations

import numpy as np

from dexsim.gap.effects.catalogue import entry, modelled
from dexsim.gap.effects.effect import Effect
from dexsim.gap.inquiry import Diagnosis
from dexsim.gap.report.charts import number
from dexsim.recording.mechanism import Mechanism


def sentence(data: dict, d: Diagnosis, floor: float | None) -> str:
    """The verdict in one or two sentences."""
    h = data["held_out"]
    metric = h["error"]
    effort, unit = metric.startswith("effort"), _unit(metric)
    if unit == "mN" and not effort:
        floor = data["noise_floor"].get("tactile_N")
    before, after = 1e3 * (h["before"] or 0), 1e3 * (h["after"] or 0)
    limit = f"the floor is {1e3 * floor:.2g}" if floor is not None and not effort else ""
    named = [f for f in data["findings"] if modelled(f) and not f.get("hint")]
    bad = [f for f in data["findings"] if f["effect"] == "bad_channel"]
    prefix = _first_of_all(data["findings"], bad, d)
    if data["verdict"] == "none":
        return (
            prefix
            + "Nothing in the catalogue is missing: the simulator follows recordings not used for the fit to "
              f"{before:.2g} {unit}; {limit}."
        )
    if data["verdict"] == "explained" and not named and bad:
        return (
            prefix
            + f"Beside that nothing is missing: the simulator follows recordings not used for the fit to {before:.2g} "
              f"{unit}; {limit}."
        )
    if not named:
        depends = (
            "; it depends on " + ", ".join(data["unexplained"]["depends_on"][:2])
            if data["unexplained"]["depends_on"]
            else ""
        )
        return (
            prefix
            + f"Something is missing that no effect of the catalogue explains: {number(before)} {unit} are left where "
              f"{limit}{depends}."
        )
    of = ""
    alone = {j for f in named for j in f["where"]["joints"]}
    # not thinned by joints that are well
    if len(alone) == 1 and len(d.joints) > 1 and metric.startswith("position") and alone <= set(d.joints):
        of, mine = " of that joint", d.joints[next(iter(alone))]
        before, after = 1e3 * mine["before"], 1e3 * mine["after"]
    said = prefix + _names(named, d)
    if h["before"] is None:
        return said
    it = "it" if len(named) == 1 else "them"
    tail = (
        f" Without {it} simulation{of} is wrong by {number(before)} {unit}; with {it}, by {number(after)} on "
        "recordings not used for the fit"
    )
    return said + tail + (f"; {limit}." if limit else ".")


def _unit(metric: str) -> str:
    """The thousandth in which an error is told, of `held_out.error`."""
    if metric.startswith("effort"):
        return "mN" if metric.endswith("_N") else "mN.m"
    if metric.startswith("tactile"):
        return "mN"
    return "mm" if metric.endswith("_m") else "mrad"


def _first_of_all(findings: list[dict], bad: list[dict], d: Diagnosis) -> str:
    """What comes before the verdict: signals that are not what they say (`bad`), and pushes from outside."""
    said = (
        f"{len(bad)} signal{'s are' * (len(bad) > 1) or ' is'} not what {'they say' if len(bad) > 1 else 'it says'} "
        f"({bad[0]['regime']}). "
        if bad
        else ""
    )
    for f in findings:
        if entry(f) is not None and not modelled(f):
            where = spoken(f, d.mechanism)
            said += f"{where[:1].upper() + where[1:]} {words_of(f, d.mechanism)}{_size(f)}. "
    return said


def _names(named: list[dict], d: Diagnosis) -> str:
    """The two largest effects, where they sit, and how many more there are."""
    parts = []
    for f in named[:2]:
        words = words_of(f, d.mechanism)
        others = " or ".join(x.replace("_", " ") for x in f["indistinguishable"] if x != f["effect"])
        doubt = f", or it is {others}: these recordings cannot tell" if others else ""
        parts.append(f"{spoken(f, d.mechanism)} {words}{_size(f)}{doubt}")
    first = named[0]["where"]["joints"]
    if not first or first[0] in spoken(named[0], d.mechanism)[1:]:
        parts[0] = parts[0][:1].upper() + parts[0][1:]
    left_out = len(named) - len(parts)
    more = f" ({left_out} more, below)" if left_out else ""
    return "; ".join(parts) + more + "."


ORDER = ("first", "second", "third", *(f"{n}th" for n in range(4, 40)))
FINGERS = {"thumb": "the thumb", "mid": "the middle finger", "pinky": "the little finger"}


def spoken(f: dict, m: Mechanism | None) -> str:
    """Where a finding sits as a person says it: a hand's joints by finger, another mechanism's by name."""
    if len(f["where"]["joints"]) != 1:
        return place(f, m)
    joint = f["where"]["joints"][0]
    hand = None if m is None else m.whose
    owner = hand.finger_of_joint[hand.joints.index(joint)] if hand is not None and joint in hand.joints else -1
    if hand is None or owner < 0:
        return joint if "joint" in joint.lower() else f"joint {joint}"
    finger, number_ = hand.fingers[owner], hand.joints.index(joint)
    bends = number_ in finger.flexion
    alike = finger.flexion if bends else tuple(j for j in finger.joints if j not in finger.flexion)
    order = ORDER[alike.index(number_)] if bends or len(alike) > 1 else ""
    kind = " ".join(w for w in (order, "" if bends else "sideways", "joint") if w)
    return f"{FINGERS.get(finger.name, f'the {finger.name} finger')}'s {kind} ({joint})"


def words_of(f: dict, m: Mechanism | None) -> str:
    """What an effect does, in words, with its direction where its size tells that."""
    joint, effect = next(iter(f["where"]["joints"]), None), entry(f)
    assert effect is not None  # what has words is of the catalogue
    if joint is None or not isinstance(effect, Effect):
        return effect.words
    believed = {}
    if m is not None and joint in m.joints:
        row = m.joints.index(joint)
        friction = float(np.ravel(m.spec.joint(joint).frictionloss)[0])
        believed = {"coulomb_friction": float(m.column("coulomb_friction")[row]) + friction}
    return effect.said(f, believed)


def place(f: dict, m: Mechanism | None) -> str:
    """Where a finding sits, in words."""
    if f["where"]["joints"]:
        return ", ".join(f["where"]["joints"])
    if f["where"]["taxels"] and m is not None:
        pads = sorted({int(t.split(":")[0]) for t in f["where"]["taxels"]})
        count = len(f["where"]["taxels"])
        fingers = " and ".join(m.sensors.names[p] for p in pads)
        return (
            f"the {fingers}'s pad"
            if count > 12 or "taxels" not in f["parameters"]
            else f"the {fingers}'s pad (taxel{'s' * (count > 1)} "
                 f"{', '.join(t.split(':')[1] for t in f['where']['taxels'])})"
        )
    return ", ".join(f["where"]["topics"])


def _size(f: dict) -> str:
    """The first parameter of a finding in words: degrees and millimetres where a person thinks in them."""
    name, p = next(iter(f["parameters"].items()), (None, None))
    if name is None or p is None or p["value"] is None or isinstance(p["value"], str):
        return ""
    number = np.atleast_1d(p["value"])  # com and tilt are vectors, gains one a taxel
    if len(number) > 4:
        return f" ({name} {number.min():.2g} to {number.max():.2g})"
    if p["unit"] == "rad" and len(number) == 1:
        return f" ({name} {np.degrees(number[0]):.3g} degrees)"
    if p["unit"] == "s" and len(number) == 1:
        return f" ({name.replace('_', ' ')} {1e3 * number[0]:.3g} ms)"
    return (
        f" ({name.replace('_', ' ')} "
        f"{' '.join(f'{v:.3g}' for v in number)}{' ' + p['unit'] if p['unit'] not in ('1', '') else ''})"
    )
