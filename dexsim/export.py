"""A policy bundle: dexsim export checkpoint=... out=DIR; dexsim export check=DIR."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from dexsim import files
from dexsim.errors import UserError
from dexsim.typed import defaults, settings, truth, whole

USAGE = """usage: dexsim export checkpoint=FILE out=DIR [key=value ...]
       dexsim export check=DIR

Write a policy as one folder that a robot can run:

  DIR/policy.onnx     observation -> action, the observations' normalization inside, one file
  DIR/manifest.yaml   what every number of the observation is; joints, fingers, actions, rates, calibration, perception
  DIR/golden.npz      inputs and outputs of this machine, which check=DIR recomputes with onnxruntime
  DIR/config.yaml     the training's settings, for the simulated hand

settings (key=default):
  checkpoint=         policy.pt, last.pt or model_*.pt
  out=                a new or empty folder
  calibration=        calibration.yaml of dexsim calibrate (default: nothing measured, assumptions stated)
  check=              a bundle to recompute
  steps=64            golden rows from a simulated episode; as many again are drawn at random
  seed=0              of both
  mirror=false        true: for the mirror image of the trained hand, a left one of a right one's policy
  task=               module:Class of a task of your own that the checkpoint names, and no installed package provides
  agent.NAME=         a class of your own that the checkpoint names (agent.actor.class_name=package.module:Class);
                      typed here, its code runs
"""
KEYS = defaults(USAGE)
TOLERANCE = 1e-5
OPSET = 17


def main(argv: Sequence[str]) -> int:
    """Returns the exit status. Raises UserError."""
    given = settings(argv, KEYS, ("agent.",))
    if "task" in given:
        from dexsim.tasks import registry

        registry.find(given["task"])
    if "check" in given:
        if len(given) > 1:
            raise UserError("check=DIR goes alone")
        return 0 if check(given["check"]) else 1
    typed = frozenset((k, v) for k, v in given.items() if k.startswith("agent."))
    given = KEYS | given
    for key in ("checkpoint", "out"):
        if not given[key]:
            raise UserError(f"say {key}=... (dexsim export --help)")
    out = export(
        given["checkpoint"], given["out"], given["calibration"] or None, whole("steps", given["steps"], 2, 100_000),
        whole("seed", given["seed"]), typed, truth("mirror", given["mirror"]),
    )  # fmt: skip
    return 0 if check(out) else 1


def export(
    checkpoint: str, out: str | Path, calibration: str | None = None, steps: int = 64, seed: int = 0,
    typed: frozenset[tuple[str, Any]] = frozenset(), mirror: bool = False,
) -> Path:  # fmt: skip
    """Write the bundle of a checkpoint; returns its folder. typed: see `dexsim.learning.names`. mirror: for the mirror
    image of its hand. Raises UserError."""
    from dexsim import outputs
    from dexsim.calibration.file import Calibration
    from dexsim.console import folders
    from dexsim.deploy import bundle, measure
    from dexsim.learning import checkpoint as checkpoints
    from dexsim.learning import teacher
    from dexsim.learning.ppo import load_policy
    from dexsim.sim.quiet import quiet_warp
    from dexsim.tasks import registry
    from dexsim.tasks.building import hand_of

    data = checkpoints.load(checkpoint)
    registry.task_class(data["config"], str(checkpoint)).check_deployed(str(checkpoint))
    if (sees := teacher.groups(data["config"]["agent"])) != ["actor"]:
        raise UserError(
            f"{checkpoint}: its policy acts by the observations {', '.join(sees)}, which no hand measures; let a"
            f" student learn from it: dexsim train agent=distill agent.teacher.checkpoint={checkpoint}"
        )
    config = data["config"] | ({"hand_mirror": not data["config"].get("hand_mirror", False)} if mirror else {})
    measured = None if calibration is None else Calibration.load(calibration, hand=hand_of(config))
    out = Path(out).expanduser()
    if out.is_dir():
        outputs.recover(out)  # what an export that was killed left
    if out.is_dir() and any(out.iterdir()):
        raise UserError(f"out={out}: already holds files; choose another folder")
    out = folders.make(out, "out=")
    import numpy as np
    import torch
    import yaml

    from dexsim.tasks import make_env

    quiet_warp("cpu")
    torch.manual_seed(seed)
    cfg = config | {"device": "cpu", "worlds": 1}
    print("building the task, for its scales and for golden episodes ...", flush=True)
    env = make_env(cfg, 1, "cpu", seed, "mujoco")
    checkpoints.check_layout(data, checkpoints.layout_of(env), checkpoint)
    policy = load_policy(data, env, str(checkpoint), typed)
    model = policy.as_onnx(verbose=False).eval().to("cpu")

    with outputs.staged(out) as part:  # the whole bundle or none
        path = part / bundle.POLICY
        with warnings.catch_warnings():  # the exporter in one file is the one that torch calls legacy
            warnings.simplefilter("ignore")
            keeps = _state(model)
            batch = {"observation": {0: "batch"}, "action": {0: "batch"}} if not keeps else None
            given = (torch.zeros(1, env.obs["actor"].shape[1]), *(torch.zeros(n, 1, m) for n, m in keeps.values()))
            torch.onnx.export(model, given, str(path), dynamo=False, opset_version=OPSET,
                              input_names=["observation", *(f"{k}_in" for k in keeps)],
                              output_names=["action", *(f"{k}_out" for k in keeps)], dynamic_axes=batch)  # fmt: skip
            of = measure.of(env.task["name"])
            if hasattr(of, "write"):
                of.write(env, part / bundle.TERMS, OPSET)
        rows = golden(env, policy, model, steps, seed)
        np.savez_compressed(part / bundle.GOLDEN, **rows)
        measured = Calibration.default(env.effort.double().numpy(), env.hand) if measured is None else measured
        m = manifest(env, data, measured, path, len(rows["observation"]))
        if keeps:
            m["policy"]["state"] = {k: list(shape) for k, shape in keeps.items()}
        if not env.hand.comes_along:
            _copy_hand(env.hand, part / bundle.HAND)
        (part / bundle.MANIFEST).write_text(yaml.safe_dump(m, sort_keys=False, width=120), encoding="utf-8")
        (part / bundle.CONFIG).write_text(yaml.safe_dump(config, sort_keys=False), encoding="utf-8")
    (out / outputs.WRITTEN).unlink(missing_ok=True)  # a bundle is never written twice
    for text in measured.assumed:
        print(f"note     {text}")
    print(f"policy   {checkpoints.provenance(data)}")
    print(f"bundle   {out}")
    return out


def _state(model: Any) -> dict[str, tuple[int, int]]:
    """Return what a recurrent network carries from step to step, by name: layers and size; empty for any other."""
    if not getattr(model, "is_recurrent", False):
        return {}
    return dict.fromkeys(("h", "c") if model.rnn_type == "lstm" else ("h",), (model.num_layers, model.hidden_size))


def _actions(model: Any, rows: Any, begins: list[bool]) -> Any:
    """Return actions [n, A] of observations [n, D]; a recurrent network's in order, its state zero where an episode
    begins."""
    import torch

    keeps = _state(model)
    if not keeps:
        return model(rows)
    out: list[Any] = []
    state: tuple[Any, ...] = ()
    for row, fresh in zip(rows, begins, strict=True):
        if fresh:
            state = tuple(torch.zeros(n, 1, m) for n, m in keeps.values())
        action, *new = model(row[None], *state)
        state = tuple(x for x in new if x is not None)
        out.append(action)
    return torch.cat(out)


MOST_HAND = 256 << 20
"""Bytes of a hand's folder that a bundle carries."""


def _copy_hand(hand: Any, out: Path) -> None:
    """Copy the hand's whole folder into the bundle: the simulated hand needs it, and a robot its kinematics."""
    import shutil

    from dexsim.hand import load_hand

    files = [p for p in hand.folder.rglob("*") if p.is_file()]
    size = sum(p.stat().st_size for p in files)
    if size > MOST_HAND:
        raise UserError(
            f"hand {hand.folder}: {size / 2**20:.0f} MiB in its folder, a bundle carries {MOST_HAND >> 20} MiB; put"
            " hand.yaml, the model and its meshes into a folder of their own"
        )
    shutil.copytree(hand.folder, out)
    try:
        load_hand(out, hand.mirror, hand.scale)
    except UserError as error:
        raise UserError(
            f"hand {hand.folder}: cannot be carried, what it names must lie in its folder ({error})"
        ) from None


def golden(env: Any, policy: Any, model: Any, steps: int, seed: int) -> dict[str, Any]:
    """Return inputs and outputs of this machine: `steps` observations of a simulated episode with the signals, targets
    before and after they were built from and led to, and as many random observations. Of a task of declared terms
    without the noise, delay and dropout of its readings. begins: where an episode does."""
    import torch

    from dexsim.deploy import measure

    of = measure.of(env.task["name"])
    terms = None if hasattr(of, "ROWS") else of.Observation(env)
    for row in env._sensed if terms else ():  # without the noise, delay and dropout of their readings
        row.noise, row.dropout, row.delay = 0.0, 0.0, (0.0, 0.0)
    series: dict[str, list] = {}
    env.rng.manual_seed(seed)
    with torch.no_grad():
        env.reset_all()
        begins = True
        for _ in range(steps):
            obs, signals = env.get_observations(), terms.of_env() if terms else of.signals_of(env)
            now = {f"signal_{name}": value[0].clone() for name, value in signals.items()}
            now |= {"observation": obs["actor"][0], "begins": torch.tensor(begins), "q": env.q[0].clone(),
                    "before": env.target[0].clone()}  # fmt: skip
            env.step(policy(obs))
            begins = bool(env.done[0])
            if begins:
                continue  # the target is the new episode's
            for name, value in (now | {"target": env.target[0].clone()}).items():
                series.setdefault(name, []).append(value)
    if not series:
        raise UserError(f"task {env.task['name']}: each of {steps} control steps ended an episode; nothing to compare")
    rng = torch.Generator().manual_seed(seed)
    episode = torch.stack(series.pop("observation"))
    spread = episode.mean(0) + 3 * episode.std(0).clamp(min=0.05) * torch.randn(steps, episode.shape[1], generator=rng)
    with torch.no_grad():
        everything = torch.cat([episode, spread])
        action = _actions(model, everything, [bool(x) for x in series["begins"]] + [True] * steps)
    out = {k: torch.stack(v).numpy() for k, v in series.items()}
    return out | {"observation": everything.numpy(), "action": action.numpy()}


def manifest(env: Any, data: dict[str, Any], calibration: Any, policy: Path, golden_rows: int) -> dict[str, Any]:
    """Return everything that a robot must know, as plain data."""
    from dexsim.deploy import bundle, measure
    from dexsim.deploy.manifests import floats
    from dexsim.deploy.of_terms import rows
    from dexsim.learning.ppo import action_noise
    from dexsim.tactile.layout import touch_shape

    hand, (pads, taxels) = env.hand, touch_shape(env.hand)
    task, cfg = env.task, data["config"]
    of = measure.of(task["name"])
    own, labels = of.parts(env), getattr(of, "ROWS", {})
    scaling = own.pop("scaling", {})
    if "terms" in own:
        own["terms"]["sha256"] = bundle.sha256(policy.with_name(bundle.TERMS))
    table, at = [], 0
    for name, width, unit, source in rows(env):
        _, frame, order = labels.get(name, (unit, "palm", "as declared"))
        table.append({"name": name, "start": at, "stop": at + width, "unit": unit, "frame": frame, "order": order,
                      "scaling": scaling.get(name, "none"), "source": source})  # fmt: skip
        at += width
    if (past := next((r for r in env.actor_rows() if r.frames > 1), None)) and labels:
        raise UserError(f"task.observations.{past.term.name}.frames={past.frames}: the deployed loop keeps no past of"
                        " this row; export a policy that was trained without it")  # fmt: skip
    action = {"mode": task["action"]["mode"], "scale": float(task["action"]["scale"]),
              "lead": floats(env.lead()) if task["action"]["lead"] is None else float(task["action"]["lead"]),
              "clip": [-1.0, 1.0], "unit": "rad", "low": floats(env.q_low), "high": floats(env.q_high),
              "speed_limit_rad_s": floats(hand.speeds), "order": "joints"}  # fmt: skip
    if (spread := action_noise(data["actor"])) is not None:  # for noise=
        action["std"] = floats(spread)
    return {
        "format": bundle.FORMAT, "version": bundle.VERSION, "task": task["name"],
        "policy": {"file": bundle.POLICY, "sha256": bundle.sha256(policy), "input": "observation", "output": "action",
                   "observation_size": at, "action_size": env.num_actions, "opset": OPSET, "dtype": "float32",
                   "normalization": "inside: feed the observation as the table below states it"},
        "observation": table,
        "hand": {"name": hand.name, "folder": None if hand.comes_along else bundle.HAND, "mirror": hand.mirror,
                 "scale": hand.scale},
        "joints": list(hand.joints), "fingers": list(hand.finger_names),
        "taxels": {"per_finger": taxels, "pads": pads, "layout": hand.robot,
                   "index": f"column * {hand.fingers[0].pad.rows} + row" if pads and hand.fingers[0].pad.rows else
                   "order of the pad's file"},
        "action": action,
        "initial_pose": own.pop("initial_pose"),
        "rates": {"policy_period_s": env.dt, "policy_hz": round(1 / env.dt, 4), "read_hz": 100.0} | own.pop("rates"),
        "normalization": {"tau_max": floats(env.effort)} | own.pop("normalization"),
        "calibration": calibration.to_dict(),
        **own,
        "servo": cfg["servo"],
        "golden": {"file": bundle.GOLDEN, "rows": golden_rows, "tolerance": TOLERANCE},
        "versions": _versions(data),
        "trained": {"iteration": int(data["iteration"]), "steps": int(data["steps"]), "git": data["git"]},
    }  # fmt: skip


def _versions(data: dict[str, Any]) -> dict[str, Any]:
    from dexsim.version import VERSION, installed

    here = {"dexsim": VERSION} | installed("torch", "onnx", "onnxruntime", "numpy", "mujoco")
    return {"bundle": 1, "exported_with": here, "trained_with": {k: str(v) for k, v in data["versions"].items()}}


def check(path: str | Path) -> bool:
    """Recompute a bundle's golden outputs with onnxruntime and its golden observations with the builder; prints
    the largest differences. False where one is beyond the manifest's tolerance."""
    import numpy as np

    from dexsim.deploy import bundle, measure
    from dexsim.deploy.action import ActionRule

    b = bundle.load(path)
    m = b.manifest
    file = b.path / bundle.GOLDEN
    rule = ActionRule.from_manifest(m["action"])
    try:
        rows = files.arrays(file)
        observation, expected = rows["observation"], rows["action"]
        n = len(rows["q"])
        built = _rebuilt(measure.of(m["task"]), b, rows) - observation[:n]
        begins = [*rows["begins"], *[True] * (len(observation) - n)] if "begins" in rows else [True] * len(observation)
        single = _in_order(b, observation, begins)
        whole = single if b.recurrent else b.act(observation)
        targets = np.stack(
            [rule.target(a, t, q) for a, t, q in zip(whole[:n], rows["before"], rows["q"], strict=True)]
        )
        aimed = targets - rows["target"]
        single - expected, whole - expected
    except KeyError as error:
        raise UserError(f"{file}: lacks {error}; export the bundle again") from None
    except Exception as error:  # of a damaged archive; onnxruntime's, numpy's and torch's for arrays of another shape
        why = " ".join(str(error).split())[:160]
        raise UserError(f"{file}: cannot be read, or does not fit the bundle ({why}); export it again") from None
    relative = lambda x, y: np.abs(x - y) / np.maximum(1.0, np.abs(y))  # noqa: E731 (random rows give actions far over 1)
    found = {
        "actions": float(relative(whole, expected).max()),
        "actions, one row at a time": float(relative(single, expected).max()),
        "observations": float(np.abs(built).max()),
        "targets [rad]": float(np.abs(aimed).max()),
    }
    limit = float(m["golden"]["tolerance"])
    for name, value in found.items():
        print(
            f"golden   {name}: largest difference {value:.2g} over {len(observation)} rows"
            f" ({'ok' if value <= limit else 'FAILED'})"
        )
    good = all(v <= limit for v in found.values())
    if not good:
        print(
            f"golden   FAILED: allowed {limit:g}; this onnxruntime computes otherwise than the exporting machine",
            file=sys.stderr,
        )
    return good


def _in_order(b: Any, observation: Any, begins: list[bool]) -> Any:
    """Return actions [n, A] of observations [n, D], one after another; begins: where an episode does."""
    import numpy as np

    out = []
    for row, fresh in zip(observation, begins, strict=True):
        if fresh:
            b.begin()
        out.append(b.act(row[None]))
    return np.concatenate(out)


def _rebuilt(of: Any, b: Any, rows: dict[str, Any]) -> Any:
    """Return the golden observations [n, D], built from the golden signals as the loop builds them."""
    import numpy as np

    built = of.Measured(b, b.calibration)
    signals = {k.removeprefix("signal_"): x.astype(np.float32) for k, x in rows.items() if k.startswith("signal_")}
    out = []
    for k in range(len(rows["q"])):
        if "begins" not in rows or rows["begins"][k]:
            built.reset()
        out.append(built.built({name: x[k] for name, x in signals.items()})[0])
    return np.stack(out)
