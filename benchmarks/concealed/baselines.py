"""What methods without names leave of the held-out error, on a subset of one-joint cases.

`mujoco.sysid` with all its parameters free (gains, torque limit, armature, damping, friction, mass, delay and bias of
the sensor); a fixed set as in PACE (armature, viscous and dry friction, delay, joint bias) by CMA-ES; a network that
corrects the simulated position. All see the recordings that `diagnose` may fit, and are judged in free run on the one
held out. `mujoco.sysid` needs `pip install "mujoco[sysid]"`; without it that line is left out and says so. Where the
hidden effect is a number that `mujoco.sysid` has too, its error is compared as well, and the time that each takes.
"""

from __future__ import annotations

import contextlib
import io
import json
import sys
import time
from pathlib import Path

import numpy as np
import yaml

from benchmarks.concealed import generate, score

DT = 1e-3
METHODS = ("believed", "pace", "network", "sysid")
LABELS = {"believed": "simulator as believed", "pace": "fixed set (PACE-like), CMA-ES", "network": "residual network",
          "sysid": "mujoco.sysid, all free",
          "diagnose": "diagnose"}  # fmt: skip

KINDS = {  # kind of the plant: key in the truth, mujoco.sysid's parameter, what that says about the key
    "coulomb": ("torque", "frictionloss", lambda x, b: x),
    "viscous": ("coefficient", "damping", lambda x, b: x),
    "inertia": ("armature", "armature", lambda x, b: x - b["armature"]),
    "payload": ("mass", "mass", lambda x, b: x - b["mass"]),
    "delay": ("delay", "delay", lambda x, b: x),
    "gain": ("kp_factor", "kp", lambda x, b: x / b["kp"]),
}


class Rig:
    """A one-joint case: recordings, and a plain simulation of the believed pendulum, [N] guesses at once."""

    def __init__(self, folder: Path):
        import mujoco

        from dexsim.recording import read

        model = mujoco.MjModel.from_xml_path(str(folder / "rig.xml"))
        servo = yaml.safe_load((folder / "servo.yaml").read_text(encoding="utf-8"))
        j = servo["joints"]["joint0"]
        self.folder, self.voltage = folder, servo["drive"] == "voltage"
        self.weight = float(model.body_mass[1] * 9.81 * -model.body_ipos[1, 2])
        self.link = float(model.body_mass[1] * model.body_ipos[1, 2] ** 2 + model.body_inertia[1, 1])
        self.believed = {"kp": j["kp"], "kd": j["kd"], "limit": j["torque_limit"], "speed": j["no_load_speed"],
                         "dry": j["coulomb_friction"],
                         "viscous": j["viscous_friction"], "armature": float(model.dof_armature[0]), "delay": 0.0,
                         "bias": 0.0}  # fmt: skip
        # as KINDS reads it; mujoco.sysid's kp of a voltage drive is a torque's
        self.meant = {
            "armature": self.believed["armature"],
            "mass": float(model.body_mass[1]),
            "kp": j["kp"] * (j["torque_limit"] if self.voltage else 1.0),
        }
        self.runs = []
        for letter in generate.RECORDINGS:
            r = read(folder / f"{letter}.mcap")
            t, q = np.asarray(r.states.position.t), r.states.position.value[:, 0]
            ct, c = np.asarray(r.commands.t), r.commands.value[:, 0]
            grid = np.arange(0, t[-1] + 2 * DT, DT)
            self.runs.append((t, q, c[np.clip(np.searchsorted(ct, grid + 1e-9, side="right") - 1, 0, len(c) - 1)]))

    def simulate(self, guess: dict[str, np.ndarray], run: int) -> tuple[np.ndarray, np.ndarray]:
        """(position at the samples [N, S], the same every millisecond [N, M]) of parameter guesses [N], in free run."""
        t, measured, command = self.runs[run]
        p = {k: np.asarray(guess.get(k, v), float) for k, v in self.believed.items()}
        N = max(np.size(v) for v in p.values())
        p = {k: np.broadcast_to(v, (N,)) for k, v in p.items()}
        late = p["delay"] / DT
        at = np.arange(len(command))[:, None] - late[None]
        targets = np.interp(at, np.arange(len(command)), command)
        inertia = self.link + p["armature"]
        q = np.full(N, measured[:3].mean()) - p["bias"]
        v, out = np.zeros(N), np.empty((len(command), N))
        for k in range(len(command)):
            out[k] = q + p["bias"]
            raw = p["kp"] * (targets[k] - q - p["bias"]) - p["kd"] * v
            if self.voltage:
                tau = p["limit"] * (np.clip(raw, -1, 1) - v / p["speed"])
            else:
                room = p["limit"] * np.maximum(1 - np.abs(v) / p["speed"], 0)
                tau = np.clip(raw, -room, room)
            free = v + DT * (tau - self.weight * np.sin(q)) / inertia
            stop = DT * p["dry"] / inertia  # dry friction takes speed away, never turns it round
            v = (np.sign(free) * np.maximum(np.abs(free) - stop, 0)) / (1 + DT * p["viscous"] / inertia)
            q = q + DT * v
        grid = np.arange(len(command)) * DT
        return np.stack([np.interp(t, grid, x) for x in out.T]), out.T

    def error(self, guess: dict[str, np.ndarray], runs: range) -> np.ndarray:
        """Free-run RMSE [N] rad over runs."""
        return np.sqrt(np.mean([np.mean((self.simulate(guess, r)[0] - self.runs[r][1]) ** 2, 1) for r in runs], 0))


FIT, HELD = (
    range(len(generate.RECORDINGS) - generate.HELD),
    range(len(generate.RECORDINGS) - generate.HELD, len(generate.RECORDINGS)),
)


def cma(
    objective, low: np.ndarray, high: np.ndarray, start: np.ndarray, generations: int, seed: int, size: int = 12
) -> np.ndarray:
    """Minimises objective([size, n]) within bounds by CMA-ES (Hansen 2016, standard constants); returns the best
    point."""
    rng, n = np.random.default_rng(seed), len(low)
    mu = size // 2
    w = np.log(mu + 0.5) - np.log(np.arange(1, mu + 1))
    w /= w.sum()
    m_eff = 1 / (w**2).sum()
    cs, cc = (m_eff + 2) / (n + m_eff + 5), (4 + m_eff / n) / (n + 4 + 2 * m_eff / n)
    c1 = 2 / ((n + 1.3) ** 2 + m_eff)
    cmu = min(1 - c1, 2 * (m_eff - 2 + 1 / m_eff) / ((n + 2) ** 2 + m_eff))
    damp = 1 + 2 * max(0, np.sqrt((m_eff - 1) / (n + 1)) - 1) + cs
    chi = np.sqrt(n) * (1 - 1 / (4 * n) + 1 / (21 * n * n))
    mean, sigma, C = (start - low) / (high - low), 0.2, np.eye(n)
    ps, pc = np.zeros(n), np.zeros(n)
    best, best_f = mean, np.inf
    for g in range(generations):
        D, B = np.linalg.eigh(C)
        D = np.sqrt(np.maximum(D, 1e-14))
        y = (rng.normal(size=(size, n)) * D) @ B.T
        x = np.clip(mean + sigma * y, 0, 1)
        f = objective(low + x * (high - low))
        order = np.argsort(f)
        if f[order[0]] < best_f:
            best, best_f = x[order[0]], f[order[0]]
        y = (x[order[:mu]] - mean) / sigma
        step = w @ y
        mean = mean + sigma * step
        ps = (1 - cs) * ps + np.sqrt(cs * (2 - cs) * m_eff) * (B @ ((B.T @ step) / D))
        h = np.linalg.norm(ps) / np.sqrt(1 - (1 - cs) ** (2 * (g + 1))) < (1.4 + 2 / (n + 1)) * chi
        pc = (1 - cc) * pc + h * np.sqrt(cc * (2 - cc) * m_eff) * step
        C = (1 - c1 - cmu) * C + c1 * np.outer(pc, pc) + cmu * (y.T * w) @ y
        sigma *= float(np.exp((cs / damp) * (np.linalg.norm(ps) / chi - 1)))
    return low + best * (high - low)


def pace(rig: Rig, seed: int = 0, generations: int = 80) -> float:
    """Held-out RMSE [rad] of the fixed set."""
    b = rig.believed
    keys = ("armature", "viscous", "dry", "delay", "bias")
    low = np.array([0.0, 0.0, 0.0, 0.0, -0.2])
    high = np.array([4 * (rig.link + b["armature"]), 0.3 * rig.weight, 1.2 * rig.weight, 0.1, 0.2])
    start = np.clip(np.array([b[k] for k in keys]), low + 0.02 * (high - low), high)
    x = cma(lambda x: rig.error(dict(zip(keys, x.T, strict=True)), FIT), low, high, start, generations, seed)
    return float(rig.error(dict(zip(keys, x[:, None], strict=True)), HELD)[0])


def network(rig: Rig, seed: int = 0, epochs: int = 250) -> float:
    """Held-out RMSE [rad] of the believed simulator plus a network's correction of its position, from a third of a
    second of its own motion and of the commands (nothing measured goes in)."""
    import torch

    torch.manual_seed(seed)
    torch.set_num_threads(1)
    lags = np.array([0, 5, 10, 20, 40, 70, 110, 160, 230, 320])

    def features(r: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        t, q, command = rig.runs[r]
        at, sim = rig.simulate({}, r)
        sim = sim[0]
        speed = np.gradient(sim, DT)
        i = np.maximum((t / DT).astype(int)[:, None] - lags[None], 0)
        return np.concatenate([sim[i], command[i] - sim[i], 0.1 * speed[i], np.sign(speed[i])], 1), q - at[0], at[0]

    data = [features(r) for r in (*FIT, *HELD)]
    x, y = np.concatenate([d[0] for d in data[: len(FIT)]]), np.concatenate([d[1] for d in data[: len(FIT)]])
    mean, std, scale = x.mean(0), x.std(0) + 1e-6, y.std() + 1e-9
    net = torch.nn.Sequential(
        torch.nn.Linear(x.shape[1], 64), torch.nn.ELU(), torch.nn.Linear(64, 64), torch.nn.ELU(), torch.nn.Linear(64, 1)
    )
    tensor = lambda a: torch.as_tensor(a, dtype=torch.float32)  # noqa: E731
    X, Y = tensor((x - mean) / std), tensor(y / scale)[:, None]
    adam = torch.optim.AdamW(net.parameters(), 2e-3, weight_decay=1e-2)
    for _ in range(epochs):
        for batch in torch.randperm(len(X)).split(256):
            adam.zero_grad()
            ((net(X[batch]) - Y[batch]) ** 2).mean().backward()
            adam.step()
    with torch.no_grad():
        left = [d[1] - scale * net(tensor((d[0] - mean) / std))[:, 0].numpy() for d in data[len(FIT) :]]
    return float(np.sqrt(np.mean(np.concatenate(left) ** 2)))


def identify(rig: Rig, iterations: int = 30, free: tuple[str, ...] = ()) -> tuple[dict[str, float], float] | None:
    """What `mujoco.sysid` finds, {name: value} (SI units; kp and kd of a voltage drive times its torque limit), and its
    held-out RMSE [rad]; None where it is not installed. free: the parameters to fit, all nine where none are named."""
    import mujoco

    try:
        from mujoco import sysid as s

        # the package is there without its dependencies too, but empty
        from mujoco.sysid import ParameterDict  # noqa: F401
        from mujoco.sysid._src.timeseries import SignalType  # noqa: F401
    except ImportError:
        return None
    b = rig.believed
    kp, kd = (
        (b["kp"] * b["limit"], b["kd"] * b["limit"] + b["limit"] / b["speed"]) if rig.voltage else (b["kp"], b["kd"])
    )
    spec = mujoco.MjSpec.from_file(str(rig.folder / "rig.xml"))
    spec.option.timestep, spec.option.integrator = 2 * DT, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    joint = spec.joint("joint0")
    joint.damping, joint.frictionloss = [b["viscous"], 0, 0], b["dry"]
    motor = spec.add_actuator(
        name="servo",
        target="joint0",
        trntype=mujoco.mjtTrn.mjTRN_JOINT,
        gaintype=mujoco.mjtGain.mjGAIN_FIXED,
        biastype=mujoco.mjtBias.mjBIAS_AFFINE,
    )
    motor.gainprm[0], motor.biasprm[1], motor.biasprm[2] = kp, -kp, -kd
    motor.forcelimited, motor.forcerange = True, [-b["limit"], b["limit"]]
    spec.add_sensor(
        name="position", type=mujoco.mjtSensor.mjSENS_JOINTPOS, objtype=mujoco.mjtObj.mjOBJ_JOINT, objname="joint0"
    )
    model = spec.compile()
    mass0 = float(model.body_mass[1])

    def put(name: str):
        def change(spec, p):
            x = float(p.value[0])
            joint, motor = spec.joint("joint0"), spec.actuator("servo")
            if name == "damping":
                joint.damping = [x, 0, 0]
            elif name in ("armature", "frictionloss"):
                setattr(joint, name, x)
            elif name == "mass":
                spec.geom("bob0").mass = x
            elif name == "limit":
                motor.forcerange = [-x, x]
            elif name == "kp":
                motor.gainprm[0], motor.biasprm[1] = x, -x
            else:
                motor.biasprm[2] = -x

        return change

    ranges = {"armature": (b["armature"], 0.0, 4 * (rig.link + b["armature"])),
              "damping": (b["viscous"], 0.0, 0.3 * rig.weight), "frictionloss": (b["dry"], 0.0, 1.2 * rig.weight),
              "mass": (mass0, 0.5 * mass0, 3 * mass0), "kp": (kp, 0.25 * kp, 4 * kp), "kd": (kd, 0.1 * kd, 6 * kd),
              "limit": (b["limit"], 0.1 * b["limit"], 1.5 * b["limit"])}  # fmt: skip
    free = free or (*ranges, "delay", "bias")
    params = s.ParameterDict(
        {k: s.Parameter(k, v, lo, hi, modifier=put(k)) for k, (v, lo, hi) in ranges.items() if k in free}
    )
    transform = s.SignalTransform()
    if "delay" in free:
        params.add(s.Parameter("delay", 0.005, 0.0, 0.1))
        transform.delay("*", params["delay"])
    if "bias" in free:
        params.add(s.Parameter("bias", 0.001, -0.2, 0.2))
        transform.bias("*", params["bias"], target="predicted")

    def sequences(runs: range):
        states, controls, sensors = [], [], []
        for r in runs:
            t, q, command = rig.runs[r]
            grid = np.arange(len(command)) * DT
            states.append(s.create_initial_state(model, np.array([q[:3].mean()])))
            controls.append(s.TimeSeries.from_control_names(grid[::2], command[::2, None], model))
            sensors.append(s.TimeSeries.from_names(t, q[:, None], model))
        return [s.ModelSequences("rig", spec, [f"r{r}" for r in runs], states, controls, sensors)]

    transform.normalize = False
    fit = s.build_residual_fn(models_sequences=sequences(FIT), modify_residual=transform.apply, n_threads=1)
    with contextlib.redirect_stdout(io.StringIO()):
        found, _ = s.optimize(params, fit, optimizer="mujoco", verbose=False, max_iters=iterations)
    judge = s.build_residual_fn(models_sequences=sequences(HELD), modify_residual=transform.apply, n_threads=1)
    left, _, _ = judge(found.as_vector(), found)
    values = {k: float(found[k].value[0]) for k in free}
    return values, float(np.sqrt(np.mean(np.concatenate([x.ravel() for x in left]) ** 2)))


def one(folder: Path, kept: Path) -> None:
    """Errors of one case by method, and their times [s]; written to `kept`."""
    rig, out = Rig(folder), {}
    for name, method in (
        ("believed", lambda r: float(r.error({}, HELD)[0])),
        ("pace", pace),
        ("network", network),
        ("sysid", identify),
    ):
        start = time.perf_counter()
        try:
            out[name] = method(rig)
            if name == "sysid" and out[name] is not None:
                out["sysid_values"], out[name] = out[name]
                out["meant"] = rig.meant
        except Exception as error:  # a method that breaks down on a case has its say: the believed simulator's error
            out[name], out[f"{name}_failed"] = out.get("believed"), f"{type(error).__name__}: {error}"[:200]
        out[f"{name}_s"] = round(time.perf_counter() - start, 1)
    kept.parent.mkdir(parents=True, exist_ok=True)
    kept.write_text(json.dumps(out), encoding="utf-8")


def comparable(made: list[dict], root: Path, count: int) -> list[dict]:
    """The first `count` one-joint cases whose effect moves the joint and stands out of the floor, of those made ({name,
    digest})."""
    out = []
    for m in made:
        if len(out) == count:
            break
        truth = generate.reveal(root / "truth" / f"{m['name']}.json", m["digest"])
        if (
            truth["group"] == "effect"
            and truth["shape"] == "one"
            and truth["tier"] in ("easy", "medium")
            and truth["effects"][0]["effect"] != "current_sensor"
        ):
            out.append(m)
    return out


def compare(compared: list[dict], results: list[dict], root: Path) -> dict:
    """Errors of all methods on those of the cases `compared` of which the diagnosis and the others' answers are
    there."""
    kept = {m["name"]: root / "baselines" / f"{m['name']}.json" for m in compared}
    pick = [r for r in results if r["name"] in kept and kept[r["name"]].is_file()]
    found = [json.loads(kept[r["name"]].read_text(encoding="utf-8")) for r in pick]
    rows = []
    digests = {m["name"]: m["digest"] for m in compared}
    for r, f in zip(pick, found, strict=True):
        truth = generate.reveal(root / "truth" / f"{r['name']}.json", digests[r["name"]])
        h = (
            json.loads((root / "diagnoses" / r["name"] / "diagnosis.json").read_text(encoding="utf-8")).get("held_out")
            or {}
        )
        seconds = float((root / "diagnoses" / r["name"] / "seconds").read_text(encoding="utf-8"))
        rows.append(
            {
                "name": r["name"],
                "hidden": r["hidden"][0][0],
                "floor": truth["floor"],
                "diagnose": h.get("after"),
                "diagnose_s": seconds,
                **f,
                "parameter": _parameter(truth["effects"][0], root / "diagnoses" / r["name"] / "diagnosis.json", f),
            }
        )
    lines = {}
    for method in (*METHODS, "diagnose"):
        ratio = [x[method] / x["floor"] for x in rows if x.get(method)]
        if ratio:
            low, high = score.bootstrap(ratio, np.median)
            lines[method] = {
                "value": float(np.median(ratio)),
                "low": low,
                "high": high,
                "n": len(ratio),
                "seconds": float(np.median([x.get(f"{method}_s", 0.0) for x in rows if x.get(method)])),
            }
            errors = [x["parameter"][method] for x in rows if x["parameter"] and method in x["parameter"]]
            if errors:
                lines[method] |= {"parameter": float(np.median(errors)), "parameters": len(errors)}
    return {"lines": lines, "cases": rows}


def _parameter(effect: dict, diagnosis: Path, found: dict) -> dict[str, float] | None:
    """Relative errors of the hidden number by `diagnose` (1 where it does not name the effect) and by `mujoco.sysid`;
    None where the latter has no such number or is not there."""
    if effect["kind"] not in KINDS or "sysid_values" not in found:
        return None
    key, name, read = KINDS[effect["kind"]]
    value = effect["parameters"][key]
    said = json.loads(diagnosis.read_text(encoding="utf-8"))["findings"]
    ours, _ = score._parameters(
        next((f for f in said if f["effect"] == effect["effect"]), None), {"parameters": {key: value}}
    )
    return {
        "sysid": abs(read(found["sysid_values"][name], found["meant"]) - value) / abs(value),
        "diagnose": ours[0] if ours else 1.0,
    }


def show(others: dict) -> str:
    """The comparison as text."""
    out = [
        f"{'held-out error over the floor, median':<44}{'value':>8}   {'95 % interval':<18}{'n':>4}   time   error"
        " of the hidden number"
    ]
    for k, v in others["lines"].items():
        number = f"   {100 * v['parameter']:.0f} % ({v['parameters']})" if "parameter" in v else ""
        out.append(
            f"{LABELS[k]:<44}{v['value']:>8.2f}   {v['low']:.2f} .."
            f" {v['high']:<12.2f}{v['n']:>4}{v['seconds']:>6.0f} s{number}"
        )
    if others["cases"] and "sysid" not in others["lines"]:
        out.append('mujoco.sysid is not installed: pip install "mujoco[sysid]"')
    return "\n".join(out)


if __name__ == "__main__":
    one(Path(sys.argv[1]), Path(sys.argv[2]))
