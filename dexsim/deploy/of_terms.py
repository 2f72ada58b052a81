"""Tasks of declared terms on a real hand: the same methods that build the observation in simulation, computed from what
a hand measures.

An export runs every observation that the actor sees with signals in place of the simulation, and writes what it
computes as a network (`observation.onnx`) into the bundle: a robot needs no code of the task. A method that asks for
what no hand measures is refused by name. Noise, delay and dropout stay behind: a real hand has its own.
"""

from __future__ import annotations

import types
from typing import Any

import numpy as np
import torch

from dexsim.calibration.file import Calibration
from dexsim.deploy.driver import HandState
from dexsim.deploy.measure import POSE, Given, Measure, commanded, floats32
from dexsim.errors import UserError
from dexsim.tasks.task import STATE, Task
from dexsim.tasks.terms import Memory

OPTIONS = ("vision", "shape")


def signals(joints: int, fingers: int, pads: int) -> dict[str, tuple[int, ...]]:
    """Return what a hand of so many joints, fingers and touch pads tells, by the name that a task has for it, and its
    shape.

    q rad, qd rad/s, torque N.m (from currents), target rad and action (the last ones sent); touch_force N and
    touch_centre m of the pads; tips m; age s since the policy began; object_pose (x y z m, w x y z), from something
    that sees it; palm frame."""
    return {
        "q": (joints,), "qd": (joints,), "torque": (joints,), "target": (joints,), "action": (joints,),
        "touch_force": (pads,), "touch_centre": (pads, 3), "tips": (fingers, 3), "age": (), "object_pose": (7,),
    }  # fmt: skip


class Signals:
    """A task as its observations see it on a real hand: signals for what is measured, the task's own constants and
    methods for all else; whatever a hand does not tell is refused. asked: the signals that were used."""

    def __init__(self, task: Task, given: dict[str, torch.Tensor], term: str = ""):
        self.__dict__.update(_task=task, _given=given, _term=term, used={})

    def __getattr__(self, name: str) -> Any:
        task, given = self._task, self._given
        if name in given:
            self.used[name] = None
            return given[name]
        if name == "commands":
            return _Commands(self)
        if name == "clean":
            return False
        if name == "num_envs":
            return 1
        own = getattr(type(task), name, None)
        if isinstance(own, property) and own.fget is not None:
            return own.fget(self)
        if isinstance(own, types.FunctionType):
            return types.MethodType(own, self)
        if isinstance(own, Memory) or name in STATE or name in ("last", "_episode_length", "episode_length_buf"):
            if name in ("dt", "device", "fingers", "pads", "joints", "hand", "task", "cfg", "num_actions"):
                return getattr(task, name)
            raise UserError(
                f"observation {self._term}: asks for {name}, which a real hand does not tell; a hand tells"
                f" {', '.join(given)}, and what the policy is told (@command). Let only the critic see it"
                ' (only="critic"), or build it from those'
            )
        return getattr(task, name)


class _Commands:
    def __init__(self, owner: Signals):
        self._owner = owner

    def __getitem__(self, name: str) -> torch.Tensor:
        return getattr(self._owner, f"command {name}")


class Observation(torch.nn.Module):
    """The values of all rows that the actor sees [1, D], from signals in the order of `names`."""

    def __init__(self, task: Task):
        super().__init__()
        self.task = task
        self.rows = task.actor_rows()
        shapes = signals(len(task.hand.joints), task.fingers, task.pads)
        self.shapes = shapes | {f"command {k}": (v.shape[1],) for k, v in task.commands.items()}
        self.names = self._used()

    def _used(self) -> list[str]:
        """Return signals that the rows use, found by computing them once."""
        zeros = {k: torch.zeros(1, *shape) for k, shape in self.shapes.items()}
        zeros["object_pose"][:, 3] = 1.0
        used: dict[str, None] = {}
        for row in self.rows:
            view = Signals(self.task, zeros, row.term.name)
            self._value(row, view)
            used |= view.used
        commanded = [k for k, x in self.task.task["commands"].items() if x["actor"]]
        return [*used, *(f"command {k}" for k in commanded if f"command {k}" not in used)]

    def _value(self, row: Any, view: Signals) -> torch.Tensor:
        value = row.term.method(view, **row.params)
        return (value[:, None] if value.dim() == 1 else value.flatten(1)).float()

    def forward(self, *given: torch.Tensor) -> torch.Tensor:
        """See the class."""
        by_name = dict(zip(self.names, given, strict=True))
        out = [self._value(row, Signals(self.task, by_name, row.term.name)) for row in self.rows]
        commanded = [k for k, x in self.task.task["commands"].items() if x["actor"]]
        return torch.cat([*out, *(by_name[f"command {k}"] for k in commanded)], 1)

    def of_env(self) -> dict[str, torch.Tensor]:
        """Return the signals as the simulation has them, of its first world, without noise."""
        env = self.task
        now = {name: getattr(env, name) for name in self.shapes if not name.startswith("command ")}
        now |= {f"command {k}": v for k, v in env.commands.items()}
        return {name: now[name][:1].clone().float() for name in self.names}


def check(m: Any) -> None:
    """Raise UserError for a manifest that lacks what a task of terms needs."""
    if m.terms is None:
        raise UserError(f"task={m.task} is none of this dexsim's, and the manifest has no terms")
    seen = {r.name for r in m.observation}  # a command may be known to other rows only
    wide = sum(r.width * r.frames for r in m.terms.rows) + sum(len(v) for k, v in m.terms.commands.items() if k in seen)
    if wide * m.terms.history != m.policy.observation_size:
        size = m.policy.observation_size
        raise UserError(f"terms give {wide * m.terms.history} numbers, policy.observation_size is {size}")


def rows(env: Task) -> list[tuple[str, int, str, str]]:
    """Return name, width, unit and source of each row that the actor of a task sees."""
    seen = [(r.term.name, r.width * r.frames * env.history, r.unit or "1", r.term.options["real"] or r.term.text)
            for r in env.actor_rows() if r.width]  # fmt: skip
    commanded = [(k, v) for k, v in env.commands.items() if env.task["commands"][k]["actor"]]
    return seen + [(k, v.shape[1] * env.history, "1", "told") for k, v in commanded]


def parts(env: Task) -> dict[str, Any]:
    """Return the parts of a manifest that are a task's own, but for the network's digest."""
    from dexsim.deploy.manifests import floats, grip

    of = Observation(env)
    width = env.sampler.width.clone()
    env.sampler.width.fill_(0.0)  # the middle of every range
    env.reset_all()
    env.sampler.width.copy_(width)
    out: dict[str, Any] = {
        "initial_pose": floats(env.q[0]), "rates": {}, "normalization": {},
        "terms": {
            "signals": {name: int(np.prod(of.shapes[name], dtype=int)) for name in of.names},
            "rows": [{"name": r.term.name, "width": r.width, "frames": r.frames} for r in of.rows],
            "history": int(env.history),
            "commands": {k: floats(v[0]) for k, v in env.commands.items() if f"command {k}" in of.names},
        },
        "perception": {"object_pose": "something that sees where the object is and how it is turned, palm frame"
                       if "object_pose" in of.names else "none", "critic": "not deployed"},
    }  # fmt: skip
    if env.grasps is not None:
        held = grip(env.grasps)
        out |= {"grip": held, "initial_pose": held["hand"]}
    return out


class Measured(Measure):
    """A task of declared terms: keeps the last readings of rows with several frames, and the last angles."""

    def __init__(self, bundle: Any, calibration: Calibration):
        super().__init__(bundle, calibration)
        from dexsim.deploy import bundle as bundles

        self.terms = self.manifest["terms"]
        self.session = bundles.network(bundle.path / bundles.TERMS, self.terms["sha256"])
        self.tau_max = np.array(self.manifest["normalization"]["tau_max"])
        hand = calibration.hand
        known = signals(len(hand.joints), len(hand.fingers), len(calibration.gain))
        self.names = list(self.terms["signals"])
        self.shapes = {name: known.get(name, (self.terms["signals"][name],)) for name in self.names}
        self.needs = POSE if "object_pose" in self.names else None
        self.commands = {k: np.array(v, np.float32) for k, v in self.terms["commands"].items()}

    def reset(self) -> None:
        """Begin a new episode, without a past."""
        self._frames: list[np.ndarray] = []
        self._past: np.ndarray | None = None
        self.hand.forget()
        self._steps = 0

    def commanded(self, given: Any) -> list[float]:
        """Return the numbers of the declared commands in a row, by default the bundle's. Raises UserError."""
        usual = [float(x) for v in self.commands.values() for x in v]
        return commanded(given, usual, str(self.manifest["task"]))

    def signals(
        self, state: HandState, seen: np.ndarray | None, command: list[float], target: np.ndarray, action: np.ndarray
    ) -> Given:
        """See `Measure.observe`; seen [7]: the object's pose, where the policy needs it."""
        c = self.calibration
        tips, force, centre = self.touched(state)
        numbers = iter(command)
        age, self._steps = self._steps * self.period, self._steps + 1
        return floats32(
            q=state.position, qd=self.hand.velocity(state), target=target,
            torque=c.torque_norm(np.asarray(state.current, float) * 1e-3) * self.tau_max,
            action=np.clip(np.nan_to_num(action), -1.0, 1.0), touch_force=force, touch_centre=centre, tips=tips,
            age=age, object_pose=seen, **{f"command {k}": [next(numbers) for _ in v] for k, v in self.commands.items()}
        )  # fmt: skip

    def built(self, given: Given) -> np.ndarray:
        feed = {_input(k): given[k].reshape(1, *self.shapes[k]) for k in self.names}
        flat = self.session.run(["rows"], feed)[0][0]
        fresh, rows, at = not self._frames, [], 0
        for k, row in enumerate(self.terms["rows"]):
            value = flat[at : at + row["width"]]
            at += row["width"]
            if fresh:
                self._frames.append(np.tile(value, (row["frames"], 1)))
            else:
                self._frames[k] = np.concatenate([value[None], self._frames[k][:-1]])
            rows.append(self._frames[k].ravel())
        whole = np.concatenate([*rows, flat[at:]])
        if self._past is None:
            self._past = np.tile(whole, (self.terms["history"], 1))
        else:
            self._past = np.concatenate([whole[None], self._past[:-1]])
        return self._past.reshape(1, -1).astype(np.float32)


def _input(name: str) -> str:
    """Return a signal's name in the network."""
    return name.replace(" ", "_")


def write(env: Task, path: Any, opset: int) -> Observation:
    """Write the network from signals to rows; returns it."""
    of = Observation(env).eval()
    given = tuple(of.of_env().values())
    torch.onnx.export(of, given, str(path), dynamo=False, opset_version=opset,
                      input_names=[_input(k) for k in of.names], output_names=["rows"])  # fmt: skip
    return of


__all__ = ["OPTIONS", "Measured", "check", "parts", "rows", "signals", "write"]
