"""`Task`: a task of your own in one file, declared by terms.

    from dexsim.tasks import Task, done, observe, reward

    class Lift(Task):
        \"\"\"Raise the box.\"\"\"

        @observe("rad", noise=0.003)
        def joint_position(self):
            return self.q

        @reward(2.0)
        def height(self, top=0.08):
            return (self.object_pose[:, 2] / top).clamp(0, 1)

    dexsim train task=my_tasks:Lift

A control step: `before_physics` (commands, events) -> physics, touch -> `update` -> terminations -> rewards -> metrics
-> masked reset (`begin`) -> observations.
"""

from __future__ import annotations

import copy
import re
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any, ClassVar

import torch

from dexsim import rotation, yaml_text
from dexsim.assets.objects import library
from dexsim.errors import UserError
from dexsim.paths import CONFIGS
from dexsim.tasks import registry
from dexsim.tasks.env import HandEnv
from dexsim.tasks.scenes import BASE, Jointed
from dexsim.tasks.servos import ServoRandomizer
from dexsim.tasks.stable_grasps import CUBE, GraspSet, held_poses
from dexsim.tasks.terms import Memory, Sensing, Term, memories_of, span, terms_of
from dexsim.tasks.watched import Watched, names

SWITCHES = ("actor", "critic")
STATE = (
    "q", "qd", "torque", "target", "action", "last_action", "object_pose", "object_velocity", "object_joint",
    "object_speed", "tips", "tip_force", "finger_force", "self_force", "palm_force", "reward", "done", "time_out",
    "nan", "obs", "engine", "servo", "touch", "objects", "sampler", "rng", "task", "cfg", "hand", "joints", "fingers",
    "pads", "commands", "last", "figures", "dt", "device", "num_envs", "num_actions",
)  # fmt: skip
"""What every environment holds by these names."""


class Task(HandEnv):
    """A task made of declared terms (`dexsim.tasks.terms`).

    A subclass may set: `scene`, what stands around the hand; `settings`, laid over `dexsim/configs/own_task.yaml`, part
    `task`; `randomize`, laid over its part `randomize`; `weights`, of rewards by name, over those of the decorators.

    Tensors of N worlds for terms, in the palm frame (of a hand on a base: the world's), SI units: q, qd, torque,
    target, action, last_action [N, J]; object_pose [N, 7] (x y z, w x y z), object_velocity [N, 6] (linear in the
    world, angular in the object's frame); tips [N, F, 3]; touch_force [N, P], touch_centre [N, P, 3] of the pads;
    tip_force, finger_force, self_force [N, F], palm_force [N]; episode_length_buf [N] control steps.
    """

    TAKES_OBJECTS = True
    choices: ClassVar[Mapping[str, Sequence[Any]]] = {}
    """Values that a setting of the task may have, by its name below `task`."""
    ranges: ClassVar[Mapping[str, tuple[float, float]]] = {
        "object.mass": (1e-3, 5.0), "object.friction": (0.05, 3.0), "object.com": (-0.25, 0.25),
        "object.scale": (0.05, 20.0), "contact.stiffness": (100.0, 1e5), "contact.damping_ratio": (0.0, 3.0),
    }  # fmt: skip
    """In what a range of `randomize` must lie; a subclass adds its own to those of its bases."""
    shapes: ClassVar[Mapping[str, tuple[float, float]]] = {}
    """In what a figure of `task.reward` must lie."""
    settings: ClassVar[Mapping[str, Any]] = {}
    weights: ClassVar[Mapping[str, float]] = {}
    randomize: ClassVar[Mapping[str, Any]] = {}

    def __init_subclass__(cls, **given: Any) -> None:
        super().__init_subclass__(**given)
        for name, value in vars(cls).items():
            is_term = isinstance(value, Memory) or hasattr(value, "_dexsim_term")
            before = next((vars(base)[name] for base in cls.__mro__[1:] if name in vars(base)), None)
            taken = before is not None and not isinstance(before, Memory) and not hasattr(before, "_dexsim_term")
            if is_term and (taken or (isinstance(value, Memory) and name in STATE)):
                raise UserError(f"{cls.__name__}.{name}: every task has something of this name; give it another")

    # -- from the class to settings
    @classmethod
    def config(cls) -> dict[str, Any]:
        """Return the settings that a run of this task starts from: groups "task" and "randomize"."""
        out = copy.deepcopy(_start())
        weights: dict[str, float] = {}
        for owner in reversed(cls.__mro__):
            own = vars(owner)
            _lay(out["task"], own.get("settings", {}))
            _lay(out["randomize"], own.get("randomize", {}) if isinstance(own.get("randomize"), Mapping) else {})
            weights |= own.get("weights", {})
        name = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", cls.__name__).lower()
        task = {"name": name, "class": registry.where_of(cls)} | out["task"]
        terms = terms_of(cls)
        unknown = sorted(set(weights) - {t.name for t in terms["reward"]})
        if unknown:
            raise UserError(f"task {name}: weights of {', '.join(unknown)}: there is no reward of that name")
        task |= _terms_settings(terms)
        task["rewards"] = {t.name: weights.get(t.name, t.options["weight"]) for t in terms["reward"]}
        for kind, part in (("reward", "reward"), ("done", "termination"), ("metric", "metric")):
            task[part] = {t.name: dict(t.params) for t in terms[kind] if t.params}
        return out | {"task": task}

    @classmethod
    def declared(cls) -> dict[str, Any]:
        """Return the settings of its terms as their decorators have them."""
        return _terms_settings(terms_of(cls))

    @classmethod
    def check_deployed(cls, source: str) -> None:
        """Raise UserError for a task whose machine is more than a hand."""
        if cls.scene.base is not None:
            raise UserError(
                f"{source}: its hand moves on a base of six servos, which the deployed loop does not drive; export a"
                " policy of a fixed hand, or drive base and hand from a loop of your own (docs/tutorials/real_hand.md)"
            )

    def __init__(
        self, cfg: dict, n_worlds: int, device: str, seed: int, engine: str = "auto", grasps: GraspSet | None = None
    ):
        """Build the worlds. grasps: what `hold` begins with, instead of the hand's own held poses."""
        self.grasps = grasps
        super().__init__(cfg, n_worlds, device, seed, engine)

    # -- setting up
    def setup(self) -> None:
        """Allocate what declared terms need; called once, before the first reset."""
        n, dev, t = self.num_envs, self.device, self.task
        self._terms = terms_of(type(self))
        self._check_names()
        self._check_reads()
        self._check_settings()
        self._complete()
        self._own = [
            name for owner in type(self).__mro__ for part in ("settings", "randomize")
            for name in names(vars(owner).get(part, {}), part.replace("settings", "task"))
        ]  # fmt: skip
        self._clean_read, self._is_clean = False, False
        for held in memories_of(type(self)).values():
            held.allocate(self)
        self.servo_random = ServoRandomizer(self.servo, self.sampler, BASE if self.scene.base is not None else ())
        self.end_names = (*(x.name for x in self._terms["done"] if t["terminations"][x.name]), "nan", "time_out")
        self.pull = torch.tensor(self.engine.mjm.opt.gravity, dtype=torch.float32, device=dev)
        self._sensed = []
        for x in self._terms["observe"]:
            given = t["observations"][x.name]
            named = {k: self._named(given[k]) for k in ("noise", "delay")}
            self._sensed.append(Sensing(x, {**given, **named}, f"task.observations.{x.name}"))
        self._history: torch.Tensor | None = None
        self.commands: dict[str, torch.Tensor] = {}
        self._remaining: dict[str, torch.Tensor] = {}
        self._due: dict[str, torch.Tensor] = {}
        for x in self._terms["event"]:
            if t["events"][x.name]["every_s"] is not None:
                self._due[x.name] = torch.zeros(n, device=dev)
        self.learned = torch.zeros((), device=dev)  # control steps of each world while training, for the curriculum
        self.last: dict[str, torch.Tensor] = {
            x.name: torch.zeros(n, device=dev) for x in self._terms["metric"] if not x.options["now"]
        }
        if self.scene.object is not None:
            self.set_objects()
        self.prepare_task()
        for x in self._terms["command"]:
            value = self._command_value(x)
            self.commands[x.name] = torch.zeros_like(value)
            self._remaining[x.name] = torch.zeros(n, device=dev)

    def prepare_task(self) -> None:
        """Allocate what the task needs beside declared memory; called once, before the first episode."""

    def adapt(self) -> Mapping[str, Mapping[str, Any]]:
        """Return options of observations, by name, that follow from other settings of the task; what
        `task.observations` says goes before them. May set `history`, whose setting is `task.history`."""
        self.history = self.task["history"]
        return {}

    def _complete(self) -> None:
        """Complete the settings of terms: a checkpoint may be older than a term, a task's file need not list them."""
        t, follow = self.task, self.adapt()
        if not (isinstance(self.history, int) and 1 <= self.history <= 64):
            raise UserError(f"task.history={self.history}: must be a whole number in [1, 64]")
        every = _terms_settings(self._terms)
        for name, more in follow.items():
            every["observations"][name] |= more
        for part, usual in every.items():
            _lay(usual, dict.get(t, part) or {})
            t[part] = Watched(usual, f"task.{part}", t.read)

    def _named(self, value: Any) -> Any:
        """Return a value, or the one of the setting of the task that it names."""
        if not isinstance(value, str):
            return value
        node: Any = self.task
        for part in value.split("."):
            node = node[part]
        return node

    def _check_settings(self) -> None:
        for owner in reversed(type(self).__mro__):
            for name, (low, high) in vars(owner).get("ranges", {}).items():
                if name in self.sampler.ranges:
                    self.sampler.check(name, low, high)
        c = self.task.get("curriculum") or {"steps": 0, "start": 1.0}
        if not (c["steps"] >= 0 and 0 <= c["start"] <= 1):
            raise UserError(f"task.curriculum={c}: steps must be 0 (none) or more, start must lie in [0, 1]")
        for name, known in self.choices.items():
            group, _, key = name.rpartition(".")
            values = self.task.get(group, {}) if group else self.task  # older checkpoints lack some
            if (value := values.get(key, known[0])) not in known:
                raise UserError(f"task.{name}={_word(value)}: must be {' or '.join(map(_word, known))}")

    def _check_names(self) -> None:
        t, known = self.task, {kind: [x.name for x in terms] for kind, terms in self._terms.items()}
        parts = (("observations", "observe"), ("terminations", "done"), ("commands", "command"), ("events", "event"))
        for part, kind in parts:
            for name in dict.get(t, part) or {}:
                if name not in known[kind]:
                    raise UserError(f"task.{part}.{name}: there is no such term; there are"
                                    f" {', '.join(known[kind]) or 'none'}")  # fmt: skip

    def _check_reads(self) -> None:
        """Raise UserError for a term that reads an object, or its joint, which the scene has not: it would be 0."""
        lacks = set() if isinstance(self.scene.object, Jointed) else {"object_joint", "object_speed"}
        lacks |= {"object_pose", "object_velocity", "object_spin"} if self.scene.object is None else set()
        for x in (x for terms in self._terms.values() for x in terms):
            reads = getattr(getattr(x.method, "__code__", None), "co_names", ())
            if "scene" not in reads and (wrong := sorted(lacks.intersection(reads))):
                raise UserError(f"{x.kind} {x.name}: reads {wrong[0]}, but the task's scene has none")

    def set_objects(self) -> None:
        """Find which rows of the scene's table are trained on, and how likely each is: every shape as likely as any,
        whatever the number of its baked sizes, in training times its `task.objects.emphasis`."""
        t, dev = self.task, self.device
        names = [v.shape.name for v in self.objects.scene.variants]
        groups = t["objects"]["train"], t["objects"]["held_out"]
        self.train_rows, self.held_rows = (
            torch.tensor([i for i, x in enumerate(names) if x in group], dtype=torch.long, device=dev)
            for group in groups
        )
        self._odds = torch.tensor([1.0 / names.count(x) for x in names], device=dev)
        emphasis = t["objects"].get("emphasis", {})
        for name, times in emphasis.items():
            if name not in library() or not 0 < times <= 100:
                raise UserError(
                    f"task.objects.emphasis: {name}: {times}: must name a shape ({', '.join(library())}) and be above"
                    " 0, at most 100"
                )
        self.emphasis = torch.tensor([float(emphasis.get(x, 1.0)) for x in names], device=dev)
        self.judge_kept_out(False)

    def judge_kept_out(self, kept_out: bool) -> None:
        """Begin episodes with objects kept out of the training from now on, or with those of it."""
        self.draw_from(self.held_rows) if kept_out else self.draw_from(self.train_rows, self.emphasis)

    def draw_from(self, rows: torch.Tensor, emphasis: torch.Tensor | None = None) -> None:
        """Draw objects of new episodes from these rows of the scene's table [R]: every shape equally often, or by
        its emphasis (one number a row of the table)."""
        weight = self._odds[rows] if emphasis is None else (self._odds * emphasis)[rows]
        self._rows, self._chances = rows, (weight / weight.sum()).cumsum(0)

    # -- what terms read
    @property
    def clean(self) -> bool:
        """Whether the value that is computed now is for the critic, which sees no faults of sensors."""
        self._clean_read = True
        return self._is_clean

    @property
    def touch_force(self) -> torch.Tensor:
        """Normal force on each pad [N, P], N."""
        return (self.touch.force_clean if self.clean else self.touch.force)[:, : self.pads]

    @property
    def touch_centre(self) -> torch.Tensor:
        """Centre of pressure of each pad [N, P, 3], m."""
        return (self.touch.centre_clean if self.clean else self.touch.centre)[:, : self.pads]

    @property
    def object_spin(self) -> torch.Tensor:
        """Angular velocity of the object in the world [N, 3], rad/s."""
        return rotation.rotate(self.object_pose[:, 3:], self.object_velocity[:, 3:])

    @property
    def age(self) -> torch.Tensor:
        """Time since each episode began [N], s."""
        return self._episode_length * self.dt

    def thing_pose(self, name: str) -> torch.Tensor:
        """Return pose [N, 7] of a further object of the scene."""
        at = self.q_of(f"{name}_free")
        return self.engine.t.qpos[:, at : at + 7].float()

    def joint_of(self, name: str) -> tuple[torch.Tensor, torch.Tensor]:
        """Return position [N] (rad or m) and speed [N] of a joint of an imported tree, "TREE/JOINT"."""
        return self.engine.t.qpos[:, self.q_of(name)].float(), self.engine.t.qvel[:, self.v_of(name)].float()

    # -- episodes
    def begin_episodes(self, mask: torch.Tensor) -> None:
        """Draw object, touch, drives; then `begin`, commands and events of the task."""
        for held in memories_of(type(self)).values():
            if held.reset:
                own = self.__dict__[held.name]
                own.masked_fill_(mask.view(-1, *(1,) * (own.dim() - 1)), 0)
        if self.scene.object is not None:
            self.draw_object(mask)
        self.touch.randomize(mask, self.rng)
        self.servo_random.draw(mask)
        gravity = self.engine.field("opt.gravity")
        torch.where(mask[:, None], self.pull.to(gravity.dtype), gravity, out=gravity)
        self.begin(mask)
        if self._terms["command"] or self._terms["event"]:  # which may ask where things are now
            self.engine.refresh()
            self.read_state()
        for row in self._sensed:
            row.begin(mask, self.sampler.uniform, self.dt)
        for x in self._terms["command"]:
            self.renew(x.name, mask)
        for x in self._terms["event"]:
            self._happen(x, mask)

    def begin(self, mask: torch.Tensor) -> None:
        """Put hand and object where an episode begins in the masked worlds, through `start`, `drop_object` or `hold`;
        by default the object falls on the open palm."""
        if self.scene.free and self.scene.base is None:
            self.drop_object(mask)
        else:
            self.start(mask)

    def draw_object(self, mask: torch.Tensor) -> None:
        """Draw the object of new episodes: which, how large, what of."""
        s = self.sampler
        pick = torch.searchsorted(self._chances, s.uniform()).clamp(max=len(self._chances) - 1)
        scale = self.unit * s.draw("object.scale")[:, None].expand(-1, 3)
        if "object.aspect" in s.ranges:
            scale = scale * s.draw("object.aspect", 3)
        self.draw_physics()
        self.give_object(mask, self._rows[pick], scale.contiguous())

    def draw_physics(self) -> None:
        """Draw what the next `give_object` gives beside shape and size."""
        s = self.sampler
        self._physics = {
            "mass": s.draw("object.mass"), "com": s.draw("object.com", 3), "friction": s.draw("object.friction"),
            "stiffness": s.draw("contact.stiffness"), "damping_ratio": s.draw("contact.damping_ratio"),
        }  # fmt: skip

    def give_object(self, mask: torch.Tensor, row: torch.Tensor, scale: torch.Tensor) -> None:
        """Give, where mask holds, an object by its row [N] of the scene's table, of `scale` [N, 3] times its shape's
        size where that is a box, sphere or capsule; its mass and friction as drawn."""
        self.objects.write(mask, row, scale=scale, **self._physics)
        here = self.touch if self.touch.shape_id.dim() == 1 else None
        ids, sizes = (self.touch.shape_id, self.touch.shape_size) if here is not None else (
            self.touch.shape_id[:, 0], self.touch.shape_size[:, 0])  # fmt: skip
        ids.copy_(self.objects.variant.to(torch.int32))
        sizes.copy_(self.objects.size)

    def pose(self, name: str) -> torch.Tensor:
        """Return joint angles [J] of the hand's pose "open" or "cupped", a base at 0."""
        angles = torch.zeros(self.num_actions, device=self.device)
        angles[: len(self.hand.joints)] = torch.as_tensor(self.hand.pose(name), dtype=torch.float32)
        return angles

    def start(
        self, mask: torch.Tensor, hand: str | torch.Tensor = "open", object_pose: torch.Tensor | None = None,
        target: torch.Tensor | None = None, also: Mapping[int, torch.Tensor] | None = None,
    ) -> torch.Tensor:  # fmt: skip
        """Place, where mask holds, the hand in a pose (its name, or [J] or [N, J] rad), give or take
        `randomize.initial.joint`, at rest, sent to `target` [N, J]; the object at object_pose [N, 7], which is
        returned. also: see `place`."""
        n = self.num_envs
        angles = (self.pose(hand) if isinstance(hand, str) else hand).expand(n, -1)
        off = self.sampler.draw("initial.joint", self.num_actions)
        if self.scene.base is not None:
            off = off.clone()
            off[:, len(self.hand.joints) :] = 0.0
        angles = torch.maximum(torch.minimum(angles + off, self.q_high), self.q_low)
        still = torch.zeros_like(self.object_velocity)
        pose = self.object_pose if object_pose is None else object_pose
        self.place(mask, angles, pose, still, target, also)
        return pose

    def drop_object(self, mask: torch.Tensor, above: float = 0.03, spread: float = 0.01) -> torch.Tensor:
        """Place, where mask holds, the open hand, and the object at rest in any orientation, `above` m over the palm
        and its own radius, give or take `spread` m aside. Returns its pose [N, 7]."""
        s = self.sampler
        where = torch.as_tensor(self.places.catch, dtype=torch.float32, device=self.device).expand(self.num_envs, 3)
        where = where.clone()
        where[:, :2] += spread * (2 * s.uniform(2) - 1)
        where[:, 2] += above + self.objects.radius
        return self.start(mask, "open", torch.cat([where, s.quaternion()], 1))

    def hold(self, mask: torch.Tensor) -> torch.Tensor:
        """Place, where mask holds, a box that lies firmly in the hand, as rotation begins (`dexsim stable-grasps`); its
        edge is `randomize.object.size`, m. Returns its pose [N, 7]."""
        s = self.sampler
        if self.grasps is None:
            edges = [self.unit * x for x in s.range("object.size")[:2]]
            with torch.inference_mode(False):
                self.grasps = held_poses(self.hand, self.task["initial"]["poses"]).within(*edges).to(self.device)
        g, box = self.grasps, torch.full((1,), self.shape_names.index(CUBE), device=self.device)
        pick = (s.uniform() * len(g)).long().clamp(max=len(g) - 1)
        row = torch.full_like(pick, self.shape_names.index(CUBE))
        nominal = self.objects.primitive_size(box, torch.ones(1, 3, device=self.device))
        self.give_object(mask, row, g.edge[pick][:, None] / 2 / nominal)
        self.place(mask, g.hand[pick], g.pose[pick], torch.zeros_like(self.object_velocity), g.target[pick])
        return g.pose[pick]

    # -- commands and events
    def _command_value(self, term: Term) -> torch.Tensor:
        value = term.method(self, **self._params("commands", term))
        return _columns(value, self.num_envs, f"command {term.name}").float()

    def renew(self, name: str, mask: torch.Tensor) -> None:
        """Draw a new value of a command where mask [N] holds."""
        term = next(x for x in self._terms["command"] if x.name == name)
        self.commands[name].copy_(torch.where(mask[:, None], self._command_value(term), self.commands[name]))
        low, high = span(self.task["commands"][name]["hold_s"], f"task.commands.{name}.hold_s")
        held = low if low == high else low + (high - low) * self.sampler.uniform()
        self._remaining[name].copy_(torch.where(mask, held, self._remaining[name]))

    def before_physics(self) -> None:
        """Widen ranges, change commands that are held long enough, and let events happen that are due."""
        c = self.task.get("curriculum") or {"steps": 0}
        if c["steps"]:
            self.learned += 1
            self.sampler.width.copy_((c["start"] + (1 - c["start"]) * self.learned / c["steps"]).clamp(max=1.0))
        for x in self._terms["command"]:
            low, _ = span(self.task["commands"][x.name]["hold_s"], f"task.commands.{x.name}.hold_s")
            if low != float("inf"):
                self._remaining[x.name] -= self.dt
                self.renew(x.name, self._remaining[x.name] <= 0)
        for x in self._terms["event"]:
            self._happen(x, None)

    def _happen(self, term: Term, begun: torch.Tensor | None) -> None:
        given = self.task["events"][term.name]
        if not given["on"]:
            return
        if given["every_s"] is None:
            if begun is not None:
                term.method(self, begun, **self._params("events", term))
            return
        low, high = span(given["every_s"], f"task.events.{term.name}.every_s")
        due = self._due[term.name]
        wait = low + (high - low) * self.sampler.uniform()
        if begun is not None:
            due.copy_(torch.where(begun, wait, due))
            return
        due -= self.dt
        now = due <= 0
        term.method(self, now, **self._params("events", term))
        due.copy_(torch.where(now, wait, due))

    def end_curriculum(self) -> None:
        """Draw from whole ranges from now on (evaluation)."""
        self.learned.fill_(float((self.task.get("curriculum") or {"steps": 0})["steps"]))
        self.sampler.width.fill_(1.0)

    def state_dict(self) -> dict[str, torch.Tensor]:
        return super().state_dict() | {"learned": self.learned.clone()}

    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        self.learned.copy_(state.get("learned", self.learned))
        super().load_state_dict(state)

    def push(self, force: torch.Tensor) -> None:
        """Pull at the object with a force [N, 3] N, in the world, from now until it is changed or an episode begins."""
        applied = self.engine.t.xfrc_applied
        applied[:, self.objects.body, :3] = force.to(applied.dtype)

    # -- terminations, rewards, metrics
    def update(self) -> None:
        """Move the task's own memory on: after physics, before terminations and rewards."""

    def _params(self, part: str, term: Term) -> dict[str, Any]:
        """Return a term's arguments as the settings have them."""
        if not term.params:
            return {}
        given = self.task.get(part, {}).get(term.name, {})
        return {name: given.get(name, usual) for name, usual in term.params.items()}

    def terminated(self) -> dict[str, torch.Tensor]:
        """Return the ends that are switched on."""
        self.update()
        on = [x for x in self._terms["done"] if self.task["terminations"][x.name]]
        return {x.name: x.method(self, **self._params("termination", x)) for x in on}

    def reward_words(self) -> dict[str, str]:
        """Describe each reward by its name, for the first screen."""
        return {x.name: x.text for x in terms_of(type(self))["reward"]}

    def rewards(self) -> dict[str, torch.Tensor]:
        """Return terms of a weight other than 0, weighted."""
        weights = self.task["rewards"]
        paid = [x for x in self._terms["reward"] if weights.get(x.name)]
        out = {x.name: weights[x.name] * x.method(self, **self._params("reward", x)) for x in paid}
        for x in self._terms["metric"]:
            self.figures[x.name] = x.method(self, **self._params("metric", x)).float()
        return out

    def _judge(self, ends: dict, terms: dict) -> tuple[torch.Tensor, torch.Tensor]:
        judged = super()._judge(ends, terms)
        for name, held in self.last.items():
            held.copy_(torch.where(self.done, torch.nan_to_num(self.figures[name]), held))
        return judged

    def figure_units(self) -> dict[str, str]:
        """Return units of the figures in `last`, which an evaluation reports."""
        return {x.name: x.unit for x in self._terms["metric"] if x.name in self.last}

    def metrics(self) -> dict[str, torch.Tensor]:
        """Return task metrics for the log, scalars on the device."""
        return {f"task/{name}": value.mean() for name, value in (self.figures | self.last).items()}

    # -- observations
    def actor_rows(self) -> list[Sensing]:
        """Return the rows that the actor sees."""
        return [x for x in self._sensed if self._named(self.task["observations"][x.term.name]["actor"])]

    def mirror_signs(self) -> torch.Tensor | None:
        """Return signs [A] by which the actor's observation changes where hand and world are mirrored, of the rows that
        say so (`observe(mirror=)`); None where none does."""
        rows = self.actor_rows()
        if not any(x.term.options["mirror"] for x in rows):
            return None
        signs: list[int] = []
        for x in rows:
            pattern = x.term.options["mirror"] or (1,)
            signs += [pattern[k % len(pattern)] for k in range(x.width)] * x.frames
        commanded = sum(v.shape[1] for k, v in self.commands.items() if self.task["commands"][k]["actor"])
        return torch.tensor((signs + [1] * commanded) * self.history, dtype=torch.float32, device=self.device)

    def sense(self, fresh: torch.Tensor) -> None:
        """Move sensors of the task's own on by a control step, before its observations; fresh [N]: an episode
        begins."""

    def observe(self, advance: bool) -> dict[str, torch.Tensor]:
        fresh = self._episode_length == 0
        if advance:
            self.sense(fresh)
        actor, critic = [], []
        commanded = [(x.name, self.task["commands"][x.name]) for x in self._terms["command"]]
        for row in self._sensed:
            given, value = self.task["observations"][row.term.name], None
            if self._named(given["actor"]):
                self._clean_read = False
                value = self._value(row, "width")
                row.twice = self._clean_read
                actor.append(row(value, self, fresh, advance))
            if self._named(given["critic"]):
                if value is None or row.twice:
                    self._is_clean = True
                    value = self._value(row, "clean_width")
                    self._is_clean = False
                row.clean_width = value.shape[1]
                critic.append(value)
        actor += [self.commands[name] for name, given in commanded if given["actor"]]
        critic += [self.commands[name] for name, given in commanded if given["critic"]]
        if not actor:
            raise UserError(f"task {self.task['name']}: the actor sees nothing; declare or switch on a row")
        seen = torch.where(self.nan[:, None], 0.0, torch.cat(actor, 1))
        if self.history > 1:
            seen = self._with_past(seen, fresh, advance)
        return {"actor": seen, "critic": torch.nan_to_num(torch.cat(critic, 1)) if critic else seen}

    def _value(self, row: Sensing, width: str) -> torch.Tensor:
        value, name = row.term.method(self, **row.params), row.term.name
        if isinstance(value, Mapping):
            parts = {k: _columns(v, self.num_envs, f"observation {name}, {k}") for k, v in value.items()}
            row.parts, value = {k: v.shape[1] for k, v in parts.items()}, torch.cat(list(parts.values()), 1)
        value = _columns(value, self.num_envs, f"observation {name}").float()
        if getattr(row, width) not in (0, value.shape[1]):
            raise UserError(f"observation {name}: had {getattr(row, width)} numbers, now {value.shape[1]}")
        setattr(row, width, value.shape[1])
        return value

    def _with_past(self, now: torch.Tensor, fresh: torch.Tensor, advance: bool) -> torch.Tensor:
        if self._history is None:
            with torch.inference_mode(False):
                self._history = torch.zeros(len(now), self.history, now.shape[1], device=self.device)
        moved = torch.cat([now[:, None], self._history[:, :-1]], 1)
        moved = torch.where(fresh[:, None, None], now[:, None].expand_as(moved), moved)
        if advance:
            self._history.copy_(moved)
        return moved.flatten(1)

    def memory(self) -> dict:
        own: dict[str, Any] = {}
        for name, held in memories_of(type(self)).items():
            value = self.__dict__[held.name]
            own[name] = value if value.is_floating_point() or value.dtype == torch.bool else (value, -(2**31), 2**31)
        for row in self._sensed:
            own |= row.memory()
        own |= {f"command.{k}": v for k, v in self.commands.items()}
        own |= {f"command_left.{k}": v for k, v in self._remaining.items()}
        own |= {f"event_due.{k}": v for k, v in self._due.items()} | {f"last.{k}": v for k, v in self.last.items()}
        if self._history is not None:
            own["history"] = self._history
        return super().memory() | own

    # -- what is said of it
    def describe(self) -> dict:
        """Return tables for the first screen: "observations" (name, width, what) by group, "action", "rewards",
        "terminations", "randomization", "notes", and "headline", names of the log that the console shows."""
        t = self.task
        groups: dict[str, list] = {"actor": [], "critic": []}
        for row in self._sensed:
            given = t["observations"][row.term.name]
            seen = [row.unit or "1", row.term.text, f"noise {row.noise:g}" if row.noise else ""]
            seen += [f"{row.delay[0]:g}-{row.delay[1]:g} s old" if row.delay[1] else ""]
            seen += [f"{100 * row.dropout:g} % lost" if row.dropout else ""]
            for group, times, width in (("actor", row.frames * self.history, row.width),
                                        ("critic", 1, row.clean_width)):  # fmt: skip
                if self._named(given[group]):
                    text = "; ".join(x for x in (seen if group == "actor" else (*seen[:2], "clean")) if x)
                    parts = row.parts or {row.term.name: width}
                    groups[group] += [(name, times * wide, text) for name, wide in parts.items() if wide]
        for x in self._terms["command"]:
            for group in SWITCHES:
                if t["commands"][x.name][group]:
                    wide = self.commands[x.name].shape[1] * (self.history if group == "actor" else 1)
                    groups[group].append((x.name, wide, f"{x.unit or '1'}; {x.text or 'command'}"))
        if not groups["critic"]:
            groups["critic"] = groups["actor"]
        ends, words = [(x.name, x.text) for x in self._terms["done"] if t["terminations"][x.name]], self.reward_words()
        return {
            "observations": groups,
            "action": self.action_rows(),
            "rewards": [(name, weight, words[name]) for name, weight in t["rewards"].items() if weight],
            "terminations": [*ends, ("nan", "state not finite"), ("time_out", f"{self.max_episode_length} steps")],
            "randomization": self.sampler.rows(),
            "notes": [*self.notes(), *self.hand_notes()],
            "headline": [f"task/{name}" for name in list(self.last)[:3]],
        }

    def notes(self) -> list[str]:
        """Say what else a reader of the first screen must know of the task."""
        return []


def _columns(value: torch.Tensor, n: int, what: str) -> torch.Tensor:
    """Return [N, D] of [N] or [N, ...]. Raises UserError."""
    if not isinstance(value, torch.Tensor) or value.dim() < 1 or value.shape[0] != n:
        shape = list(value.shape) if isinstance(value, torch.Tensor) else type(value).__name__
        raise UserError(f"{what}: gives {shape}, must be a tensor [{n}] or [{n}, ...], one row for each world")
    return value[:, None] if value.dim() == 1 else value.flatten(1)


def _terms_settings(terms: Mapping[str, list[Term]]) -> dict[str, dict[str, Any]]:
    """Return the settings of terms as their decorators have them."""
    return {
        "observations": {t.name: _observation(t) for t in terms["observe"]},
        "terminations": {t.name: True for t in terms["done"]},
        "commands": {
            t.name: {"hold_s": _plain(t.options["hold_s"]), **dict.fromkeys(SWITCHES, True), **_only(t), **t.params}
            for t in terms["command"]
        },
        "events": {t.name: {"on": True, "every_s": _plain(t.options["every_s"]), **t.params} for t in terms["event"]},
    }


def _observation(term: Term) -> dict[str, Any]:
    o = term.options
    return dict.fromkeys(SWITCHES, True) | _only(term) | {
        "noise": o["noise"], "delay": _plain(o["delay"]), "dropout": o["dropout"], "frames": o["frames"], **term.params
    }  # fmt: skip


def _only(term: Term) -> dict[str, bool]:
    only = term.options.get("only")
    known = (None, *SWITCHES, *("rows" for _ in range(term.kind == "command")))
    if only not in known:
        raise UserError(f"term {term.name}: only={only!r}: must be {', '.join(map(str, known[1:]))} or None")
    return {} if only is None else {s: s == only for s in SWITCHES}


def _word(value: Any) -> str:
    """Return a value as it is typed."""
    return str(value).lower() if isinstance(value, bool) else str(value)


def _plain(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value


@cache
def _start() -> dict[str, Any]:
    return yaml_text.load(CONFIGS / "own_task.yaml", "settings")


def _lay(onto: dict[str, Any], over: Mapping[str, Any]) -> None:
    """Lay nested settings over others, in place; ranges and lists as wholes."""
    for key, value in dict.items(over) if isinstance(over, dict) else over.items():  # of watched ones, none is read
        mine = onto.get(key)
        if isinstance(value, Mapping) and isinstance(mine, dict) and "log" not in (*value, *mine):
            _lay(mine, value)
        else:
            onto[key] = copy.deepcopy(dict(value) if isinstance(value, Mapping) else _plain(value))
