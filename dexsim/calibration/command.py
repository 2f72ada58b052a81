"""`dexsim calibrate`: reads presses, fits, says where a fit fails, writes calibration.yaml and plots."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml

from dexsim import typed
from dexsim.console import program
from dexsim.errors import UserError

if TYPE_CHECKING:
    from dexsim.hand import Hand

LINEAR_R2 = 0.97  # a press curve under this is not called linear
RESULTS = ("calibration.yaml", "real.png", "sim.png", "taxels.png", "press.png", "rubber.png")
PRESSES = {"real": "presses_realistic", "sim": "presses_sim", "touch": "pads"}
"""Folders of simulated recordings, by what they stand for."""
CHOICES = {"normalization": ("matched", "paper")}


def main(argv: Sequence[str], config_dir: Path) -> int:
    """Returns the exit status. Raises UserError."""
    file = config_dir / "calibrate.yaml"
    if not argv or argv[0] in ("-h", "--help", "help"):
        print(program.words(_help(file)), end="")
        return 0 if argv else 2
    s, reading = _settings(argv, yaml.safe_load(file.read_text(encoding="utf-8")))
    if not any(s[k] for k in ("real", "sim", "touch", "curve", "simulate", "simulate_touch")):
        raise UserError(
            "say what to calibrate: real=, sim=, simulate=true, touch=, simulate_touch=true or curve= (--help)"
        )
    return run(s, reading)


def run(s: dict[str, Any], reading: dict[str, dict[str, str]]) -> int:
    """Return everything that the settings ask for."""
    from dexsim import outputs
    from dexsim.calibration import simulate
    from dexsim.hand import load_hand
    from dexsim.sim.quiet import quiet_warp

    hand = load_hand(s["hand"], s["hand_mirror"])
    out = Path(str(s["out"])).expanduser()
    given = [Path(p.strip()) for k in ("real", "sim", "touch", "curve") if s[k] for p in str(s[k]).split(",")]
    key = "real" if s["realistic"] else "sim"
    made_here = [PRESSES["touch"]] * s["simulate_touch"] + [PRESSES[key]] * s["simulate"]
    outputs.claim(out, "out=", (*RESULTS, *made_here), given)
    report: dict[str, Any] = {"schema": 1, "robot": hand.robot, "normalization": s["normalization"], "source": {}}
    if s["simulate"]:
        quiet_warp("cpu")
        every = [j for j, f in zip(hand.joints, hand.finger_of_joint, strict=True) if f >= 0]
        joints = [j.strip() for j in s["joints"].split(",")] if s["joints"] else every
        how = s["servo"], int(s["levels"]), s["realistic"], int(s["seed"])
        with outputs.staged(out) as stage:
            made = simulate.make(stage / PRESSES[key], hand, joints, *how)
        if s[key] is None:
            s[key] = ",".join(str(out / p.relative_to(stage)) for p in made)
    if s["simulate_touch"]:
        quiet_warp("cpu")
        with outputs.staged(out) as stage:
            rolled = simulate.make_rolled(stage / PRESSES["touch"], hand, True, int(s["seed"]), s["faults"])
        s["touch"] = s["touch"] or str(out / rolled.relative_to(stage))
    with outputs.staged(out) as stage:
        assumed = _fits(s, reading, stage, report, hand)
    for text in assumed:
        print(f"note     {text}")
    print(f"yaml     {out / 'calibration.yaml'}")
    return 0


def _fits(
    s: dict[str, Any], reading: dict[str, dict[str, str]], out: Path, report: dict[str, Any], hand: Hand
) -> list[str]:
    """Return all fits and their plots, calibration.yaml; returns what is assumed in it."""
    from dexsim.calibration import charts, current
    from dexsim.calibration.file import Calibration, save

    real = sim = None
    for key, effort_is, symbol in (("real", "current_A", "alpha"), ("sim", "torque_Nm", "beta")):
        if not s[key]:
            continue
        half = current.half(
            current.files_of(s[key], key), effort_is, hand, reading if key == "real" else None, int(s["seed"])
        )
        report["source"][key] = s[key] if len(s[key]) < 200 else str(Path(s[key].split(",")[0]).parent)
        _print_half(half, key, symbol)
        title = f"{key}: fingertip force over {'motor current' if key == 'real' else 'joint torque'}"
        print(f"plot     {_moved(charts.lines(half, out / f'{key}.png', title))}\n")
        real, sim = (half, sim) if key == "real" else (real, half)
    if real or sim:
        report["joints"] = current.combine(real, sim)
        if real and sim:
            _print_ratio(report["joints"])
        elif real:
            print(
                "note     only the real half: current_per_torque stays unknown; add sim= (or simulate=true) with the"
                " same presses\n"
            )
    touch: dict[str, Any] = {}
    if real and real.lsb:  # alpha is in the newtons that these counts were taken for
        touch["lsb"] = real.lsb
    if s["touch"]:
        touch |= _touch(s, reading, out, hand)
    if s["curve"]:
        touch |= _curve(s, out)
    if touch:
        report["touch"] = touch
    save(out / "calibration.yaml", report, hand)
    return Calibration.from_dict(report, hand=hand).assumed


def _moved(path: Path) -> Path:
    """Return where a staged file is once all is done."""
    return path.parent.parent / path.name


def _print_half(half: Any, key: str, symbol: str) -> None:
    from dexsim.console.tables import table

    rows = []
    for joint in half.joints:
        f = half.fits.get(joint)
        if f is None:
            rows.append((joint, "-", "-", "-", "-", "-", "-", half.left_out.get(joint, "")))
            continue
        ratio = f"{f.ratio:.4g} [{f.ratio_low:.4g}, {f.ratio_high:.4g}]"
        rows.append((joint, ratio, f"{f.slope:.4g} {f.offset:+.2f}", f"{f.r2:.4f}", f"{f.held_out:.2f}",
                     f"{100 * f.hysteresis:.0f}", f"{f.effort_max:.3g} / {f.force_max:.3g}",
                     "; ".join(f.why) or "linear"))  # fmt: skip
    head = (
        "joint", f"{symbol} N/{half.unit}, 95 %", "slope, offset", "R2", "held out N", "hysteresis %",
        f"max {half.unit} / N", "verdict",
    )  # fmt: skip
    print(table(f"{key}: fingertip force over effort", head, rows))
    for note in half.notes:
        print(f"note     {note}")


def _print_ratio(joints: dict[str, Any]) -> None:
    from dexsim.console.tables import table

    rows = []
    for joint, e in joints.items():
        c, most = e.get("current_per_torque"), [e.get(k, float("nan")) for k in ("current_max", "torque_seen")]
        known = "-" if c is None else f"{c['value']:.4g} [{c['low']:.4g}, {c['high']:.4g}]"
        rows.append((joint, known, *(f"{x:.3g}" for x in most)))
    head = ("joint", "A per N.m, 95 %", "I_max A", "tau_max pressed N.m")
    print(table("current for torque (equal fingertip force)", head, rows) + "\n")


def _touch(s: dict[str, Any], reading: dict[str, dict[str, str]], out: Path, hand: Hand) -> dict[str, Any]:
    """Return the threshold, dead and swapped taxels, gains of every pad."""
    from dexsim.calibration import charts, current, taxels
    from dexsim.calibration.simulate import pads_of
    from dexsim.recording.reader import read

    layout = pads_of(hand)
    if not all(layout.rows[: len(hand.fingers)]):
        raise UserError(
            f"touch={s['touch']}: the pads of hand={hand.name} form no lattice (rows: 0 in hand.yaml): which taxels lie"
            " side by side is not known, and their faults cannot be told"
        )
    readings: list[np.ndarray] = []
    loads: list[np.ndarray] = []
    unit, lsb, measured = "count", None, True
    for path in current.files_of(s["touch"], "touch"):
        r = read(path, reading["remap"], reading["meta"], audit=False, hand=hand)
        if r.tactile is None:
            raise UserError(f"{path}: has no /tactile")
        if r.tactile.value.shape[1:3] != (layout.pads, layout.taxels):
            raise UserError(
                f"{path}: /tactile has {r.tactile.value.shape[1]} pads of {r.tactile.value.shape[2]} taxels; hand="
                f"{hand.name} has {layout.pads} of {layout.taxels}"
            )
        unit = r.meta["tactile_unit"]
        lsb = r.tactile_lsb
        readings.append(r.tactile.value[..., 2] * r.tactile_axis_sign[2])
        if r.external_force is None:
            measured = False
            loads.append(np.full(len(r.tactile), np.nan))
        else:
            size = np.linalg.norm(r.external_force.value[:, :3], axis=1)
            loads.append(np.interp(r.tactile.t, r.external_force.t, size))
    values, load = np.concatenate(readings), np.concatenate(loads)
    found: dict[str, Any] = {}
    pressed = np.abs(values).sum(2)
    winner = pressed.argmax(1)
    for f, finger in enumerate(hand.finger_names):
        # a load cell tells of the pad that is pressed; others are at rest then
        mine = (winner == f) | (pressed.max(1) <= np.percentile(pressed.max(1), 10))
        found[finger] = taxels.inspect(
            values[mine, f, : layout.count[f]],
            load[mine] if measured and (winner == f).sum() > 50 else None,
            rows=layout.rows[f],
        )
    result: dict[str, Any] = {"dead": {}, "swapped": {}, "gain": {}, "bias": {}, "hysteresis": {}}
    scales = [p.scale for p in found.values() if p.scale]
    count = lsb if lsb is not None else (float(np.mean(scales)) if scales else None)
    result["lsb"] = (
        float(f"{np.mean(scales):.6g}") if scales and unit == "count" else (count if unit == "count" else None)
    )
    for finger, p in found.items():
        words = [
            f"threshold {p.threshold:.3g} {unit}",
            f"{len(p.dead)} dead",
            f"{len(p.swapped)} swapped pairs",
            f"{len(p.unseen)} not pressed enough to tell",
        ]
        if p.gain is not None:
            words.append(f"{p.scale:.4g} N a {unit}, load on held-out presses to {100 * p.held_out:.1f} %"
                         f" ({100 * p.held_out_equal:.1f} % with equal gains), hysteresis"
                         f" {100 * p.hysteresis:.1f} %")  # fmt: skip
            base = np.mean(scales)
            result["gain"][finger] = [round(float(g * p.scale / base), 4) for g in p.gain]
            result["hysteresis"][finger] = round(float(p.hysteresis), 4) if np.isfinite(p.hysteresis) else None
        if p.dead:
            result["dead"][finger] = p.dead
            words.append(f"dead: {p.dead}")
        if p.swapped:
            result["swapped"][finger] = [list(pair) for pair in p.swapped]
            words.append(f"swapped: {p.swapped}")
        if unit == "count" and np.abs(p.bias).max() > 0.5:
            result["bias"][finger] = [round(float(b), 2) for b in p.bias]
        print(f"touch    {finger}: " + "; ".join(words + p.notes))
    scale = (result["lsb"] or 0.1) if unit == "count" else 1.0
    result["threshold"] = float(f"{max(p.threshold for p in found.values()) * scale:.4g}")
    if not measured:
        print("note     no /external_force: gains and N a count are not known")
    print(f"plot     {_moved(charts.pads(found, out / 'taxels.png'))}\n")
    return {k: v for k, v in result.items() if v not in ({}, None)}


def _curve(s: dict[str, Any], out: Path) -> dict[str, Any]:
    """Return the stiffness and rubber constants of a test curve."""
    from dexsim.calibration import charts, rubber

    kind, a, b = rubber.read_curve(s["curve"])
    result: dict[str, Any] = {}
    if kind == "press":
        k = rubber.fit_linear(a, b)
        loop = f", hysteresis {100 * k.hysteresis:.1f} %" if np.isfinite(k.hysteresis) else ""
        print(
            f"curve    linear stiffness {k.value:.4g} [{k.low:.4g}, {k.high:.4g}] N/m, R2 {k.r2:.4f}, held out"
            f" {k.held_out:.3g} N{loop}"
        )
        print(f"plot     {_moved(charts.press(a, b, k, out / 'press.png'))}")
        result["stiffness"] = {
            "value": k.value, "low": k.low, "high": k.high, "r2": k.r2, "held_out_N": k.held_out,
            "linear": k.r2 >= LINEAR_R2,
        }  # fmt: skip
        if k.r2 < LINEAR_R2:
            print(
                f"note     R2 under {LINEAR_R2}: the force does not grow in proportion to depth; the Mooney-Rivlin fit"
                " (area=) may hold"
            )
        if s["area"] is None:
            print("note     area= is not given: no rubber constants from force and depth")
            return result
        a, b = rubber.from_press(a, b, float(s["area"]), float(s["thickness"]))
    keep = a <= float(s["stretch_max"])
    fit = rubber.fit_mooney_rivlin(a[keep], b[keep])
    print(f"curve    Mooney-Rivlin c10 {fit.c10:.4g} [{fit.c10_range[0]:.4g}, {fit.c10_range[1]:.4g}] Pa, c01"
          f" {fit.c01:.4g}"
          f" [{fit.c01_range[0]:.4g}, {fit.c01_range[1]:.4g}] Pa, R2 {fit.r2:.4f}, held out {fit.held_out:.3g} Pa,"
          " stretch"
          f" {fit.stretch[0]:.2f} to {fit.stretch[1]:.2f}")  # fmt: skip
    print(f"plot     {_moved(charts.rubber(a[keep], b[keep], fit, out / 'rubber.png'))}\n")
    result["rubber"] = {"c10": fit.c10, "c01": fit.c01, "c10_range": list(fit.c10_range),
                        "c01_range": list(fit.c01_range), "r2": fit.r2,
                        "held_out_Pa": fit.held_out, "thickness": float(s["thickness"]),
                        "shear_modulus": fit.shear_modulus}  # fmt: skip
    return result


def _settings(argv: Sequence[str], defaults: dict[str, Any]) -> tuple[dict[str, Any], dict[str, dict[str, str]]]:
    out, remap, meta = dict(defaults), {}, {}
    for key, text in typed.settings(argv, defaults, ("meta.", "units.", "remap.")).items():
        if key.startswith("remap."):
            remap[key.removeprefix("remap.")] = text
            continue
        if key not in defaults:
            meta[key.removeprefix("meta.")] = text
            continue
        if text == "null":
            out[key] = None
        elif isinstance(defaults[key], bool):
            out[key] = typed.truth(key, text)
        elif isinstance(defaults[key], (int, float)) or key in ("area",):
            least = {"levels": 4, "seed": 0, "stretch_max": 1.01}.get(key, 1e-12)
            out[key] = typed.number(key, text, least, exact=key in ("levels", "seed"))
        else:
            out[key] = text
        if key in CHOICES:
            typed.one_of(key, text, CHOICES[key])
    return out, {"remap": remap, "meta": meta}


def _help(file: Path) -> str:
    what = "Fit what a hand's currents and taxel counts mean, from press recordings; writes calibration.yaml."
    rows = [(f"{key}={value}", comment) for key, value, comment in program.settings(file)]
    rows += [
        ("meta.KEY=VALUE", "metadata that wins over what real= and touch= recordings say"),
        ("units.QUANTITY=UNIT", "units of real= and touch=, as `dexsim audit` takes them"),
        ("remap.OURS=THEIRS", "names of topics, joints or columns there"),
    ]
    lines = [f"  {setting:<34} {comment}" for setting, comment in rows]
    return "\n".join(["usage: dexsim calibrate key=value ...", "", what, "", *lines, ""])
