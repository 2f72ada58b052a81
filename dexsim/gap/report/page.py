"""report.html: one page that stands alone, read in a minute. Its figures are inline SVG: no script, no network, no font."""

from __future__ import annotations

import html
from typing import TYPE_CHECKING, Any

import numpy as np

from dexsim.gap.effects.catalogue import entry
from dexsim.gap.judge.full_model import TASKS
from dexsim.gap.report import charts
from dexsim.gap.report.picture import mechanism, pad, scale
from dexsim.gap.search import baseline

if TYPE_CHECKING:
    from dexsim.gap.result import Diagnosis

VERDICTS = {
    "explained": ("Explained", "good"), "partly_explained": ("Partly explained", "warn"), "unknown": ("Unknown", "bad"),
    "none": ("Nothing missing", "good"), "unusable": ("Cannot be judged", "bad"),
}  # fmt: skip
STYLE = """
:root{--ink:#1c2430;--soft:#5d6b7c;--line:#e1e5ea;--bg:#f3f4f6;--card:#fff;--good:#1a7f52;--warn:#a86200;--bad:#b3261e;--before:#d1495b;--after:#1768ac}
*{box-sizing:border-box}body{margin:0;background:var(--bg);color:var(--ink);font:15px/1.5 system-ui,-apple-system,"Segoe UI",Roboto,"DejaVu Sans",sans-serif}
main{max-width:1080px;margin:0 auto;padding:26px 20px 60px}h1{font-size:24px;line-height:1.36;margin:12px 0 6px;font-weight:650;letter-spacing:-.005em}
h2{font-size:16px;margin:0 0 12px;font-weight:650}h3{font-size:17px;margin:0;font-weight:650}
section{background:var(--card);border:1px solid var(--line);border-radius:12px;padding:18px 22px;margin:14px 0}
section.hero{border-top:5px solid var(--tone);padding-top:20px}.tag{display:inline-block;padding:3px 12px;border-radius:99px;color:#fff;font-weight:600;font-size:13px;background:var(--tone)}
.t-good{--tone:var(--good)}.t-warn{--tone:var(--warn)}.t-bad{--tone:var(--bad)}.soft{color:var(--soft)}.small{font-size:13px}
.two{display:grid;grid-template-columns:370px 1fr;gap:26px}.half{display:grid;grid-template-columns:1fr 1fr;gap:26px}
@media(max-width:820px){.two,.half{grid-template-columns:1fr}}
.finding{border:1px solid var(--line);border-radius:10px;padding:14px 18px;margin:0 0 12px;border-left:5px solid var(--after)}.finding.bad{border-left-color:var(--bad)}.finding.set{border-left-color:var(--warn)}
.finding header{display:flex;justify-content:space-between;gap:14px;align-items:baseline;flex-wrap:wrap}.finding p{margin:6px 0}
.pads{display:flex;gap:16px;flex-wrap:wrap;margin-top:10px}.pads figure{margin:0}.conf{font-size:13px;color:var(--soft);white-space:nowrap}.conf b{color:var(--ink);font-size:15px}
table{border-collapse:collapse;width:100%;font-size:14px}th{text-align:left;color:var(--soft);font-weight:500;border-bottom:1px solid var(--line);padding:4px 8px 4px 0}
td{border-bottom:1px solid #eef0f3;padding:5px 8px 5px 0;vertical-align:middle}tr:last-child td{border-bottom:0}td.n,th.n{text-align:right;font-variant-numeric:tabular-nums}
td.n:last-child,th.n:last-child{padding-right:0}
svg{max-width:100%;height:auto;display:block;font-family:inherit}svg.iv{display:inline-block;vertical-align:middle}figure{margin:0 0 18px}figure:last-child{margin-bottom:0}figcaption{color:var(--soft);font-size:13px;margin-top:4px}
code{background:#eef1f4;padding:1px 6px;border-radius:4px;font-size:13px}.key{display:inline-block;width:20px;height:4px;border-radius:2px;vertical-align:middle;margin:0 6px 0 14px}.key:first-child{margin-left:0}
section.next{background:#eef5fb;border-color:#cfe0ef}details{margin:4px 0}details summary{cursor:pointer;font-weight:600;font-size:14px;padding:4px 0}ul{margin:6px 0;padding-left:20px}li{margin:3px 0}
"""


def page(d: Diagnosis) -> str:
    """The page as HTML text."""
    word, tone = VERDICTS[d.data["verdict"]]
    parts = [_hero(d, word, tone)]
    if d.mechanism is not None and (d.joints or d.touch is not None):
        parts.append(_where(d))
    parts += [_findings(d), _curves(d), _next(d), _details(d)]
    body = "\n".join(p for p in parts if p)
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"/><meta name="viewport" content="width=device-width, initial-scale=1"/>'
        f"<title>Diagnosis: {_t(word)}</title><style>{STYLE}</style></head>\n<body><main>\n{body}\n</main></body></html>\n"
    )


def _t(x: Any) -> str:
    return html.escape(str(x))


def _name(effect: str) -> str:
    return effect.replace("_", " ")


def unit_of(metric: str) -> tuple[str, float]:
    """(unit in which a metric of `diagnosis.json` is shown, factor)."""
    if metric.startswith("effort"):
        return ("mA" if metric.endswith("_A") else "mN" if metric.endswith("_N") else "mN.m"), 1e3
    if metric.endswith("_N"):
        return "mN", 1e3
    return ("mm" if metric.endswith("_m") else "mrad"), 1e3


def _hero(d: Diagnosis, word: str, tone: str) -> str:
    h = d.data["held_out"]
    kept = _t(h.get("how") or ", ".join(h["recordings"]))
    line = ""
    if h["before"] is not None:
        line = f'<p class="soft small">Simulated freely from the first sample of what was kept out of the fit: {kept}.</p>'
    said, replayed = d.sentence, ""
    if d.confirmation is not None:
        text = d.confirmation.text(unit_of(h["error"])[0])
        if said.endswith(text):
            said, replayed = said[: -len(text)].rstrip(), f"<p>{_t(text)}</p>"
    return f'<section class="hero t-{tone}"><span class="tag">{word}</span><h1>{_t(said)}</h1>{replayed}{line}</section>'


def _bars(d: Diagnosis) -> str:
    h = d.data["held_out"]
    if h["before"] is None:
        return ""
    unit, k = unit_of(h["error"])
    scaled = lambda *x: tuple(None if v is None else k * v for v in x)  # noqa: E731
    found = any(f["effect"] != "bad_channel" for f in d.data["findings"])
    rows = [("before", *scaled(h["before"], h["before_low"], h["before_high"]), charts.BEFORE)]
    if found:
        rows.append(("after", *scaled(h["after"], h["after_low"], h["after_high"]), charts.AFTER))
    plain = d.data["baseline"]
    if plain and h["error"].startswith("position"):
        rows.append(("plain model", k * plain["error"], None, None, charts.FLOOR))
    floor = d.data["noise_floor"]
    touched = h["error"].startswith("tactile")
    value = floor.get("tactile_N") if touched else floor["position_rad"] if unit in ("mrad", "mm") else None
    if value is not None:
        rows.append(("noise floor", k * value, None, None, charts.FLOOR))
    how = {"repeats": "repeats of the same commands", "split": "the scatter of single samples", "quantum": "the encoder's step"}[floor["how"]]
    note = "the counts of the taxels" if touched else how
    said = f" Plain model: {_t(baseline.text(plain, unit))}." if plain and h["error"].startswith("position") else ""
    over = f", all {len(d.joints)} joints" if len(d.joints) > 1 and unit in ("mrad", "mm") else ""
    return (f'<h2>Error on held-out data{over}</h2>{charts.bars(rows, unit)}<p class="soft small">Root mean square, 90 % intervals. Before: the machine as it is believed, its '
            f"figures refitted within 5 %.{said} Floor: from {note}.</p>")  # fmt: skip


def _where(d: Diagnosis) -> str:
    named = {j for f in d.data["findings"] for j in f["where"]["joints"]}
    marked = {t for f in d.data["findings"] if "taxels" in f["parameters"] for t in f["where"]["taxels"]
              if len(f["where"]["taxels"]) <= 40}
    taxels = d.touch.error if d.touch is not None else None
    unit = "mm" if d.data["held_out"]["error"].endswith("_m") else "mrad"
    picture = mechanism(d.mechanism.spec.compile(), {j: v["before"] for j, v in d.joints.items()}, named, taxels, marked, unit, height=400 if d.joints else 240)
    words = []
    if d.joints:
        words.append("Joints by their error before; ringed where something was found.")
        picture += scale(max(v["before"] for v in d.joints.values()), unit)
    maps = ""
    if taxels is not None:
        from dexsim.assets import xhand

        shown = "".join(f'<figure>{pad(taxels[xhand.FINGERS.index(p)], {int(t.split(":")[1]) for t in marked if int(t.split(":")[0]) == xhand.FINGERS.index(p)})}'
                        f"<figcaption>{_t(p)}</figcaption></figure>" for p in list(d.touch.pads)[:3])  # fmt: skip
        maps = f'<div class="pads">{shown}</div>'
        words.append("The lattices are the pads' taxels, tip above, coloured by their error before; ringed where they are named.")
    return (f'<section><div class="two"><figure>{picture}{maps}<figcaption>{" ".join(words)}</figcaption></figure><div>{_bars(d)}{_table(d, unit)}{_spots(d)}</div></div></section>')


def _spots(d: Diagnosis) -> str:
    """Where the error before lives, beside the picture where there is room for it."""
    if len(d.joints) > 2 or not d.spots:
        return ""
    rows = [(s.text if len(d.joints) == 1 else f"{s.joint}: {s.text}", s.ratio, s.ratio_low, s.ratio_high) for of, most in (("position", 4), ("effort", 2)) for s in [x for x in _best(d) if x.of == of][:most]]
    return f'<h2>Where the error before lives</h2>{charts.ratios(rows, 560, 250)}<p class="soft small">Error inside over error outside, 90 % intervals.</p>'


def _best(d: Diagnosis) -> list[Any]:
    best: dict[tuple[str, str, str], Any] = {}
    for s in d.spots:
        best.setdefault((s.joint, s.of, s.regime), s)
    return list(best.values())


def _table(d: Diagnosis, unit: str) -> str:
    """The joints and pads with the largest errors; the rest is in the details."""
    if len(d.joints) + (len(d.touch.pads) if d.touch else 0) < 2:
        return ""
    return _rows(d, unit, 6)


def _rows(d: Diagnosis, unit: str, most: int | None = None) -> str:
    rows, plain = [], d.data["baseline"].get("joints", {})
    order = sorted(d.joints.items(), key=lambda x: -x[1]["before"])
    for j, v in order[:most]:
        effects = ", ".join(_name(f["effect"]) + " (hint)" * f.get("hint", False) for f in d.data["findings"] if j in f["where"]["joints"]) or "&#8211;"
        rows.append(f'<tr><td>{_t(j)}</td><td>{effects}</td><td class="n">{charts.number(1e3 * v["before"])}</td><td class="n">{charts.number(1e3 * v["after"])}</td>'
                    f'<td class="n">{charts.number(1e3 * plain[j]["error"]) if j in plain else ""}</td><td class="n">{1e3 * v["sigma"]:.2g} {unit}</td></tr>')  # fmt: skip
    from dexsim.assets import xhand

    for finger, v in (d.touch.pads if d.touch else {}).items():
        f_ = xhand.FINGERS.index(finger)
        effects = ", ".join(_name(f["effect"]) for f in d.data["findings"] if any(t.startswith(f"{f_}:") for t in f["where"]["taxels"])) or "&#8211;"
        rows.append(f'<tr><td>pad of the {_t(finger)}</td><td>{effects}</td><td class="n">{charts.number(1e3 * v["before"])}</td><td class="n">{charts.number(1e3 * v["after"])}</td>'
                    f'<td class="n"></td><td class="n">{1e3 * v["noise"]:.2g} mN</td></tr>')  # fmt: skip
    more = f'<p class="soft small">and {len(order) - most} more joints with less, in the details</p>' if most is not None and len(order) > most else ""
    return f'<table><tr><th>where</th><th>found</th><th class="n">before</th><th class="n">after</th><th class="n">plain model</th><th class="n">noise</th></tr>{"".join(rows)}</table>{more}'


def _parameters(f: dict) -> str:
    out = []
    for key, p in f["parameters"].items():
        value, unit = p["value"], "" if p["unit"] == "1" else p["unit"]
        label = _t(key.replace("_", " "))
        if isinstance(value, list):
            text = ", ".join(f"{v:.3g}" for v in value[:8]) + (" ..." if len(value) > 8 else "")
            out.append(f'<tr><td>{label}</td><td class="n">{text} {unit}</td><td></td></tr>')
        elif isinstance(value, str):
            out.append(f'<tr><td>{label}</td><td class="n">{_t(value if len(value) < 60 else value[:57] + "...")}</td><td></td></tr>')
        elif value is not None:
            out.append(f'<tr><td>{label}</td><td class="n"><b>{charts.number(value, 4)}</b> {unit}<br/><span class="soft small">{charts.number(p["low"])} to {charts.number(p["high"])}</span></td>'
                       f'<td>{charts.interval(value, p["low"], p["high"])}</td></tr>')  # fmt: skip
    return f"<table>{''.join(out)}</table>" if out else ""


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:] if text.startswith(("the ", "joint ")) else text


def _lost(f: dict, d: Diagnosis) -> str:
    """The runner-up and why it lost, or the set that cannot be told apart."""
    if f["indistinguishable"]:
        names = _t(" and ".join(_name(x) for x in f["indistinguishable"]))
        return f"<p><b>These recordings cannot tell {names} apart.</b> To separate them: {_t(f['separating_experiment'])}.</p>"
    if not f["held_out"]:  # found before any fit: a signal, or a push from outside
        return ""
    rivals = [a for a in f["alternatives"] if a["confidence"] >= 0.005]
    if not rivals:
        return "<p class='soft'>Runner-up: none; nothing else in the catalogue follows the left-out stretches nearly as well.</p>"
    r = rivals[0]
    if r["confidence"] > f["confidence"]:
        return (f"<p><b>Something acts here, but which is open:</b> {_t(_name(r['effect']))} fitted in its place follows the stretches left out as well or better, in "
                f"{100 * r['confidence']:.0f} of 100 redraws.</p>")  # fmt: skip
    rest = f" (then {', '.join(_name(a['effect']) for a in rivals[1:])})" if len(rivals) > 1 else ""
    return (f"<p class='soft'>Runner-up: {_t(_name(r['effect']))}{_t(rest)}. Fitted in its place, it wins only {100 * r['confidence']:.0f} of 100 redraws of the "
            f"stretches left out of the fit.{_replayed(r['effect'], d)}</p>")  # fmt: skip


def _replayed(effect: str, d: Diagnosis) -> str:
    """What the runner-up leaves in the engine that trains, where it was replayed there."""
    errors = d.confirmation.errors if d.confirmation is not None else {}
    if f"{effect} instead" not in errors or "found" not in errors:
        return ""
    unit = "mm" if d.data["held_out"]["error"].endswith("_m") else "mrad"
    rival, found = errors[f"{effect} instead"][0], errors["found"][0]
    return f" Over all joints, in the engine that trains, it leaves {charts.number(1e3 * rival)} {unit}, the finding {charts.number(1e3 * found)}."


def _findings(d: Diagnosis) -> str:
    findings = d.data["findings"]
    if not findings:
        return _nearest(d)
    from dexsim.gap.report.sentence import spoken, words_of

    cards: dict[bool, list[str]] = {False: [], True: []}  # by whether it is a hint
    ends = _ends(d)
    for f in findings:
        e, h = entry(f), f["held_out"]
        bad = f["effect"] == "bad_channel"
        where = _t(_place(f))
        words = f"{_t(_capital(spoken(f)))} {_t(words_of(f, d.mechanism))}; it shows {_t(f['regime'])}." if e is not None else f"{where}: {_t(f['regime'])}."
        unit, k = unit_of(_metric(d, f)) if h else ("", 1.0)
        error = f'<p>Held-out error with everything else but this: <b>{charts.number(k * h["before"])}</b>; with it: <b>{charts.number(k * h["after"])} {unit}</b>.</p>' if h else ""
        strip = ""
        if f["when"]:
            names = list(dict.fromkeys(w["recording"] for w in f["when"]))[:4]
            rows = [(n, ends.get(n, max(w["end"] for w in f["when"] if w["recording"] == n)), [(w["start"], w["end"]) for w in f["when"] if w["recording"] == n]) for n in names]
            strip = f"<figure>{charts.strips(rows)}<figcaption>when it acts (dark: more than a quarter of its largest)</figcaption></figure>"
        kind = "bad" if bad else "set" if f["indistinguishable"] or f.get("hint") else ""
        left = _parameters(f)
        body = f'<div class="half"><div>{left}</div><div>{strip}</div></div>' if left and strip else f"{left}{strip}"
        cards[f.get("hint", False)].append(f'<div class="finding {kind}"><header><h3>{_t(_name(f["effect"]))} &#8212; {where}</h3><span class="conf">confidence <b>{100 * f["confidence"]:.0f} %</b></span></header>'
                     f"<p>{words}</p>{body}{error}{_lost(f, d)}</div>")  # fmt: skip
    out = f'<section><h2>What is missing</h2>{"".join(cards[False])}</section>' if cards[False] else _nearest(d)
    if cards[True]:
        out += ("<section><h2>Hints</h2><p>Names below 0.5, or that the error on what was kept out does not bear out: they count for nothing in"
                f" the verdict, and the notes below say why.</p>{''.join(cards[True])}</section>")  # fmt: skip
    return out


def _metric(d: Diagnosis, f: dict) -> str:
    """The metric of a finding's held-out error."""
    if not f["where"]["joints"]:
        return "tactile_rmse_N"
    if (e := entry(f)) is not None and e.effort_only:
        return "effort_rmse_Nm"
    h = d.data["held_out"]["error"]
    return h if not h.startswith("tactile") else "position_rmse_rad"


def _place(f: dict) -> str:
    from dexsim.gap.report.sentence import place

    return place(f)


def _ends(d: Diagnosis) -> dict[str, float]:
    out: dict[str, float] = dict(d.lengths)
    for f in d.data["findings"]:
        for w in f["when"]:
            out[w["recording"]] = max(out.get(w["recording"], 0.0), w["end"])
    return out


def _nearest(d: Diagnosis) -> str:
    scanned = sorted((r for o in d.outcomes for r in ((o.joint, *x) for x in o.scanned)), key=lambda r: -r[2])[:5]
    if not scanned:
        return ""
    rows = "".join(f'<tr><td>{_t(j)}</td><td>{_t(_name(e))}</td><td class="n">{100 * g:.1f} %</td><td class="n">{p:.2f}</td></tr>' for j, e, g, p in scanned)
    return ('<section><h2>What came nearest</h2><table><tr><th>joint</th><th>effect</th><th class="n">squared error it would remove</th>'
            f'<th class="n">chance of as much by accident</th></tr>{rows}</table></section>')  # fmt: skip


def _curves(d: Diagnosis) -> str:
    found = {j for f in d.data["findings"] for j in f["where"]["joints"]}
    order = sorted(d.curves, key=lambda c: (c.joint not in found, -d.joints[c.joint]["before"]))
    shown = order[: max(1, min(3, len(found)))] if order else []
    figures = []
    slide = "m" if d.data["held_out"]["error"].endswith("_m") else "rad"
    for c in shown:
        spans = [(w["start"], w["end"]) for f in d.data["findings"] if c.joint in f["where"]["joints"] for w in f["when"] if w["recording"] == c.recording]
        svg = charts.curves(c.t, c.measured, c.before, c.after if c.joint in found else None, c.command, slide, spans)
        v = d.joints[c.joint]
        figures.append(f"<figure>{svg}<figcaption><b>{_t(c.joint)}</b>, {_t(c.recording)}, the stretch with the largest error before. Over all held-out time: "
                       f"{1e3 * v['before']:.3g} m{slide} before, {1e3 * v['after']:.3g} after.</figcaption></figure>")  # fmt: skip
    for c in (d.touch.curves if d.touch is not None else [])[:3]:
        after = c.after if np.abs(c.after - c.before).max() > 1e-9 else None
        svg = charts.curves(c.t, c.measured, c.before, after, c.load, "N")
        figures.append(f"<figure>{svg}<figcaption><b>pad of the {_t(c.pad)}</b>, {_t(c.recording)}: sum of its taxels"
                       f"{', grey: the load cell' if c.load is not None and shown else ''}.</figcaption></figure>")  # fmt: skip
    if not figures:
        return ""
    loads = d.touch is not None and any(c.load is not None for c in d.touch.curves[:3])
    grey = f'<span class="key" style="background:#b8c0ca"></span>{"command" if shown else "load cell"}' if shown or loads else ""
    legend = ('<p class="soft small"><span class="key" style="background:#333"></span>measured<span class="key" style="background:var(--before)"></span>simulated before'
              '<span class="key" style="background:var(--after)"></span>simulated after' + grey + "</p>")  # fmt: skip
    return f"<section><h2>Before and after, on data kept out of the fit</h2>{legend}{''.join(figures)}</section>"


def _next(d: Diagnosis) -> str:
    n = d.data["next_recording"]
    if not n:
        sure = d.data["verdict"] in ("explained", "none") and not any(f["indistinguishable"] for f in d.data["findings"])
        return '<section class="next"><h2>What to record next</h2><p>Nothing is needed to settle this answer.</p></section>' if sure else ""
    send = f" The commands are ready to send: <code>{_t(n['commands'])}</code>." if n["commands"] else ""
    return f'<section class="next"><h2>What to record next</h2><p>{_t(n["why"][:1].upper() + n["why"][1:])}.{send}</p></section>'


def _confirmed(d: Diagnosis) -> str:
    """The hypotheses in the engine that trains beside the search's own plant."""
    c, unit = d.confirmation, "mm" if d.data["held_out"]["error"].endswith("_m") else "mrad"
    rows = "".join(f'<tr><td>{_t(name.replace("_", " "))}</td><td class="n">{charts.number(1e3 * a)}</td><td class="n">{charts.number(1e3 * b)} {unit}</td></tr>'
                   for name, (a, b) in c.errors.items())  # fmt: skip
    coarse = f" At {1e3 * TASKS:g} ms, the step of the tasks, it leaves {charts.number(1e3 * c.at_tasks_step)} {unit}."
    return (f'<p class="small">{_t(c.engine)} with the servo and model that training loads, {1e3 * c.step_s:g} ms a step, all joints at once, over '
            f"{_t(', '.join(c.recordings))}.{coarse}</p><table><tr><th>hypothesis</th><th class=\"n\">engine</th><th class=\"n\">the search's plant</th></tr>{rows}</table>")  # fmt: skip


def _details(d: Diagnosis) -> str:
    """What a second minute is for, folded away."""
    folded = []
    if len(d.joints) > 6:
        folded.append(("Every joint", _rows(d, "mm" if d.data["held_out"]["error"].endswith("_m") else "mrad")))
    if d.spots:
        rows = [(f"{s.joint}: {s.text}", s.ratio, s.ratio_low, s.ratio_high) for of in ("position", "effort") for s in [x for x in _best(d) if x.of == of][:10]]
        folded.append(("Where the error before lives", "<p class='soft small'>Error inside a regime over the error outside it, with 90 % intervals; only what stands after "
                       f"controlling the false discoveries over all regimes of all joints.</p>{charts.ratios(rows)}"))  # fmt: skip
    if d.stages:
        folded.append(("Stage by stage", "<ul>" + "".join(f"<li>{_t(x)}</li>" for x in d.stages) + "</ul>"))
    absent = d.data["unexplained"].get("not_considered", {})
    if absent:
        items = "".join(f"<tr><td>{_t(_name(e))}</td><td>{_t(why)}</td></tr>" for e, why in absent.items())
        folded.append(("Not considered", f"<table>{items}</table>"))
    if d.confirmation is not None:
        folded.append(("In the engine that trains", _confirmed(d)))
    nuisance = ", ".join(f"{_t(k)} {v:.4g}" for k, v in d.data["nuisance"].items())
    if nuisance:
        folded.append(("Believed figures as refitted", f'<p class="small">{nuisance}</p>'))
    notes = list(d.notes)
    if d.untrained:
        notes.append("fitted, but not a column of the servo table, so training does not carry it: " + ", ".join(d.untrained))
    left = d.data["unexplained"]
    if left["depends_on"]:
        notes.insert(0, f"{100 * (left['fraction_of_gap'] or 0):.0f} % of the gap is left; it depends on " + "; ".join(left["depends_on"]))
    items = "".join(f"<li>{_t(n)}</li>" for n in dict.fromkeys(notes))
    total = sum(d.shares.values())
    clock = f'<p class="soft small">Took {total:.0f} s: ' + ", ".join(f"{_t(k)} {v:.1f} s" for k, v in d.shares.items()) + ".</p>" if total else ""
    inner = "".join(f"<details><summary>{title}</summary>{text}</details>" for title, text in folded)
    if not (items or inner or clock):
        return ""
    return f"<section><h2>Notes and details</h2>{'<ul>' + items + '</ul>' if items else ''}{inner}{clock}</section>"


__all__ = ["page", "unit_of"]
