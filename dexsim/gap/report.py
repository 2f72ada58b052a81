"""report.html: one page that stands alone, read in a minute. Its figures are inline SVG: no script, no network, no font."""

from __future__ import annotations

import html
from typing import TYPE_CHECKING, Any


from dexsim.gap import charts
from dexsim.gap.catalogue import EFFECTS

if TYPE_CHECKING:
    from dexsim.gap.diagnosis import Diagnosis

VERDICTS = {
    "explained": ("Explained", "good"), "partly_explained": ("Partly explained", "warn"), "unknown": ("Unknown", "bad"),
    "none": ("Nothing missing", "good"), "unusable": ("Cannot be judged", "bad"),
}  # fmt: skip
STYLE = """
:root{--ink:#1c2430;--soft:#5d6b7c;--line:#dfe4ea;--bg:#f6f7f9;--card:#fff;--good:#1a7f52;--warn:#b26a00;--bad:#b3261e;--before:#d1495b;--after:#1f77b4}
*{box-sizing:border-box}body{margin:0;background:var(--bg);color:var(--ink);font:15px/1.5 system-ui,-apple-system,Segoe UI,Roboto,sans-serif}
main{max-width:1060px;margin:0 auto;padding:28px 22px 60px}h1{font-size:25px;line-height:1.32;margin:8px 0 14px;font-weight:650}
h2{font-size:17px;margin:0 0 10px}section{background:var(--card);border:1px solid var(--line);border-radius:10px;padding:18px 20px;margin:16px 0}
.tag{display:inline-block;padding:3px 11px;border-radius:99px;color:#fff;font-weight:600;font-size:13px}.good{background:var(--good)}.warn{background:var(--warn)}.bad{background:var(--bad)}
.soft{color:var(--soft)}.big{display:flex;gap:34px;flex-wrap:wrap;margin-top:6px}.big div{min-width:120px}.big b{display:block;font-size:26px;font-weight:650}
table{border-collapse:collapse;width:100%;font-size:14px}th{text-align:left;color:var(--soft);font-weight:500;border-bottom:1px solid var(--line);padding:5px 8px 5px 0}
td{border-bottom:1px solid var(--line);padding:6px 8px 6px 0;vertical-align:top}td.n,th.n{text-align:right;font-variant-numeric:tabular-nums}
svg{max-width:100%;height:auto;display:block}.two{display:grid;grid-template-columns:300px 1fr;gap:22px}@media(max-width:760px){.two{grid-template-columns:1fr}}
figure{margin:0 0 18px}figcaption{color:var(--soft);font-size:13px;margin-top:4px}code{background:#eef1f4;padding:1px 5px;border-radius:4px;font-size:13px}
.key{display:inline-block;width:18px;height:3px;vertical-align:middle;margin:0 5px 0 12px}details summary{cursor:pointer;color:var(--soft)}
"""


def page(d: Diagnosis) -> str:
    """The page as HTML text."""
    word, tone = VERDICTS[d.data["verdict"]]
    parts = [f'<span class="tag {tone}">{word}</span>', f"<h1>{_t(d.sentence)}</h1>", _numbers(d)]
    if d.mechanism is not None and d.joints:
        parts.append(_where(d))
    parts.append(_findings(d))
    if d.curves:
        parts.append(_curves(d))
    parts.append(_when(d))
    parts.append(_map(d))
    if d.stages:
        parts.append("<section><h2>Stage by stage</h2><ul>" + "".join(f"<li>{_t(x)}</li>" for x in d.stages) + "</ul></section>")
    parts.append(_next(d))
    parts.append(_notes(d))
    body = "\n".join(p for p in parts if p)
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"/><meta name="viewport" content="width=device-width, initial-scale=1"/>'
        f"<title>Diagnosis: {_t(word)}</title><style>{STYLE}</style></head>\n<body><main>\n{body}\n</main></body></html>\n"
    )


def _t(x: Any) -> str:
    return html.escape(str(x))


def _unit(d: Diagnosis) -> tuple[str, float]:
    e = d.data["held_out"]["error"]
    if e.startswith("effort"):
        return ("mA" if e.endswith("_A") else "mN.m"), 1e3
    return ("mm" if e.endswith("_m") else "mrad"), 1e3


def _numbers(d: Diagnosis) -> str:
    h = d.data["held_out"]
    if h["before"] is None:
        return ""
    unit, k = _unit(d)
    cell = lambda name, value, low, high: (  # noqa: E731
        f'<div><span class="soft">{name}</span><b>{k * value:.3g} {unit}</b><span class="soft">{k * low:.3g} to {k * high:.3g}</span></div>'
    )
    floor = d.data["noise_floor"]
    out = [cell("error before", h["before"], h["before_low"], h["before_high"])]
    if d.data["findings"]:
        out.append(cell("error after", h["after"], h["after_low"], h["after_high"]))
    if not h["error"].startswith("effort"):
        out.append(f'<div><span class="soft">noise floor</span><b>{k * floor["position_rad"]:.2g} {unit}</b><span class="soft">from {floor["how"]}</span></div>')
    kept = _t(h.get("how") or ", ".join(h["recordings"]))
    return f'<section><div class="big">{"".join(out)}</div><p class="soft">Free run from the first sample, on what was kept out of the fit: {kept}. Before: the believed machine, its figures refitted within 5 %.</p></section>'


def _where(d: Diagnosis) -> str:
    named = {j for f in d.data["findings"] for j in f["where"]["joints"]}
    picture = charts.mechanism(d.mechanism.spec.compile(), {j: v["before"] for j, v in d.joints.items()}, named)
    unit, k = _unit(d)
    if unit.startswith("mN") or unit == "mA":
        unit, k = "mrad", 1e3
    rows = []
    for j, v in d.joints.items():
        effects = ", ".join(f["effect"].replace("_", " ") for f in d.data["findings"] if j in f["where"]["joints"]) or "&#8211;"
        rows.append(f'<tr><td>{_t(j)}</td><td class="n">{k * v["before"]:.3g}</td><td class="n">{k * v["after"]:.3g}</td>'
                    f'<td class="n">{k * v["sigma"]:.2g}</td><td>{effects}</td></tr>')  # fmt: skip
    table = f'<table><tr><th>joint</th><th class="n">before, {unit}</th><th class="n">after</th><th class="n">noise</th><th>found</th></tr>{"".join(rows)}</table>'
    return f'<section><h2>Where</h2><div class="two"><figure>{picture}<figcaption>Joints by their error before: pale is small, red is large; ringed where something was found.</figcaption></figure><div>{table}</div></div></section>'


def _parameters(f: dict) -> str:
    out = []
    for key, p in f["parameters"].items():
        value, unit = p["value"], p["unit"]
        if isinstance(value, list):
            out.append(f"{key} ({', '.join(f'{v:.3g}' for v in value)}) {unit}")
        elif isinstance(value, str):
            out.append(f"{key} {_t(value)}")
        else:
            out.append(f"{key} <b>{value:.4g}</b> {unit} <span class='soft'>({p['low']:.3g} to {p['high']:.3g})</span>")
    return "<br/>".join(out)


def _findings(d: Diagnosis) -> str:
    if not d.data["findings"]:
        scanned = sorted((r for o in d.outcomes for r in ((o.joint, *x) for x in o.scanned)), key=lambda r: -r[2])[:5]
        rows = "".join(f'<tr><td>{_t(j)}</td><td>{_t(e.replace("_", " "))}</td><td class="n">{100 * g:.1f} %</td><td class="n">{p:.2f}</td></tr>' for j, e, g, p in scanned)
        if not rows:
            return ""
        return ('<section><h2>What came nearest</h2><table><tr><th>joint</th><th>effect</th><th class="n">squared error it would remove</th>'
                f'<th class="n">chance of as much by accident</th></tr>{rows}</table></section>')  # fmt: skip
    rows = []
    for f in d.data["findings"]:
        h = f["held_out"]
        k = 1e3
        error = f"{k * h['before']:.3g} &#8594; {k * h['after']:.3g}" if h else "&#8211;"
        name = f["effect"].replace("_", " ")
        words = EFFECTS[f["effect"]].words if f["effect"] in EFFECTS else "is not what it says"
        rivals = ", ".join(f"{a['effect'].replace('_', ' ')} ({100 * a['confidence']:.0f} %)" for a in f["alternatives"] if a["confidence"] >= 0.005)
        lost = f"<br/><span class='soft'>Runner-up: {_t(rivals)}; it follows the left-out stretches less well.</span>" if rivals else (
            "<br/><span class='soft'>No other effect of the catalogue comes near.</span>" if f["effect"] in EFFECTS else "")
        if f["indistinguishable"]:
            lost = f"<br/><b>Cannot be told apart here:</b> {_t(', '.join(x.replace('_', ' ') for x in f['indistinguishable']))}. To separate them: {_t(f['separating_experiment'])}."
        where = ", ".join(f["where"]["joints"] or f["where"]["taxels"] or f["where"]["topics"])
        rows.append(f'<tr><td><b>{_t(name)}</b><br/><span class="soft">{_t(where)} {_t(words)}; it shows {_t(f["regime"])}.</span>{lost}</td>'
                    f'<td>{_parameters(f)}</td><td class="n">{100 * f["confidence"]:.0f} %</td><td class="n">{error}</td></tr>')  # fmt: skip
    return ('<section><h2>What is missing</h2><table><tr><th>effect</th><th>parameters (90 % interval)</th><th class="n">confidence</th>'
            f'<th class="n">held-out error, 10&#8315;&#179;</th></tr>{"".join(rows)}</table></section>')  # fmt: skip


def _curves(d: Diagnosis) -> str:
    found = {j for f in d.data["findings"] for j in f["where"]["joints"]}
    order = sorted(d.curves, key=lambda c: (c.joint not in found, -d.joints[c.joint]["before"]))[:4]
    figures = []
    for c in order:
        svg = charts.curves(c.t, c.measured, c.before, c.after if c.joint in found else None, c.command)
        v = d.joints[c.joint]
        figures.append(f"<figure>{svg}<figcaption>{_t(c.joint)} in {_t(c.recording)}, where the error before is largest. All held-out time: "
                       f"{1e3 * v['before']:.3g} before, {1e3 * v['after']:.3g} after (10&#8315;&#179; rad or m).</figcaption></figure>")  # fmt: skip
    legend = ('<p class="soft"><span class="key" style="background:#333"></span>measured<span class="key" style="background:var(--before)"></span>simulated before'
              '<span class="key" style="background:var(--after)"></span>simulated after<span class="key" style="background:#b8c0ca"></span>command</p>')  # fmt: skip
    return f"<section><h2>Before and after, on data kept out of the fit</h2>{legend}{''.join(figures)}</section>"


def _when(d: Diagnosis) -> str:
    strips = []
    for f in d.data["findings"]:
        names = list(dict.fromkeys(w["recording"] for w in f["when"]))[:4]
        for name in names:
            spans = [(w["start"], w["end"]) for w in f["when"] if w["recording"] == name]
            strips.append((f"{f['effect'].replace('_', ' ')}, {', '.join(f['where']['joints'])}, {name}", spans))
    if not strips:
        return ""
    return f"<section><h2>When it acts</h2>{charts.strips(strips[:12])}</section>"


def _map(d: Diagnosis) -> str:
    if not d.spots:
        return ""
    best: dict[tuple[str, str], Any] = {}
    for s in d.spots:
        best.setdefault((s.joint, s.regime), s)
    rows = [(f"{s.joint}: {s.text}", s.ratio, s.ratio_low, s.ratio_high) for s in list(best.values())[:10]]
    return ("<section><h2>Where the error before lives</h2><p class='soft'>Error inside a regime over the error outside it, with 90 % intervals; only what stands after "
            f"controlling the false discoveries over all regimes of all joints.</p>{charts.ratios(rows)}</section>")  # fmt: skip


def _next(d: Diagnosis) -> str:
    n = d.data["next_recording"]
    if not n:
        return ""
    send = f" The commands are ready to send: <code>{_t(n['commands'])}</code>." if n["commands"] else ""
    return f"<section><h2>What to record next</h2><p>{_t(n['why'])}.{send}</p></section>"


def _notes(d: Diagnosis) -> str:
    notes = list(d.notes)
    if d.untrained:
        notes.append("fitted, but not a column of the servo table yet, so training does not carry it: " + ", ".join(d.untrained))
    left = d.data["unexplained"]
    if left["depends_on"]:
        notes.append(f"{100 * (left['fraction_of_gap'] or 0):.0f} % of the gap is left; it depends on " + "; ".join(left["depends_on"]))
    if not notes and not d.shares:
        return ""
    items = "".join(f"<li>{_t(n)}</li>" for n in dict.fromkeys(notes))
    total = sum(d.shares.values())
    clock = f'<p class="soft">Took {total:.0f} s: ' + ", ".join(f"{_t(k)} {v:.0f} s" for k, v in d.shares.items()) + ".</p>" if total else ""
    nuisance = ", ".join(f"{_t(k)} {v:.4g}" for k, v in d.data["nuisance"].items())
    if nuisance:
        clock += f"<details><summary>Believed figures as refitted</summary><p>{nuisance}</p></details>"
    return f"<section><h2>Notes</h2>{'<ul>' + items + '</ul>' if items else ''}{clock}</section>"


__all__ = ["page"]
