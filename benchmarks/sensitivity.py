"""Which of the figures that decide (`dexsim.gap.rules`) change an answer when they are halved or doubled.

    python -m benchmarks.sensitivity [cases=a,b] [rooms=search,judge,touch,torque,belief] [figures=search.least,...]
                                     [factors=0.5,2] [seed=1] [out=out/sensitivity] [only=table]

A dozen short recordings, each with one known thing in it (or nothing): a pendulum of `benchmarks.planted`, a pendulum
that somebody pushes, and the press rig with its taxels; each diagnosed among a few effects, so that it takes seconds.
While one is diagnosed as the figures stand, the process forks where a figure is read for the first time: the child goes
on with that figure moved and writes its answer, the parent waits and goes on as it was. So a case is diagnosed only
from where a figure counts, and a figure that it never reads is not tried. A figure "x something" is moved by what is
left of it beyond 1 (`rules.moved`).

Of each figure and factor: in how many cases it was read, in how many the answer changed (verdict, names, sets or a
confidence by more than 0.02; apart from those: sizes by more than 1 % or their intervals by more than 10 %), and in how
many the first name was right before and is wrong after. Seeds are for learning. Resumable; only=table prints what there
is; figures= moves those alone (by default all of the rooms). Needs os.fork (Linux, macOS).
"""

from __future__ import annotations

import json
import math
import os
import signal
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

os.environ["OMP_NUM_THREADS"] = "1"  # a fork has none of its parent's threads

import mujoco
import numpy as np
import yaml

from benchmarks import planted, press_rig, tools
from dexsim.errors import UserError
from dexsim.gap import rules
from dexsim.gap.inquiry import Settings

SECONDS = 4.0  # of a recording of a pendulum
LONGEST = 60.0  # s of a core: a child that takes longer is ended
CONFIDENCE, SIZE, INTERVAL = 0.02, 0.01, 0.1  # changes of an answer beyond these count
OWN = {"cases": "", "rooms": "search,judge,touch,torque,belief", "figures": "", "factors": "0.5,2", "seed": "1",
       "out": "out/sensitivity", "only": ""}  # fmt: skip
DRY = {"coulomb_friction", "command_delay"}  # asked for beside what is planted


def _planted(kind: str, tier: str, number: int, *others: str) -> Callable[[Path, int], tuple[Settings, str]]:
    def made(folder: Path, seed: int) -> tuple[Settings, str]:
        planted.SECONDS = SECONDS
        truth = planted.make({"kind": kind, "tier": tier}, number, seed, folder)
        asked = DRY | set(others) | ({truth["effect"]} - {"none"})
        return _settings(folder, [folder / f"{x}.mcap" for x in "abc"], [folder / "d.mcap"], asked), truth["effect"]

    return made


def _settings(folder: Path, fitted: list[Path], held: list[Path], asked: set[str]) -> Settings:
    return Settings(fitted, folder / "out", held, str(folder / "rig.xml"), str(folder / "servo.yaml"),
                    next_recording=False, replay="none", allowed=asked)  # fmt: skip


def _pushed(folder: Path, seed: int) -> tuple[Settings, str]:
    """A pendulum with its torque logged, by exact inverse dynamics, that somebody pushes in the first recording."""
    from dexsim.recording import Writer

    rng = np.random.default_rng([seed, 7])
    b = planted.rig(rng, "effort") | {"voltage": False, "kp": 4.0, "kd": 0.1, "torque_limit": 3.0}
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "rig.xml").write_text(planted.model_xml(b), encoding="utf-8")
    (folder / "servo.yaml").write_text(yaml.safe_dump(planted.servo(b), sort_keys=False), encoding="utf-8")
    model = mujoco.MjModel.from_xml_string(planted.model_xml(b))
    data = mujoco.MjData(model)
    w = 2 * np.pi * np.array([0.21, 0.53, 0.93])
    t = np.arange(0.0, 8.0, 0.01)
    for k, name in enumerate("abcd"):
        phase, size = rng.uniform(0, 6, 3), np.array([0.5, 0.3, 0.15])
        q, v, a = (
            (size * w**n * np.sin(w * t[:, None] + phase + n * np.pi / 2)).sum(1) for n in range(3)
        )
        torque = np.empty_like(q)
        for i in range(len(t)):
            data.qpos[0], data.qvel[0], data.qacc[0] = q[i], v[i], a[i]
            mujoco.mj_inverse(model, data)
            torque[i] = data.qfrc_inverse[0]
        torque += b["coulomb_friction"] * np.sign(v) + b["viscous_friction"] * v
        if k == 0:
            for begin, end in ((2.0, 3.2), (5.5, 6.7)):
                inside = (t > begin) & (t < end)
                torque -= np.where(inside, 1.5 * b["weight"] * np.sin(np.pi * (t - begin) / (end - begin)), 0.0)
        command = q + (torque + b["kd"] * v) / b["kp"]
        torque = torque + 0.01 * b["weight"] * rng.standard_normal(len(t))
        read = np.round((q + 2e-4 * rng.standard_normal(len(t))) / planted.QUANTUM) * planted.QUANTUM
        meta = {"source": "sim", "robot": "rig", "gravity": "0 0 -9.81", "effort_is": "torque_Nm", "effort_sign": "+1"}
        with Writer(folder / f"{name}.mcap", ["joint"], meta, 1_000_000_000) as out:
            for i in range(len(t)):
                out.add_command(t[i], command[i : i + 1])
                out.add_state(t[i] + 1e-4, read[i : i + 1], None, torque[i : i + 1])
    files = [folder / f"{x}.mcap" for x in "abcd"]
    return _settings(folder, files[:3], files[3:], {"coulomb_friction", "viscous_friction"}), "external_force"


def _touch(truth: str, **hidden: Any) -> Callable[[Path, int], tuple[Settings, str]]:
    def made(folder: Path, seed: int) -> tuple[Settings, str]:
        paths, model, servo = press_rig.record(folder, 3, 4.0, seed=seed + 3, **hidden)
        asked = {"tactile_delay", "tactile_hysteresis", "contact_stiffness", "tactile_gain"}
        return Settings(paths, folder / "out", [], str(model), str(servo), next_recording=False, replay="none",
                        allowed=asked), truth  # fmt: skip

    return made


CASES: dict[str, Callable[[Path, int], tuple[Settings, str]]] = {
    "empty": _planted("", "none", 0, "inertia"),
    "delay": _planted("command_delay", "small", 1, "lag"),
    "friction": _planted("coulomb_friction", "small", 2, "viscous_friction"),
    "inertia": _planted("inertia", "medium", 4, "payload"),
    "payload": _planted("payload", "medium", 5, "inertia"),
    "sensor": _planted("position_scale", "medium", 6, "position_offset"),
    "effort": _planted("current_sensor", "medium", 7),
    "pushed": _pushed,
    "heat": _planted("thermal of the friction", "medium", 8, "thermal"),
    "backlash": _planted("backlash", "medium", 3),
    "touch": _touch("tactile_hysteresis", sensor={"hysteresis": 0.3, "hysteresis_time": 0.4}),
    "taxels": _touch("tactile_gain", gains={66: 0.5, 67: 0.0}, stuck={30: 0.0}),
}  # fmt: skip


class Forks:
    """Forks where a figure is read for the first time; `moved` is this process's own, (name, factor), in a child."""

    def __init__(self, figures: set[str], factors: list[float], done: set[tuple[str, float]], path: Path):
        self.figures, self.factors, self.done, self.path = figures, factors, done, path
        self.moved: tuple[str, float] | None = None
        self.seen: set[str] = set()

    def read(self, room: object, called: str, rule: str) -> None:
        name = f"{called}.{rule}"
        if self.moved or name in self.seen:
            return
        self.seen.add(name)
        for factor in self.factors if name in self.figures else ():
            if (name, factor) in self.done:
                continue
            child = os.fork()
            if child == 0:
                self.moved = name, factor
                signal.setitimer(signal.ITIMER_PROF, LONGEST)
                object.__setattr__(room, rule, rules.moved(name, factor))
                return
            if os.waitpid(child, 0)[1]:
                self.write(name, factor, {"verdict": "none in time", "findings": []})

    def write(self, name: str, factor: float, answer: dict) -> None:
        with self.path.open("a", encoding="utf-8") as f:
            f.write(json.dumps({"figure": name, "factor": factor, **answer}) + "\n")

    def __enter__(self) -> Forks:
        forks = self
        for called in ("search", "judge", "touch", "torque", "belief"):
            kind = type(getattr(rules.RULES, called))
            figures = set(kind.__dataclass_fields__)

            def get(room: object, rule: str, called: str = called, figures: set[str] = figures) -> Any:
                if rule in figures:
                    forks.read(room, called, rule)
                return object.__getattribute__(room, rule)

            kind.__getattribute__ = get
        return self

    def __exit__(self, *_: object) -> None:
        for called in ("search", "judge", "touch", "torque", "belief"):
            del type(getattr(rules.RULES, called)).__getattribute__


def answer(s: Settings) -> dict[str, Any]:
    """What a diagnosis says, in short."""
    from dexsim.gap.diagnosis import diagnose

    data = diagnose(s, say=lambda _: None).data
    return {
        "verdict": data["verdict"],
        "findings": [
            {"effect": f["effect"], "where": [f["where"]["joints"], f["where"]["taxels"]],
             "set": f["indistinguishable"], "confidence": f["confidence"], "parameters": f["parameters"]}
            for f in data["findings"]
        ],
    }  # fmt: skip


def case(name: str, s: dict[str, Any]) -> None:
    """Diagnoses one case as the figures stand and with each that it reads moved."""
    folder = Path(s["out"]) / f"seed_{s['seed']}"
    asked, truth = CASES[name](folder / "cases" / name, s["seed"])
    path = folder / f"{name}.jsonl"
    rows = _rows(path)
    forks = Forks(set(s["figures"]), s["factors"], {(r["figure"], r["factor"]) for r in rows}, path)
    with forks:
        try:
            found = answer(asked)
        except Exception as error:
            if not forks.moved:
                raise
            traceback.print_exc()
            found = {"verdict": f"failed: {type(error).__name__}: {error}", "findings": []}
        if forks.moved:
            forks.write(*forks.moved, found)
            os._exit(0)
    if not any(not r["figure"] for r in rows):
        forks.write("", 1.0, found | {"truth": truth})
    print(f"{name}: {_said(found)}; {len(forks.seen)} figures read", flush=True)


def _rows(path: Path) -> list[dict]:
    return [json.loads(x) for x in path.read_text(encoding="utf-8").splitlines()] if path.is_file() else []


def _said(a: dict) -> str:
    names = ", ".join(f"{f['effect']} {f['confidence']:.2f}" for f in a["findings"])
    return f"{a['verdict']} ({names or 'nothing named'})"


def changes(a: dict, b: dict) -> str:
    """How answer b differs from a: "answer", "sizes" or ""."""
    key = lambda x: [(f["effect"], f["where"], sorted(f["set"])) for f in x["findings"]]  # noqa: E731
    if a["verdict"] != b["verdict"] or key(a) != key(b):
        return "answer"
    pairs = list(zip(a["findings"], b["findings"], strict=True))
    if any(abs(x["confidence"] - y["confidence"]) > CONFIDENCE for x, y in pairs):
        return "answer"
    for x, y in pairs:
        if x["parameters"].keys() != y["parameters"].keys():
            return "sizes"
        for k, p in x["parameters"].items():
            r = y["parameters"][k]
            if isinstance(p["value"], str) or p["value"] is None:
                if p["value"] != r["value"]:
                    return "sizes"
                continue
            value, low, high = (np.asarray(p[e], float) for e in ("value", "low", "high"))
            other, under, over = (np.asarray(r[e], float) for e in ("value", "low", "high"))
            if value.shape != other.shape or np.any(abs(other - value) > SIZE * np.abs(value).max()):
                return "sizes"
            if np.any(abs((over - under) - (high - low)) > INTERVAL * (high - low).max()):
                return "sizes"
    return ""


def right(a: dict, truth: str) -> bool:
    """Whether the first name is what is there, and nothing is named where nothing is."""
    if truth == "none":
        return not a["findings"] and a["verdict"] == "none"
    return bool(a["findings"]) and truth in {a["findings"][0]["effect"], *a["findings"][0]["set"]}


def table(s: dict[str, Any]) -> dict[str, Any]:
    """Prints what there is; returns by figure and factor the cases in which it was read, changed and made wrong."""
    folder, out = Path(s["out"]) / f"seed_{s['seed']}", {}
    cases = {}
    for name in s["cases"]:
        rows = _rows(folder / f"{name}.jsonl")
        base = next((r for r in rows if not r["figure"]), None)
        if base is None:
            continue
        cases[name] = _said(base) + ("" if right(base, base["truth"]) else f"; wrong: it is {base['truth']}")
        for r in rows:
            if r["figure"]:
                of = out.setdefault(r["figure"], {}).setdefault(
                    f"{r['factor']:g}", {"read": [], "answer": [], "sizes": [], "wrong": []}
                )
                of["read"].append(name)
                if changed := changes(base, r):
                    of[changed].append(name)
                if right(base, base["truth"]) and not right(r, base["truth"]):
                    of["wrong"].append(name)
    for name, said in cases.items():
        print(f"{name:10} {said}")
    for figure in sorted(out):
        for factor, of in sorted(out[figure].items(), key=lambda x: float(x[0])):
            if of["answer"] or of["sizes"]:
                told = "; ".join(f"{k} {','.join(of[k])}" for k in ("answer", "wrong", "sizes") if of[k])
                print(f"{figure:24} x {factor:4} read in {len(of['read']):2}: {told}")
    still = sorted(f for f, by in out.items() if not any(of["answer"] or of["sizes"] for of in by.values()))
    print(f"read and without effect: {' '.join(still)}")
    unread = sorted({name for name, *_ in rules.described()} - set(out))
    print(f"read in no case: {' '.join(unread)}")
    return {"benchmark": "sensitivity", "cases": cases, "figures": out, "without_effect": still, "unread": unread}


def settings(argv: list[str]) -> dict[str, Any]:
    """Raises UserError naming the setting."""
    text, rest = tools.split(argv, OWN)
    if rest:
        raise UserError(f"'{rest[0]}' is not a setting; valid: {', '.join(OWN)} (key=value)")
    s: dict[str, Any] = {"out": text["out"], "only": text["only"]}
    for key, valid in (("cases", list(CASES)), ("rooms", OWN["rooms"].split(","))):
        s[key] = [x for x in text[key].split(",") if x] or valid
        if unknown := [x for x in s[key] if x not in valid]:
            raise UserError(f"{key}={text[key]}: {unknown[0]} is none; valid: {', '.join(valid)}")
    known = [name for name, *_ in rules.described()]
    s["figures"] = [x for x in text["figures"].split(",") if x] or [x for x in known if x.split(".")[0] in s["rooms"]]
    if unknown := [x for x in s["figures"] if x not in known]:
        raise UserError(f"figures={text['figures']}: {unknown[0]} is none; valid: {', '.join(known)}")
    if s["only"] not in ("", "table"):
        raise UserError(f"only={s['only']}: must be table, or not given")
    s["seed"] = tools.numbers(text["seed"], "seed")[0]
    try:
        s["factors"] = [float(x) for x in text["factors"].split(",")]
    except ValueError:
        s["factors"] = []
    if not s["factors"] or not all(0 < x < math.inf and x != 1 for x in s["factors"]):
        raise UserError(f"factors={text['factors']}: must be numbers above 0, none of them 1, e.g. factors=0.5,2")
    return s


def main(argv: list[str]) -> dict[str, Any]:
    """Runs the cases; prints the table and one JSON line."""
    from dexsim.sim.quiet import quiet_warp

    s = settings(argv)
    quiet_warp("cpu")
    for name in s["cases"] if s["only"] != "table" else ():
        case(name, s)
    return tools.report(table(s))


if __name__ == "__main__":
    tools.command(main, __doc__)
