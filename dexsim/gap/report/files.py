"""A diagnosis as files: diagnosis.json, details.json, servo.yaml and the rest, and report.html by its sections."""

from __future__ import annotations

import copy
import html
import json
import traceback
from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar

import mujoco
import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from dexsim import outputs
from dexsim.console.tables import number
from dexsim.gap.effects import Effect
from dexsim.gap.effects.catalogue import entry
from dexsim.gap.finding import Finding, gathered
from dexsim.gap.inquiry import Diagnosis
from dexsim.gap.judge.conclude import place, spoken, unit_of, words_of
from dexsim.gap.judge.confidence import kept_of
from dexsim.gap.judge.full_model import ORDER
from dexsim.gap.judge.handed_on import MODEL_FILES, save_model
from dexsim.gap.report import charts
from dexsim.gap.report.charts import mechanism, pad, scale
from dexsim.gap.search import baseline
from dexsim.gap.touch.diagnosis import handed, save_tactile

MAYBE = ("servo.yaml", "tactile.yaml", "model.xml", "evidence.json")
"""Files of a diagnosis that are written where there is something in them."""


def save(d: Diagnosis, out: Path) -> list[Path]:
    """Writes diagnosis.json, details.json, report.html, servo.yaml and, where there is something in them, model.xml and
    tactile.yaml, all of them or none; returns what was written. Of MAYBE, what only an earlier diagnosis wrote there
    goes. Raises UserError where one would go over a file that is not ours."""
    d.notes = grouped(d.notes)
    names = []
    with outputs.staged(out, instead=MAYBE) as stage:
        if d.servo is not None:
            d.servo.save(stage / "servo.yaml")
            names.append("servo.yaml")
        if d.touch is not None and save_tactile(
            handed(d.touch.findings, d.touch.facts, d.touch.names), stage / "tactile.yaml"
        ):
            names.append("tactile.yaml")
        if d.model_spec is not None:
            try:
                d.model_spec.compile()
                save_model(d.model_spec, stage / "model.xml")
                names.append("model.xml")
            except (ValueError, mujoco.FatalError) as error:
                d.notes.append(f"model.xml could not be written: {error}")
        asked, more = specified(d.data)
        more |= {"notes": d.notes, "seconds": d.shares}
        data = {"diagnosis.json": asked, "details.json": more} | (
            {"evidence.json": [e.plain() for e in d.evidence]} if d.evidence else {}
        )
        for name, value in data.items():
            (stage / name).write_text(json.dumps(plain(value), indent=1, allow_nan=False), encoding="utf-8")
        (stage / "report.html").write_text(_page(d), encoding="utf-8")
        names = [*data, *names]
    if (d.data["next_recording"] or {}).get("commands"):
        names.append(d.data["next_recording"]["commands"])
    return [out / name for name in (*names, "report.html")]


def _page(d: Diagnosis) -> str:
    """Return the page. It is drawn from an answer that may have taken an hour: a fault in the drawing must not lose
    that."""
    try:
        return page(d)
    except Exception:
        print("report.html could not be drawn and holds the reason (please report it); the answer is in diagnosis.json")
        return f"<!doctype html><title>no report</title><pre>{html.escape(traceback.format_exc())}</pre>\n"


RESULTS = (
    "diagnosis.json",
    "details.json",
    "evidence.json",
    "servo.yaml",
    "tactile.yaml",
    "model.xml",
    MODEL_FILES,
    "next_recording.mcap",
    "report.html",
)
"""Everything that `save` and the plan of the next recording may write."""
BEYOND = (("reason",), ("noise_floor", "recordings"), ("held_out", "how"), ("unexplained", "not_considered"))


def specified(data: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return (what diagnosis.json holds, and nothing else: programs rely on its keys; what is known beyond that, for
    details.json)."""
    asked = copy.deepcopy(data)
    more: dict[str, Any] = {}
    for *parents, key in BEYOND:
        there = asked[parents[0]] if parents else asked
        if key in there:
            (more.setdefault(parents[0], {}) if parents else more)[key] = there.pop(key)
    return asked, more


def grouped(notes: Sequence[str]) -> list[str]:
    """Notes that several recordings share, said once: "a.mcap, b.mcap: ..." with at most three names."""
    out: dict[str, list[str]] = {}
    for note in notes:
        name, colon, text = note.partition(": ")
        if colon and name.endswith((".mcap", ".bag", ".csv", ".tsv", ".npz")) and " " not in name:
            out.setdefault(text, []).append(name)
        else:
            out.setdefault(note, [])
    join = lambda names: ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")  # noqa: E731
    return [f"{join(list(dict.fromkeys(names)))}: {text}" if names else text for text, names in out.items()]


def plain(x: Any) -> Any:
    if isinstance(x, dict):
        return {str(k): plain(v) for k, v in x.items()}
    if isinstance(x, (list, tuple)):
        return [plain(v) for v in x]
    if isinstance(x, (np.floating, float)):
        return float(x) if np.isfinite(x) else None
    if isinstance(x, np.integer):
        return int(x)
    return x


# -- report.html ------------------------------------------------------------------------------------------------------
# report.html: one page that stands alone, read in a minute. Its figures are inline SVG: no script, no network, no font.
#
# A class and a template each section: the class says what is shown, as plain values and charts, the template
# (`templates/`) how it looks.

VERDICTS = {
    "explained": ("Explained", "good"), "partly_explained": ("Partly explained", "warn"), "unknown": ("Unknown", "bad"),
    "none": ("Nothing missing", "good"), "unusable": ("Cannot be judged", "bad"),
}  # fmt: skip
FLOORS = {
    "repeats": "repeats of the same commands",
    "split": "the scatter of single samples",
    "quantum": "the encoder's step",
}
MOST = 6  # joints beside the picture; the rest is in the details
ENVIRONMENT = Environment(
    loader=PackageLoader("dexsim.gap.report"),
    autoescape=True,
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)


class Section(ABC):
    """A section of the page."""

    template: ClassVar[str]

    def __init__(self, d: Diagnosis):
        self.d = d
        self.held_out = d.data["held_out"]
        self.unit = "mm" if self.held_out["error"].endswith("_m") else "mrad"  # of positions

    @abstractmethod
    def values(self) -> dict[str, Any] | None:
        """Return what its template is given; None where it is not shown."""


class Hero(Section):
    """The verdict and its sentence."""

    template = "hero.html"

    def values(self) -> dict[str, Any]:
        d, h = self.d, self.held_out
        word, tone = VERDICTS[d.data["verdict"]]
        kept = h.get("how") or ", ".join(h["recordings"])
        return {"word": word, "tone": tone, "said": d.sentence, "judged": h["before"] is not None, "kept": kept}


class Where(Section):
    """The mechanism coloured by its error, the error before and after, the joints and pads with the largest."""

    template = "where.html"

    def values(self) -> dict[str, Any] | None:
        d = self.d
        if d.mechanism is None or not (d.joints or d.touch is not None):
            return None
        named = {j for f in d.findings for j in f.joints}
        marked = {t for f in d.findings if "taxels" in f.parameters for t in f.taxels if len(f.taxels) <= 40}
        taxels = d.touch.error if d.touch is not None else None
        before = {j: v["before"] for j, v in d.joints.items()}
        height = 400 if d.joints else 240
        m, words = d.mechanism, []
        picture = mechanism(m.spec.compile(), m.sensors, before, named, taxels, marked, self.unit, height=height)
        if d.joints:
            words.append("Joints by their error before; ringed where something was found.")
            picture += scale(max(before.values()), self.unit)
        if taxels is not None:
            words.append(
                "The lattices are the pads' taxels, tip above, coloured by their error before; ringed where they are "
                "named."
            )
        several = len(d.joints) + (len(d.touch.pads) if d.touch else 0) > 1
        spots = (
            _ratios(d, ((4, "position"), (2, "effort")), len(d.joints) > 1, 560, 250)
            if len(d.joints) <= 2 and d.spots
            else None
        )
        return {
            "picture": Markup(picture),
            "pads": None if taxels is None else self._pads(taxels, marked),
            "words": " ".join(words),
            "joints": len(d.joints) if unit_of(self.held_out["error"]) in ("mrad", "mm") else 0,
            "bars": self._bars(),
            "rows": _rows(d, self.unit, MOST) if several else [],
            "more": max(len(d.joints) - MOST, 0),
            "spots": spots,
        }

    def _pads(self, taxels: np.ndarray, marked: set[str]) -> list[dict[str, Any]]:
        out: list[dict[str, Any]] = []
        felt, m = self.d.touch, self.d.mechanism
        if felt is None or m is None:
            return out
        for name in list(felt.pads)[:3]:
            number_ = felt.names.index(name)
            ringed = {int(t.split(":")[1]) for t in marked if int(t.split(":")[0]) == number_}
            lattice = m.sensors.lattice(number_)
            out.append({"name": name, "map": Markup(pad(taxels[number_], ringed, lattice))})
        return out

    def _bars(self) -> dict[str, Any] | None:
        """Return the error before and after beside the noise floor."""
        d, h = self.d, self.held_out
        if h["before"] is None:
            return None
        unit, k = unit_of(h["error"]), 1e3

        def row(name: str, which: str, colour: str) -> tuple[str, float, float | None, float | None, str]:
            low, high = (None if (v := h[f"{which}_{end}"]) is None else k * v for end in ("low", "high"))
            return name, k * h[which], low, high, colour

        rows = [row("before", "before", charts.BEFORE)]
        replayed = h.get("replayed") if h["error"].startswith("position") else None
        if any(not f.wrong_signal for f in d.findings):
            rows.append(row("after, search's plant" if replayed else "after", "after", charts.AFTER))
        if replayed:
            rows.insert(1, ("as written, replayed", k * replayed["error"], None, None, charts.AFTER))
        plain = d.data["baseline"] if h["error"].startswith("position") else {}
        if plain:
            rows.append(("plain model", k * plain["error"], None, None, charts.FLOOR))
        floor, touched = d.data["noise_floor"], h["error"].startswith("tactile")
        value = floor.get("tactile_N") if touched else floor["position_rad"] if unit in ("mrad", "mm") else None
        if value is not None:
            rows.append(("noise floor", k * value, None, None, charts.FLOOR))
        how = "the counts of the taxels" if touched else FLOORS[floor["how"]]
        return {"chart": Markup(charts.bars(rows, unit)), "plain": baseline.text(plain, unit), "floor": how}


class Findings(Section):
    """What is missing, a card each, and the hints; or what came nearest."""

    template = "findings.html"

    def values(self) -> dict[str, Any] | None:
        cards = [(f.hint, self._card(f)) for f in gathered(self.d.findings)]
        sure, hints = ([card for hint, card in cards if hint is kind] for kind in (False, True))
        nearest = [] if sure else self._nearest()
        return {"sure": sure, "hints": hints, "nearest": nearest} if sure or hints or nearest else None

    def _card(self, f: Finding) -> dict[str, Any]:
        """Return one finding."""
        e, h = entry(f), f.held_out
        where = place(f, self.d.mechanism) if len(f.joints) < 4 else f"{len(f.joints)} joints"
        unit = unit_of(self._metric(f)) if h else ""
        doubtful = f.indistinguishable or f.hint
        return {
            "kind": "bad" if f.wrong_signal else "set" if doubtful else "",
            "name": _name(f.effect),
            "where": where,
            "confidence": f"{100 * f.confidence:.0f}",
            "words": f"{_capital(spoken(f, self.d.mechanism))} {words_of(f, self.d.mechanism)}; it shows {f.regime}."
            if e is not None
            else f"{where}: {f.regime}.",
            "parameters": [_parameter(key, p) for key, p in f.parameters.items() if p["value"] is not None],
            "strip": self._strip(f),
            "before": number(1e3 * h["before"]) if h else "",
            "after": number(1e3 * h["after"]) if h else "",
            "unit": unit,
            "why": self._why(f),
        } | self._lost(f)

    def _why(self, f: Finding) -> str:
        """Return the hypotheses with their shares of the redraws, and what else makes the confidence; empty where it
        was not searched."""
        e = next((e for e in self.d.evidence if e.effect == f.effect and e.joint in f.joints), None)
        if e is None or not f.held_out:
            return ""
        row = {f.effect: e.share} | {a["effect"]: a["confidence"] for a in f.alternatives}
        wins = ", ".join(f"{_name(n)} wins {100 * x:.0f} %" for n, x in row.items())
        kept = kept_of(e.left) * (kept_of(e.left_of_rest) if e.members > 1 else 1.0)
        return (
            f"Why {100 * f.confidence:.0f} %: of the redraws {wins}; times {e.earned:.2f} for the error that it "
            f"removes, {kept:.2f} for what stays, {e.odds:.2f} for its odds among all that was tried"
            f"{'; less for doubts, in the notes' * bool(e.reasons)}."
        )

    def _metric(self, f: Finding) -> str:
        """Return the metric of a finding's held-out error."""
        if not f.joints:
            return "tactile_rmse_N"
        if isinstance(e := entry(f), Effect) and e.effort_only:
            return "effort_rmse_Nm"
        h = self.held_out["error"]
        return h if not h.startswith("tactile") else "position_rmse_rad"

    def _strip(self, f: Finding) -> Markup | None:
        """Return when it acts, a line for each of the first recordings."""
        rows = []
        for name in list(dict.fromkeys(w["recording"] for w in f.when))[:4]:
            spans = [(w["start"], w["end"]) for w in f.when if w["recording"] == name]
            every = [w["end"] for g in self.d.findings for w in g.when if w["recording"] == name]
            rows.append((name, max(self.d.lengths.get(name, 0.0), *every), spans))
        return Markup(charts.strips(rows)) if rows else None

    def _lost(self, f: Finding) -> dict[str, Any]:
        """Return the set that cannot be told apart, or what would do as well in its place."""
        alike, rival = " and ".join(_name(x) for x in f.indistinguishable), next(iter(f.alternatives), None)
        better = rival if rival and f.held_out and not alike and rival["confidence"] > f.confidence else None
        return {"set": alike, "separating": f.separating_experiment, "open": _name(better["effect"]) if better else ""}

    def _nearest(self) -> list[dict[str, str]]:
        """Return the effects that a search priced highest and did not find."""
        scanned = sorted(((o.joint, *x) for o in self.d.outcomes for x in o.scanned), key=lambda r: -r[2])[:5]
        return [
            {"joint": j, "effect": _name(e), "gain": f"{100 * gain:.1f}", "chance": f"{p:.2f}"}
            for j, e, gain, p in scanned
        ]


class Curves(Section):
    """Measured beside simulated, where the error before is largest."""

    template = "curves.html"

    def values(self) -> dict[str, Any] | None:
        d = self.d
        found = {j for f in d.findings for j in f.joints}
        order = sorted(d.curves, key=lambda c: (c.joint not in found, -d.joints[c.joint]["before"]))
        felt = d.touch.curves[:3] if d.touch is not None else []
        joints, pads = (
            [self._joint(c, c.joint in found) for c in order[: max(1, min(3, len(found)))]],
            [self._pad(c) for c in felt],
        )
        if not joints and not pads:
            return None
        grey = "command" if joints else "load cell" if any(c.load is not None for c in felt) else ""
        return {"joints": joints, "pads": pads, "grey": grey, "unit": self.unit}

    def _joint(self, c: Any, found: bool) -> dict[str, Any]:
        d = self.d
        mine = [f for f in d.findings if c.joint in f.joints]
        spans = [(w["start"], w["end"]) for f in mine for w in f.when if w["recording"] == c.recording]
        svg = charts.curves(c.t, c.measured, c.before, c.after if found else None, c.command, self.unit[1:], spans)
        before, after = (f"{1e3 * d.joints[c.joint][k]:.3g}" for k in ("before", "after"))
        return {"chart": Markup(svg), "name": c.joint, "recording": c.recording, "before": before, "after": after}

    def _pad(self, c: Any) -> dict[str, Any]:
        after = c.after if np.abs(c.after - c.before).max() > 1e-9 else None
        svg = charts.curves(c.t, c.measured, c.before, after, c.load, "N")
        return {"chart": Markup(svg), "name": c.pad, "recording": c.recording, "load": c.load is not None}


class Next(Section):
    """What to record next."""

    template = "next.html"

    def values(self) -> dict[str, Any] | None:
        data, n = self.d.data, self.d.data["next_recording"]
        if n:
            return {"why": n["why"][:1].upper() + n["why"][1:], "commands": n["commands"]}
        sure = data["verdict"] in ("explained", "none") and not any(f.indistinguishable for f in self.d.findings)
        return {"why": "", "commands": ""} if sure else None


class Details(Section):
    """Notes, and what a second minute is for, folded away."""

    template = "details.html"

    def values(self) -> dict[str, Any] | None:
        d = self.d
        total = sum(d.shares.values())
        out = {
            "notes": list(dict.fromkeys(self._notes())),
            "rows": _rows(d, self.unit) if len(d.joints) > 6 else [],
            "spots": _ratios(d, ((10, "position"), (10, "effort"))) if d.spots else None,
            "stages": d.stages,
            "absent": [(_name(e), why) for e, why in d.data["unexplained"].get("not_considered", {}).items()],
            "written": self._written() if d.written is not None else None,
            "nuisance": ", ".join(f"{k} {v:.4g}" for k, v in d.data["nuisance"].items()),
            "took": f"Took {total:.0f} s: {', '.join(f'{k} {v:.1f} s' for k, v in d.shares.items())}." if total else "",
        }
        return out | {"unit": self.unit} if any(out.values()) else None

    def _notes(self) -> list[str]:
        d, left, notes = self.d, self.d.data["unexplained"], list(self.d.notes)
        if d.untrained:
            notes.append(
                "fitted, but not a column of the servo table, so training does not carry it: " + ", ".join(d.untrained)
            )
        if left["depends_on"]:
            notes.insert(
                0,
                f"{100 * (left['fraction_of_gap'] or 0):.0f} % of the gap is left; it depends on "
                + "; ".join(left["depends_on"]),
            )
        return notes

    def _written(self) -> dict[str, Any]:
        """Return of each joint what its candidates leave, which is written and what that leaves as written."""
        w = self.d.written
        assert w is not None  # as looked at by who asks
        r, columns = w.replayed, [name for name in ORDER if any(name in x for x in w.errors.values())]
        return {
            "by": "in the engine that trains" if w.by_replay else "in the search's own plant",
            "parts": "" if r is None else ", ".join(f"{n} {a:.3g} to {b:.3g} s" for n, a, b in r.parts),
            "engine": "" if r is None else f"{r.engine}, {1e3 * r.step_s:g} ms a step",
            "columns": columns,
            "rows": [
                {
                    "joint": joint,
                    "errors": [number(1e3 * mine[c]) if c in mine else "" for c in columns],
                    "chosen": w.chosen[joint],
                    "plant": number(1e3 * w.candidate(joint).plant),
                    "replayed": "" if r is None else number(1e3 * r.joints[joint]),
                }
                for joint, mine in w.errors.items()
            ],
        }


SECTIONS: tuple[type[Section], ...] = (Hero, Where, Findings, Curves, Next, Details)


def page(d: Diagnosis) -> str:
    """Return the page as HTML text."""
    shown = [text for section in SECTIONS if (text := render(section(d)))]
    return ENVIRONMENT.get_template("page.html").render(word=VERDICTS[d.data["verdict"]][0], sections=shown)


def render(section: Section) -> Markup:
    """Return a section as HTML; empty where it has nothing to show."""
    values = section.values()
    return Markup("") if values is None else Markup(ENVIRONMENT.get_template(section.template).render(values).strip())


def _name(effect: str) -> str:
    return effect.replace("_", " ")


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:] if text.startswith(("the ", "joint ")) else text


def _ratios(d: Diagnosis, most: tuple[tuple[int, str], ...], named: bool = True, *size: int) -> Markup:
    """Return the regimes in which the error before is largest, the strongest bin of each; so many of each signal.
    named: with their joint."""
    best: dict[tuple[str, str, str], Any] = {}
    for s in d.spots:
        best.setdefault((s.joint, s.of, s.regime), s)
    chosen = [s for count, of in most for s in [x for x in best.values() if x.of == of][:count]]
    return Markup(
        charts.ratios(
            [(f"{s.joint}: {s.text}" if named else s.text, s.ratio, s.ratio_low, s.ratio_high) for s in chosen], *size
        )
    )


def _rows(d: Diagnosis, unit: str, most: int | None = None) -> list[dict[str, str]]:
    """Return the joints with the largest errors, and the pads."""
    plain, found, rows = d.data["baseline"].get("joints", {}), d.findings, []
    for j, v in sorted(d.joints.items(), key=lambda x: -x[1]["before"])[:most]:
        names = [_name(f.effect) + " (hint)" * f.hint for f in found if j in f.joints]
        rows.append(
            _row(j, names, v, number(1e3 * plain[j]["error"]) if j in plain else "", f"{1e3 * v['sigma']:.2g} {unit}")
        )
    if d.touch is not None:
        for finger, v in d.touch.pads.items():
            mine = f"{d.touch.names.index(finger)}:"
            names = [_name(f.effect) for f in found if any(t.startswith(mine) for t in f.taxels)]
            rows.append(_row(f"pad of the {finger}", names, v, "", f"{1e3 * v['noise']:.2g} mN"))
    return rows


def _row(where: str, names: list[str], v: dict[str, float], plain: str, noise: str) -> dict[str, str]:
    before, after = (number(1e3 * v[k]) for k in ("before", "after"))
    return {"where": where, "found": ", ".join(names), "before": before, "after": after, "plain": plain, "noise": noise}


def _parameter(key: str, p: dict[str, Any]) -> dict[str, Any]:
    """Return a row of a finding's parameters: a number with its interval, a list, or words."""
    value, out = (
        p["value"],
        {"label": key.replace("_", " "), "unit": "" if p["unit"] == "1" else p["unit"], "chart": None},
    )
    if isinstance(value, list):
        return out | {"text": ", ".join(f"{v:.3g}" for v in value[:8]) + (" ..." if len(value) > 8 else "")}
    if isinstance(value, str):
        return out | {"text": value if len(value) < 60 else value[:57] + "...", "unit": ""}
    low, high = number(p["low"]), number(p["high"])
    return out | {
        "text": number(value, 4),
        "low": low,
        "high": high,
        "chart": Markup(charts.interval(value, p["low"], p["high"])),
    }
