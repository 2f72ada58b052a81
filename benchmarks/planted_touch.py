"""Planted touch and contact effects, several sizes and seeds: python -m benchmarks.planted_touch [seeds=2]
[load_cell=true] [only=EFFECT].

Three recordings of 8 s a case from the simulated press rig (`benchmarks.press_rig`: MuJoCo's contact geometry,
the taxel kernels that train policies, counts of 0.1 N, a load cell with 20 mN of noise). Right: named first, or in a
set of its class. One JSON line at the end. Then the same motion is felt by the sensor that trains, first as believed,
then with what tactile.yaml hands on: the rms difference where a taxel reads anything (of a rubber, at the force that
the cell measured). The sanity check of the method on our own simulator, not a proof.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from dexsim.console.ending import guard
from dexsim.errors import UserError

PERIOD = 1 / 90.0  # s between readings: the sensor shows its last one that is older than the delay
CASES: list[tuple[str, dict, dict[str, float]]] = [
    *(("tactile_gain", {"gains": dict.fromkeys(range(120), g)}, {"gain": g}) for g in (0.6, 0.8, 1.3)),
    *(("tactile_hysteresis", {"sensor": {"hysteresis": h, "hysteresis_time": t}}, {"fraction": h, "time_constant": t})
      for h, t in ((0.15, 0.3), (0.3, 0.15), (0.3, 1.0))),
    # 0.1 and 0.2 leave 1.2 and 1.25 x the noise once the contact's width, which is only believed, is fitted: nothing is
    # named there
    *(("tactile_crosstalk", {"crosstalk": c}, {"fraction": c}) for c in (0.3, 0.4, 0.6)),
    *(("tactile_delay", {"sensor": {"delay": d}}, {"delay": PERIOD * np.ceil(d / PERIOD)}) for d in (0.02, 0.04, 0.08)),
    *(("tactile_stiffening", {"rubber": r}, {"c10": r[0], "c01": r[1]}) for r in ((5e4, 1e4), (1e5, 2e4), (2e5, 1e4))),
    *(("thermal", {"drift": d}, {"per_degree": d}) for d in (-0.012, -0.006, 0.01)),
    *(("contact_friction", {"slides": True, "friction": f}, {"mu": f}) for f in (0.3, 0.5, 1.2)),
    *(("contact_stiffness", {"stiffness": k}, {"stiffness": k}) for k in (4000.0, 5500.0, 10000.0)),
    *((None, {}, {}) for _ in range(3)),
]  # fmt: skip


def main(argv: list[str]) -> int:
    """Runs the cases and prints a line for each, then the sums."""
    s = {"seeds": "2", "load_cell": "true", "only": ""}
    for a in argv:
        key, equals, value = a.partition("=")
        if a in ("-h", "--help"):
            print(__doc__)
            return 0
        if not equals or key not in s:
            raise UserError(f"'{a}' is not a setting: {', '.join(s)}")
        s[key] = value
    from benchmarks import press_rig
    from dexsim.gap.touch.diagnosis import diagnose, handed
    from dexsim.recording import read
    from dexsim.recording.mechanism import mechanism
    from dexsim.sim.quiet import quiet_warp

    quiet_warp("cpu")
    right: dict[str, list[bool]] = {}
    sets, covered, errors, false, seconds, again = 0, [], [], [], [], []
    for seed in range(int(s["seeds"])):
        for effect, planted, values in CASES:
            if s["only"] and s["only"] != effect:
                continue
            with tempfile.TemporaryDirectory() as folder:
                paths, model, servo = press_rig.record(
                    Path(folder), 3, 8.0, seed=10 + seed, load_cell=s["load_cell"] == "true", **planted
                )
                m = mechanism(model, servo)
                start = time.perf_counter()
                out = diagnose([read(p, joints=m.joints, audit=False) for p in paths], m, set(), seed)
                seconds.append(time.perf_counter() - start)
                felt = (
                    ""
                    if not out.findings
                    else _felt_again(
                        Path(folder),
                        paths,
                        handed(out.findings, out.facts, out.names),
                        planted,
                        10 + seed,
                        again,
                    )
                )
            first = out.findings[0] if out.findings else None
            names = [f["effect"] for f in out.findings]
            if effect is None:
                false.append(bool(names))
                print(f"nothing planted: {names or 'nothing found'}", flush=True)
                continue
            good = first is not None and (first["effect"] == effect or effect in first["indistinguishable"])
            right.setdefault(effect, []).append(good)
            sets += bool(good and first["indistinguishable"])
            line = ""
            if good and first["effect"] == effect:
                for key, value in values.items():
                    p = first["parameters"][key]
                    covered.append(p["low"] <= value <= p["high"])
                    errors.append(abs(p["value"] / value - 1))
                    line += f" {key} {p['value']:.4g} ({p['low']:.4g} to {p['high']:.4g}), planted {value:.4g};"
            print(f"{effect}:"
                  f" {', '.join(names) or 'nothing'}{' as a set' if good and first['indistinguishable'] else ''};{line}"
                  f" {1e3 * out.before[0]:.0f} -> {1e3 * out.after[0]:.0f} mN"
                  f"{felt}", flush=True)  # fmt: skip
    print(json.dumps({
        "benchmark": "planted_touch", "load_cell": s["load_cell"] == "true", "cases": sum(map(len, right.values())),
        "right": {e: f"{sum(r)}/{len(r)}" for e, r in right.items()},
        "sets": sets, "covered": round(float(np.mean(covered)), 3) if covered else None, "parameters": len(covered),
        "median_error": round(float(np.median(errors)), 4) if errors else None,
        "false_alarms": f"{sum(false)}/{len(false)}",
        "felt_again_mN": [round(1e3 * float(np.median(x)), 1) for x in zip(*again, strict=True)] if again else None,
        "seconds_a_case": round(float(np.mean(seconds)), 1),
    }))  # fmt: skip
    return 0


def _felt_again(folder: Path, paths: list[Path], h, planted: dict, seed: int, again: list) -> str:
    """The recorded motion felt by the sensor that trains, as believed and with what is handed on; in words."""
    from benchmarks import press_rig
    from dexsim.recording import read

    recorded = [read(p, audit=False) for p in paths]
    shape = {k: v for k, v in planted.items() if k in ("slides", "shear")} | {
        "load_cell": recorded[0].external_force is not None
    }
    said = {"tactile": h.tactile, "randomize": h.randomize}
    true = [r.tactile.value for r in recorded]
    # training's contact is a straight line: of a rubber it has the spread over the taxels, at the force that the cell
    # measured
    given = (
        {"pressed": [np.maximum(r.external_force.value[:, 0], 0.0) for r in recorded]}
        if "rubber" in planted and recorded[0].external_force
        else {}
    )
    rms = []
    for k, settings in enumerate(({}, press_rig.as_trained(said))):
        other, _, _ = press_rig.record(folder / f"again{k}", len(paths), 8.0, seed=seed, **shape, **settings, **given)
        pairs = [(a, read(p, audit=False).tactile.value) for a, p in zip(true, other, strict=True)]
        rms.append([(a - b) * press_rig.LSB for a, b in pairs])
    on = [np.abs(a) > 0 for a in true]
    before, after = (
        float(np.sqrt(np.mean(np.concatenate([d[o] for d, o in zip(e, on, strict=True)]) ** 2))) for e in rms
    )
    again.append((before, after))
    return f"; in the sensor that trains {1e3 * before:.0f} -> {1e3 * after:.0f} mN"


if __name__ == "__main__":
    sys.exit(guard(main, sys.argv[1:]))
