"""The step loop that every task shares: servo, physics, touch, terminations, rewards, masked reset, observations.

    action --scale, clip--> targets --[ servo | physics ] x K, touch--> terminations -> rewards -> reset -> observations

Nothing here reads from the device: decisions are masks, buffers live as long as the environment.
"""

from __future__ import annotations

import copy
import math
import os
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import mujoco
import numpy as np
import torch
import warp as wp
from tensordict import TensorDict

from dexsim import files, model_file, rotation
from dexsim.actuator.servo import Servo
from dexsim.actuator.table import ServoTable
from dexsim.assets.objects.own import named
from dexsim.errors import UserError
from dexsim.hand import Hand, load_hand
from dexsim.hand.couplings import Couplings
from dexsim.hand.places import places
from dexsim.hand.skin import tip_skins
from dexsim.sim import ContactPair, make_engine
from dexsim.sim.make import engine_of, newton_iterations
from dexsim.sim.memory import give_back
from dexsim.sim.scene import OBJECT, OBJECT_FIELDS, SLOTS, hand_object_scene
from dexsim.sim.warmup import compile_side_by_side
from dexsim.tactile.layout import hand_layout, tip_layout
from dexsim.tactile.shapes import ShapeSet
from dexsim.tactile.tactile import Tactile
from dexsim.tasks import nan_dump, object_kernel, randomize, servos, state_kernels, worlds
from dexsim.tasks.nan_dump import NanDump
from dexsim.tasks.objects import Objects
from dexsim.tasks.randomize import Sampler
from dexsim.tasks.reality import Reality, present
from dexsim.tasks.recorded import Constants, unrecordable
from dexsim.tasks.scenes import BASE, Scene, Slide, fasten, furnish, mount
from dexsim.tasks.structs import filled
from dexsim.tasks.watched import Watched, unread

if TYPE_CHECKING:

    class VecEnv:
        """Stand for rsl-rl's class, which says nothing of its types: a wrong name on an environment is then seen."""

else:
    from rsl_rl.env import VecEnv

MOST_NAN = 0.2
"""Share of world-steps that may be not finite between two calls of `HandEnv.check`."""
MOST_GROUPS = 4
"""Groups of observations that a task may have."""
UNIT_SPAN = 0.1
"""m, `span` of the hand that the lengths in task settings are for; they are multiplied by span / UNIT_SPAN."""
UNIT_PALM = 0.025
"""m, height of that hand's palm over the origin of its palm frame."""


def contact_pairs(hand: Hand, root: str, parts: Sequence[str] = ()) -> tuple[ContactPair, ...]:
    """Contact pairs of the hand scenes, F fingers: fingertip on object (0 .. F-1), whole finger on object (F .. 2F-1),
    palm on object (2F), distal link on the hand itself (2F+1 .. 3F), then fingertips on each of the bodies `parts`. A
    fingertip of several geoms counts as its whole distal link. root: the hand's root body."""
    obj = ("body", OBJECT)
    tips = [("geom", f.geoms[0]) if len(f.geoms) == 1 else ("body", f.body) for f in hand.fingers]
    return (
        *(ContactPair(f"tip_{f.name}", tip, obj) for f, tip in zip(hand.fingers, tips, strict=True)),
        *(ContactPair(f"finger_{f.name}", ("subtree", f.root), obj) for f in hand.fingers),
        ContactPair("palm", ("body", hand.palm_body), obj),
        *(ContactPair(f"self_{f.name}", ("body", f.body), ("subtree", root)) for f in hand.fingers),
        *(
            ContactPair(f"tip_{f.name}:{body}", tip, ("body", body))
            for body in parts
            for f, tip in zip(hand.fingers, tips, strict=True)
        ),
    )


def hand_of(cfg: dict) -> Hand:
    """The hand of a resolved config; the xHand for checkpoints from before there was a choice. Raises UserError."""
    return load_hand(cfg.get("hand") or "xhand", cfg.get("hand_mirror", False), cfg.get("hand_scale", 1.0))


class HandEnv(VecEnv):
    """N hands with one object each. A task subclasses it; see `tasks/grasp.py`.

    Shapes: actions [N, J] in [-1, 1]; observations a TensorDict of "actor" [N, A] and "critic" [N, C]; rewards and
    dones [N]. J joints, F fingers, P touch pads (F, or 0 without touch) in the hand's order. Positions are in the palm
    frame, which is the world frame (the hand is fixed; gravity turns). `unit`: the hand's span over UNIT_SPAN;
    `rise`: m by which its palm is higher than that of the hand that heights in task settings are for.
    """

    scene: ClassVar[Scene] = Scene()
    """What the world holds beside the hand."""
    TAKES_OBJECTS: bool = False
    """Whether `objects=` and `kept_out=` may give it a user's own objects (`task.objects`)."""
    camera: ClassVar[dict[str, Any] | None] = None
    """View of a film: lookat [3] m, distance m, azimuth and elevation in degrees; None: the usual one."""
    given: Sequence[str] = ()
    """Names of settings that the user gave: after the first step each must have been read."""
    learning = True
    """False while an evaluation plays."""
    nan_count: torch.Tensor
    _reach: Any
    _moves: tuple[float, float]
    _reaches: torch.Tensor
    _act_args: list[Any]
    _wrong: torch.Tensor | None
    _sources: tuple[str, ...]

    def __init__(self, cfg: dict, n_worlds: int, device: str, seed: int, engine: str = "auto"):
        self.cfg, self.task, sim = cfg, Watched(cfg["task"], "task"), cfg["sim"]
        self.hand = hand_of(cfg)
        self.unit, self.places = self.hand.span / UNIT_SPAN, places(self.hand)
        self.rise = float(self.places.catch[2]) - self.unit * UNIT_PALM
        base = self.scene.base
        self.joints = self.hand.joints if base is None else (*self.hand.joints, *BASE)
        self.num_envs, self.device, self.num_actions = n_worlds, device, len(self.joints)
        self.fingers, self.pads = len(self.hand.fingers), len(self.hand.fingers) if self.hand.touches else 0
        self.decimation, self.dt = _periods(sim, self.task)
        if self.task["action"]["mode"] not in ("relative", "absolute"):
            raise UserError(f"task.action.mode={self.task['action']['mode']}: must be relative or absolute")
        self._check_rewards()
        self._length_limit = torch.zeros((), dtype=torch.long, device=device)
        self.max_episode_length = int(round(self.task["episode_s"] / self.dt))
        shapes = {} if self.scene.object is None else named(self.task["objects"])
        self.shape_names = list(shapes)
        spec = model_of(self.hand, cfg.get("model_file"))  # a checkpoint from before has none
        contact = self.task["contact"]
        d = contact["impedance"]
        if not 0.5 <= d < 1.0:
            raise UserError(f"task.contact.impedance={d}: must lie in [0.5, 1)")
        firm = contact.get("hand_impedance")  # links and palm; null, and in checkpoints from before: MuJoCo's default
        if firm is not None and not 0.5 <= firm < 1.0:
            raise UserError(f"task.contact.hand_impedance={firm}: must be null or lie in [0.5, 1)")
        root = spec.worldbody.bodies[0].name
        if base is not None:
            mount(spec, base)
        spec.option.timestep = sim["timestep"]
        table = None
        if self.scene.object is None:
            spec.worldbody.add_body(name=OBJECT, pos=[0.0, 0.0, -1e3])  # what pairs and touch name; nothing is there
        else:
            scales = [x * self.unit for x in self.task["objects"]["baked_scales"]]
            table = hand_object_scene(spec, [shapes[s] for s in self.shape_names], scales, sim["timestep"])
            if not self.scene.free:
                spec.delete(spec.joint("object_free"))
                fasten(spec.body(OBJECT), self.scene.object, spec)  # type: ignore[arg-type]  # not free, not None
        self.furniture = furnish(spec, self.scene)
        tips, joints = set(self.hand.tip_geoms), {*self.hand.joints, *self.hand.couplings.passive}
        for geom in spec.geoms:
            if geom.name in tips:
                geom.solimp = [d, d, 1e-3, 0.5, 2.0]
            elif firm is not None:  # the object's too: MuJoCo takes the mean of two that touch
                geom.solimp = [firm, firm, 1e-3, 0.5, 2.0]
        for joint in spec.joints:
            if joint.name in joints:
                # stiffer dry friction than MuJoCo's default, in which a stuck joint creeps; stiffer yet, and Newton
                # needs many more iterations (measured: 99th percentile 9 at 0.9999, 5 here)
                joint.solimp_friction, joint.solref_friction = [0.97, 0.99, 1e-3, 0.5, 2.0], [0.02, 1.0]
        _solver_options(spec, sim, engine_of(engine, device), self.scene.table is not None)
        self.rng = torch.Generator(device=device)
        self.rng.manual_seed(seed)
        # another world to be judged in
        self.reality = Reality(cfg["reality"], self.rng, self.hand) if present(cfg) else None
        if self.reality is not None:
            self.reality.change_model(spec)
        self._drawn: mujoco.MjModel | None = None
        self._frames: tuple[Any, dict[int, mujoco.MjModel]] | None = None
        self.drawn_spec = spec.copy()  # with the shells and skins that only a picture needs
        for geom in list(spec.geoms):
            if not geom.contype and not geom.conaffinity:
                spec.delete(geom)
        # parts of hollow objects, further bodies: each may touch
        more = (len(table.slots) - len(SLOTS) if table is not None else 0) + 4 * len(self.furniture.parts)
        more += 8 * (self.scene.table is not None)
        bodies = [p.body for p in self.furniture.parts]
        self.engine = make_engine(
            spec,
            n_worlds,
            device,
            engine,
            fields=(*OBJECT_FIELDS, "dof_damping", "dof_frictionloss", "dof_armature"),
            pairs=contact_pairs(self.hand, root, bodies),
            deterministic=sim["deterministic"],
            nconmax=sim["nconmax"] + 2 * more,
            njmax=sim["njmax"] + 8 * more,
            threads=sim["threads"],
            collision=sim.get("collision", "auto"),
            solver=sim.get("solver", "auto"),
        )
        drives = cfg["servo"]
        if base is not None:
            drives = {**drives, "joints": {**drives["joints"], **base.servos()}}
        self.servo = Servo(
            self.engine,
            self.joints,
            ServoTable.from_dict(drives),
            control_period=self.dt,
            varied=list(cfg["randomize"].get("servo", {})),
        )
        if table is not None:
            self.objects = Objects(self.engine, table, list(self.hand.tip_geoms), d)
        if self.reality is not None and table is not None:
            self.objects.friction_factor = self.reality.friction_factor(
                self.engine.mjm, self.objects.hand_geoms.tolist()
            )
        shown = [v.shape for v in table.variants] if table is not None else []
        pairs = [[f"tip_{f}", *(f"tip_{f}:{body}" for body in bodies)] for f in self.hand.finger_names]
        self.touch = Tactile(
            self.engine,
            hand_layout(self.hand) or tip_layout(self.hand),
            ShapeSet([*shown, *(p.touch for p in self.furniture.parts)], device),
            [OBJECT, *bodies] if bodies else OBJECT,
            cfg["tactile"],
            pairs=pairs,
            tips=tip_skins(self.hand) if self.hand.touches else None,
        )
        for k, part in enumerate(self.furniture.parts, 1):
            self.touch.shape_id[:, k] = len(shown) + k - 1
            self.touch.shape_size[:, k] = torch.as_tensor(part.size, dtype=torch.float32, device=device)
        self.sampler = Sampler(cfg["randomize"], self.rng, n_worlds, device)
        self._index()
        self._buffers()
        self._kernels()
        self._nan_dump, self.dump_folder = NanDump(self), Path()
        self.setup()
        compile_side_by_side(self._name_kernels, device)
        self.reset_all()
        self._check_widths()

    def _check_rewards(self) -> None:
        """UserError for a weight of a reward that the task does not know, or that is no number."""
        known, file = self.reward_words(), type(self).__module__
        for name, weight in self.task["rewards"].items():
            if name not in known:
                raise UserError(
                    f"task.rewards.{name}={weight}: the task {self.task['name']} has no reward of this name, or no"
                    f" words for it in `reward_words` of its file; it has {', '.join(sorted(known))} ({file})"
                )
            if isinstance(weight, bool) or not isinstance(weight, (int, float)) or not math.isfinite(weight):
                raise UserError(f"task.rewards.{name}={weight}: must be a finite number; 0 leaves it out ({file})")

    @classmethod
    def config(cls) -> dict[str, Any]:
        """The settings of a task that has them in its class; see `dexsim.tasks.Task`. Raises UserError."""
        raise UserError(f"{cls.__name__}: its settings stand in a file; derive from dexsim.tasks.Task for your own")

    @classmethod
    def prepare(cls, cfg: dict, **given: Any) -> None:
        """Make what the task of this configuration must find before it is built. given: arguments of the class."""

    def _check_given(self) -> None:
        """UserError for one of the settings `given` that nothing has read: it would change nothing."""
        keys, self.given = self.given, ()
        read = self.task.read | {f"randomize.{name}" for name in self.sampler.read}
        later = ("task.evaluation", "task.presets", "task.objects.emphasis")
        mine = [k for k in keys if k.startswith(("task.", "randomize.")) and not k.startswith(later)]
        for key in unread(read, mine):
            raise UserError(
                f"{key}: nothing reads this setting, with the others as they are, so that it would change nothing;"
                " leave it out, or switch on what it belongs to"
            )

    def _check_widths(self) -> None:
        """UserError where a group of observations has not the columns that its table states."""
        for group, rows in self.describe()["observations"].items():
            stated, is_wide = sum(row[1] for row in rows), self.obs[group].shape[1]
            if stated != is_wide:
                raise UserError(
                    f"task {self.task['name']}: the {group} sees {is_wide} numbers, its table has {stated}"
                    f" ({', '.join(f'{row[0]} {row[1]}' for row in rows)}): make them equal"
                )

    @classmethod
    def check_deployed(cls, source: str) -> None:
        """UserError where a policy of this task cannot be exported for a robot. source: its checkpoint."""
        raise UserError(
            f"{source}: {cls.__name__} declares no terms, so that the deployed loop cannot build what its policy sees"
        )

    # -- for the task to fill in
    # -----------------------------------------------------------------------------------------
    def setup(self) -> None:
        """Allocate what the task needs; called once, before the first reset."""

    def begin_episodes(self, mask: torch.Tensor) -> None:
        """Sample new episodes where mask [N] holds: object, servo, initial state (through `place`)."""
        raise NotImplementedError

    def before_physics(self) -> None:
        """Commands, pushes: once a control step, before physics."""

    def feel(self) -> None:
        """Sensing after the last physics step of a control step: launches only, since it is recorded in the step's
        graph."""
        self.touch.launch()

    def terminated(self) -> dict[str, torch.Tensor]:
        """Named terminations, bool [N] each."""
        raise NotImplementedError

    def reward_words(self) -> dict[str, str]:
        """By name of each reward term that the task knows: what it is, for the first screen."""
        raise NotImplementedError

    def reward_rows(self) -> list[tuple[str, float, str]]:
        """(name, weight, what it is) of the rewards in the settings."""
        words = self.reward_words()
        return [(name, weight, words[name]) for name, weight in self.task["rewards"].items()]

    def rewards(self) -> dict[str, torch.Tensor]:
        """Named reward terms, weighted, [N] each."""
        raise NotImplementedError

    def observe(self, advance: bool) -> dict[str, torch.Tensor]:
        """Observation groups, [N, D] each. advance: a control step has passed (sensors with memory move on)."""
        raise NotImplementedError

    @property
    def max_episode_length(self) -> int:
        """Control steps after which an episode times out; on the device too, so that a recorded step sees a change."""
        return self._length

    @max_episode_length.setter
    def max_episode_length(self, steps: int) -> None:
        self._length = steps
        self._length_limit.fill_(steps)

    @property
    def episode_length_buf(self) -> torch.Tensor:
        """Control steps since each episode began, [N]. Assigning copies: a recorded step holds this memory."""
        return self._episode_length

    @episode_length_buf.setter
    def episode_length_buf(self, steps: torch.Tensor) -> None:
        self._episode_length.copy_(steps)

    # -- rsl-rl's interface
    # ------------------------------------------------------------------------------------------------
    def get_observations(self) -> TensorDict:
        return TensorDict({k: v.clone() for k, v in self.obs.items()}, batch_size=[self.num_envs], device=self.device)

    def step(self, actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict]:
        """One control period. Returns (observations, rewards [N], dones [N], extras); worlds that ended are reset, and
        their observation is the new episode's first. extras: "time_outs" [N], "log" (means over worlds), and with
        `keep_final_obs` also "final_obs", the observations before the reset."""
        self._steps_since += 1
        self._action_in.copy_(actions)
        self._replay("before", self._before)
        substeps = self.decimation if self.reality is None else self.reality.substeps(self.decimation)
        self.engine.step(substeps, self.servo.before_each, self.feel)
        self._replay("after", self._after)
        if self.given:
            self._check_given()
        if self.keep_final_obs:
            final = {k: torch.nan_to_num(v, 0.0, 0.0, 0.0) for k, v in self.observe(advance=False).items()}
        self._replay("reset", self._reset_done)
        observations, reward, done, extras = self.results()
        if self.keep_final_obs:
            extras["final_obs"] = TensorDict(final, batch_size=[self.num_envs], device=self.device)
        return observations, reward, done, extras

    def results(self) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict]:
        """What `step` returns, copied: the next step writes over the environment's own."""
        assert self._log_values is not None  # since the first step
        log = dict(zip(self._log_names, self._log_values.clone().unbind(), strict=True))
        extras = {"time_outs": self.time_out.clone(), "log": log}
        return self.get_observations(), self.reward.clone(), self.done.to(torch.long), extras

    def _before(self) -> None:
        self.act(self._action_in)
        with self._drawn_ahead("orders"):
            self.before_physics()
        self._nan_dump.before()

    def _after(self) -> None:
        self.episode_length_buf += 1
        self.read_state()
        ends, terms = self.terminated(), self.rewards()
        if self._wrong is None:
            self._check_terms(ends, terms)
        rates, reward = self._judge(ends, terms)
        self._rates = rates
        self._nan_dump.after(self.nan)
        self._log(terms, ends, torch.cat([reward, rates]).mean(1))

    def _check_terms(self, ends: dict[str, torch.Tensor], terms: dict[str, torch.Tensor]) -> None:
        """UserError for a term that is not one value for each world."""
        for kind, values in (("termination", ends), ("reward", terms)):
            for name, value in values.items():
                if value.shape != (self.num_envs,):
                    raise UserError(
                        f"{kind} {name}: has shape {list(value.shape)}, must be [{self.num_envs}]: one value for each"
                        " world (squeeze the last axis?)"
                    )
        if not terms:
            raise UserError(f"task {self.task['name']}: no reward is left; give one a weight, task.rewards.NAME=1")
        self.end_names = (*ends, "nan", "time_out")

    def ended_by(self) -> torch.Tensor:
        """Index into `end_names` [N] of what ended the episodes that the last step ended."""
        return self._rates.argmax(0)

    def _judge(
        self, ends: dict[str, torch.Tensor], terms: dict[str, torch.Tensor]
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Fill `reward`, `done`, `time_out`. A world of which a reward or the last observation is not finite begins
        anew as one whose state is not; counts by state, term and group for `check`. Returns what ended each world, 1 or
        0 [E + 2, N] (`nan` and `time_out` last), and its rewards [T, N], 0 where it was not finite."""
        if self._wrong is None:
            self._sources = ("state", *(f"reward {k}" for k in terms), "observations")
            with torch.inference_mode(False):  # it outlives the rollout that happens to come first
                self._wrong = torch.zeros(len(self._sources), dtype=torch.long, device=self.device)
        reward = torch.stack(list(terms.values()))
        ended = torch.stack(list(ends.values())) if ends else self.nan[None][:0]
        rates = torch.empty(len(ends) + 2, self.num_envs, device=self.device)
        count = self.nan_count.view(1)
        given = filled(
            state_kernels.Ends, episode_length=self._episode_length, limit=self._length_limit.view(1),
            blind=self._blind[0], ends=ended,
        )  # fmt: skip
        out = filled(state_kernels.Ended, total=self.reward, done=self.done, time_out=self.time_out, rates=rates)
        inputs = [given, *map(wp.from_torch, (reward, self.nan, self._wrong, count)), out]
        wp.launch(state_kernels.judge, dim=self.num_envs, inputs=inputs, device=self.device)
        return rates, reward

    @contextmanager
    def _drawn_ahead(self, name: str) -> Iterator[None]:
        """On a GPU, all random numbers of a part of the step at once; evaluation draws as ever, whatever the device."""
        with self.sampler.drawn_ahead(name) if self.graphs and self.draws_ahead else nullcontext():
            yield

    def _reset_done(self) -> None:
        if self.skip_idle_resets and not bool(self.done.any()):
            self._observe_all()
            return
        self.reset(self.done)

    def _replay(self, name: str, part: Callable[[], None]) -> None:
        """Run a part of the step. On CUDA it is recorded once (after two plain runs) and replayed: thousands of small
        kernels a second would otherwise keep the GPU waiting for Python. `graphs = False` runs it plainly, for whoever
        changes settings that a recording holds (evaluation does)."""
        if not (self.graphs and self.device.startswith("cuda")):
            part()
            return
        self._runs[name] = self._runs.get(name, 0) + 1
        if self._runs[name] <= 2:
            with self._constants:
                part()
            return
        graph = self._recorded.get(name)
        if graph is None:
            graph = torch.cuda.CUDAGraph()
            graph.register_generator_state(self.rng)
            now = torch.cuda.current_stream()
            recording = torch.cuda.graph(graph, stream=now, capture_error_mode="thread_local")
            with unrecordable(self.task["name"]), self._constants, recording:
                part()
            self._recorded[name] = graph
        graph.replay()

    def act(self, actions: torch.Tensor) -> None:
        """Turn actions [N, J] into targets. `relative`: the target moves by action * scale a step, held within the
        joint limits and within `lead` of the measured angle (a driver can do the same); `absolute`: the action spans
        the joint's range."""
        act, reach = self.task["action"], self._reach
        reach.relative = act["mode"] == "relative"
        moves = float(act.get("scale", 0.0)), act.get("lead", 0.0)
        if moves != self._moves:
            self._moves = moves
            self._reaches[0, : len(self.hand.joints)] = moves[0]
            self._reaches[1, : len(self.hand.joints)] = self.lead()
        inputs = [wp.from_torch(actions.to(torch.float32)), reach, *self._act_args]
        wp.launch(state_kernels.act, dim=actions.shape, inputs=inputs, device=self.device)
        if self.reality is None:
            self.servo.send(self.target)
        else:
            late, arrives = self.reality.late(self.num_envs)
            self.servo.send(self.target, arrives, self.engine.t.time + late)

    def lead(self) -> torch.Tensor:
        """How far targets may run ahead of the measured angles [J] rad: what the task says, or, where that is null, to
        where the drive's torque reaches its limit. A target that is farther away pushes no harder in simulation; on a
        hand that is stiffer than its model it does, and unwinding it takes time everywhere."""
        said, J = self.task["action"].get("lead", 0.0), len(self.hand.joints)
        if said is not None:
            return torch.full((J,), float(said), device=self.device)
        return torch.minimum(self.servo.saturation[:J].float(), (self.q_high - self.q_low)[:J])

    def reset_all(self) -> None:
        """Begin an episode in every world."""
        mask = torch.ones(self.num_envs, dtype=torch.bool, device=self.device)
        self.reset(mask)

    def reset(self, mask: torch.Tensor) -> None:
        """Begin new episodes where mask [N] holds, and refresh the observations of all worlds."""
        with self._drawn_ahead("episodes"):
            self.begin_episodes(mask)
        self.engine.refresh()
        self._clear_touch(mask)
        self.episode_length_buf.masked_fill_(mask, 0)
        self.action.masked_fill_(mask[:, None], 0.0)
        self.last_action.masked_fill_(mask[:, None], 0.0)
        self.read_state()
        self._observe_all()

    def _observe_all(self) -> None:
        self._blind.zero_()
        with self._drawn_ahead("observations"):
            observed = self.observe(advance=True)
        for row, (group, value) in enumerate(observed.items(), 1):
            if group not in self.obs:
                self.obs[group] = torch.zeros_like(value)
            args, dim = [wp.from_torch(value), row, wp.from_torch(self._blind)], value.shape
            wp.launch(state_kernels.note_not_finite, dim=dim, inputs=args, device=self.device)
            out = wp.from_torch(self.obs[group])
            wp.launch(state_kernels.keep_finite, dim=dim, inputs=[*args, out], device=self.device)

    def place(
        self,
        mask: torch.Tensor,
        hand_q: torch.Tensor,
        object_pose: torch.Tensor,
        object_velocity: torch.Tensor,
        target: torch.Tensor | None = None,
        also: Mapping[int, torch.Tensor] | None = None,
    ) -> None:
        """Where mask holds: hand at rest at hand_q [N, J], sent to target [N, J] (hand_q without one); object at pose
        [N, 7] (x y z, w x y z) moving at velocity [N, 6] (linear in the palm frame, angular in the object's own), where
        it moves freely. also: values [N] of further numbers of qpos, by index (`q_of`)."""
        e, target = self.engine, hand_q if target is None else target
        # what else there is begins as the scene has it
        qpos = e.t.qpos.clone() if self._alone else self._begin_q.expand_as(e.t.qpos).clone()
        qvel = torch.zeros_like(e.t.qvel)
        at_q, at_v = self._object_at
        qpos[:, self.joint_q] = hand_q.to(qpos.dtype)
        if self.scene.free:
            qpos[:, at_q : at_q + 7] = object_pose.to(qpos.dtype)
            qvel[:, at_v : at_v + 6] = object_velocity.to(qvel.dtype)
        for index, value in (also or {}).items():
            qpos[:, index] = value.to(qpos.dtype)
        if self.hand.couplings.passive:
            qpos = self._couplings.complete(qpos)
        e.set_state(mask, qpos, qvel)
        self.servo.reset(mask, target)
        self.touch.reset(mask)
        torch.where(mask[:, None], target, self.target, out=self.target)

    def kernels(self) -> list[wp.Kernel]:
        """Kernels of a step beside its physics, one of each module at least; a task adds its own."""
        real = self.engine.real
        own = [self._read, state_kernels.act, nan_dump.keep_world]
        write = [] if self.scene.object is None else [object_kernel.write_kernel(real)]
        return [*own, *write, servos.draw_kernel(real), randomize.spread]

    def _name_kernels(self) -> None:
        """For `compile_side_by_side`, which asks of a launch only which kernel it is of."""
        for kernel in self.kernels():
            wp.launch(kernel, dim=1)

    def _clear_touch(self, mask: torch.Tensor) -> None:
        """Where mask [N] holds, nothing is touched: no force, centres at the pads' centres (poses are refreshed)."""
        touch, state = self.touch, self.engine.wp
        wp.launch(
            state_kernels.clear_touch,
            dim=touch.force.shape,
            inputs=[wp.from_torch(mask), state.xpos, state.xmat, *self._touch_args],
            device=self.device,
        )
        for raw in (touch.raw, touch.raw_clean, touch.raw3):
            if raw is not None:
                raw.masked_fill_(mask.view(-1, *(1,) * (raw.dim() - 1)), 0.0)

    # -- state
    # ---------------------------------------------------------------------------------------------------------------
    def read_state(self) -> None:
        """Copy what terms use from the engine, in palm-frame float32; NaN worlds read as zeros, flagged in `nan`
        [N]."""
        wp.launch(self._read, dim=self._read_dim, inputs=self._read_args, device=self.device)
        if not self.scene.free:
            self._read_object()
        if self.servo.misread:  # what a hand's own sensors say is all that a policy will know of them
            ok = ~self.nan[:, None]
            for own, reported in ((self.q, self.servo.position()), (self.qd, self.servo.velocity())):
                own.copy_(torch.where(ok, reported, 0.0))
        if self.reality is not None:
            self.reality.read(self)

    def _read_object(self) -> None:
        """Pose and velocity of an object on a joint; `object_joint` [N] rad or m and `object_speed` [N]."""
        e = self.engine.t
        if self.scene.object is None:
            return
        body, (at_q, at_v) = self.objects.body, self._object_at
        turned = rotation.from_matrix(e.xmat[:, body].float())
        self.object_pose.copy_(torch.nan_to_num(torch.cat([e.xpos[:, body].float(), turned], 1)))
        self.object_joint.copy_(torch.nan_to_num(e.qpos[:, at_q].float()))
        self.object_speed.copy_(torch.nan_to_num(e.qvel[:, at_v].float()))
        self.object_velocity.zero_()
        part = 0 if isinstance(self.scene.object, Slide) else 3
        self.object_velocity[:, part : part + 3] = self.object_speed[:, None] * self.object_axis

    def q_of(self, joint: str) -> int:
        """Index in qpos of a joint of the scene (the first of a free one's seven): "object_joint", "NAME_free" of a
        further object, "TREE/JOINT" of an imported one."""
        return int(self.engine.mjm.jnt_qposadr[self.engine.joint(joint)])

    def v_of(self, joint: str) -> int:
        """The same in qvel."""
        return int(self.engine.mjm.jnt_dofadr[self.engine.joint(joint)])

    def _index(self) -> None:
        e, dev, hand = self.engine, self.device, self.hand
        mjm = e.mjm

        def long(x: Any) -> torch.Tensor:
            return torch.as_tensor(x, dtype=torch.long, device=dev)

        self._couplings = Couplings(mjm, self.joints)
        self.joint_q, self.joint_v = long(e.qpos_index(self.joints)), long(e.dof_index(self.joints))
        self._object_at = 0, 0
        if self.scene.object is not None:
            joint = "object_free" if self.scene.free else "object_joint"
            self._object_at = self.q_of(joint), self.v_of(joint)
        if self.scene.free:
            self.object_q = long(range(self._object_at[0], self._object_at[0] + 7))
            self.object_v = long(range(self._object_at[1], self._object_at[1] + 6))
        elif self.scene.object is not None:
            axis = mjm.jnt_axis[e.joint(joint)]
            self.object_axis = torch.as_tensor(axis, dtype=torch.float32, device=dev)
        self._alone = self.scene.free and not self.furniture.parts and not self.furniture.joints
        self._begin_q = torch.as_tensor(mjm.qpos0, dtype=e.t.qpos.dtype, device=dev)[None]
        bounds, efforts = np.asarray(hand.limits), np.asarray(hand.efforts)
        base = self.scene.base
        if base is not None:
            far = np.repeat([base.travel, base.turn], 3)
            bounds = np.concatenate([bounds, np.stack([-far, far], 1)])
            efforts = np.concatenate([efforts, np.repeat(base.limit, 3)])
        limits = torch.as_tensor(bounds, dtype=torch.float32, device=dev)
        self.q_low, self.q_high = limits[:, 0], limits[:, 1]
        self.q_mid, self.q_half = limits.mean(1), (limits[:, 1] - limits[:, 0]) / 2
        self.effort = torch.as_tensor(efforts, dtype=torch.float32, device=dev)
        self.tip_body = long([e.body(b) for b in hand.tip_bodies])
        self.pad_centre = torch.as_tensor(self.touch.layout.centre(), dtype=torch.float32, device=dev)
        self.tip_offset = torch.tensor([f.position for f in hand.fingers], dtype=torch.float32, device=dev)
        # fingers that press against the others, and those; the joints whose torque closes each finger
        self.opposing, self.others = long(hand.opposing), long(hand.others)
        self.roots = long([f.flexion[0] for f in hand.fingers])

    def _buffers(self) -> None:
        n, dev, J, F = self.num_envs, self.device, self.num_actions, self.fingers

        def zeros(*shape: int, dtype: torch.dtype = torch.float32) -> torch.Tensor:
            return torch.zeros(n, *shape, dtype=dtype, device=dev)

        self._episode_length = zeros(dtype=torch.long)
        self.action, self.last_action, self.target = zeros(J), zeros(J), zeros(J)
        self.q, self.qd, self.torque = zeros(J), zeros(J), zeros(J)
        self.object_pose, self.object_velocity = zeros(7), zeros(6)
        self.object_joint, self.object_speed = zeros(), zeros()
        self.tip_force, self.finger_force, self.self_force, self.palm_force = zeros(F), zeros(F), zeros(F), zeros()
        self.tips = zeros(F, 3)
        self.nan, self.done, self.time_out = zeros(dtype=torch.bool), zeros(dtype=torch.bool), zeros(dtype=torch.bool)
        self.reward = zeros()
        # worlds of which an observation was not finite: of any group, then of each
        self._blind = torch.zeros(1 + MOST_GROUPS, n, dtype=torch.bool, device=dev)
        self.last: dict[str, torch.Tensor] = {}  # figures [N] of each world's last ended episode
        self._wrong = None  # world-steps that were not finite since the last `check`, by source
        self._sources = ()
        self._steps_since = 0
        self._action_in = zeros(J)
        self._log_names: tuple[str, ...] = ()
        self._log_values: torch.Tensor | None = None
        self.graphs, self.keep_final_obs = True, False
        self.draws_ahead = self.device.startswith("cuda")  # what a new episode draws; on a CPU it saves nothing
        # Where states live on the CPU anyway, asking costs nothing, and a reset of no world is an eighth of a step.
        # (The random numbers that it would draw are then not drawn. Warp on a CPU does as it does on CUDA.)
        self.skip_idle_resets = self.engine.kind == "mujoco"
        self._runs: dict[str, int] = {}
        self._recorded: dict[str, torch.cuda.CUDAGraph] = {}
        self._constants = Constants(self.device)
        self.obs: dict[str, torch.Tensor] = {}
        self.nan_count = torch.zeros((), dtype=torch.long, device=dev)

    def _kernels(self) -> None:
        """What `read_state` and `_clear_touch` launch."""
        e, state = self.engine, self.engine.wp
        self._read = state_kernels.read_kernel(e.real)
        self._read_dim = self.num_envs, self.num_actions + state_kernels.OBJECT_NUMBERS + self.fingers + 1
        object_q, object_v = self._object_at
        at = filled(
            state_kernels.Places, joint_q=self.joint_q, joint_v=self.joint_v, object_q=object_q, object_v=object_v,
            tip_body=self.tip_body, tip_offset=self.tip_offset,
        )  # fmt: skip
        kept = state_kernels.Seen.vars  # type: ignore[attr-defined]  # wp.struct adds it
        seen = filled(state_kernels.Seen, **{name: getattr(self, name) for name in kept})
        self._read_args = [
            state.flags, state.qpos, state.qvel, wp.from_torch(self.servo.torque), state.pair_normal, state.xpos,
            state.xmat, at, seen,
        ]  # fmt: skip
        base = self.scene.base
        self._moves: tuple[float, float | None] = (0.0, 0.0)
        self._reaches = torch.zeros(2, self.num_actions, device=self.device)
        if base is not None:
            far = [[x[0]] * 3 + [x[1]] * 3 for x in (base.scale, base.lead)]
            self._reaches[:, len(self.hand.joints) :] = torch.tensor(far)
        self._reach = filled(
            state_kernels.Reach, relative=False, scale=self._reaches[0], lead=self._reaches[1], low=self.q_low,
            high=self.q_high,
            middle=self.q_mid, half=self.q_half,
        )  # fmt: skip
        self._act_args = [wp.from_torch(x) for x in (self.q, self.action, self.last_action, self.target)]
        touch = self.touch
        self._touch_args = [
            at.tip_body, wp.from_torch(self.pad_centre, dtype=wp.vec3),
            *map(wp.from_torch, (touch.force, touch.force_clean, touch.force_other)),
            *(wp.from_torch(x, dtype=wp.vec3) for x in (touch.centre, touch.centre_clean)),
        ]  # fmt: skip

    # -- bookkeeping
    # -----------------------------------------------------------------------------------------------------------
    def _log(self, terms: dict, ends: dict, means: torch.Tensor) -> None:
        """means: of the reward terms, of how worlds ended, over all worlds."""
        metrics = self.metrics()
        values = torch.cat([means, torch.stack(list(metrics.values()))]) if metrics else means
        if self._log_values is None:
            ended = [f"end/{k}" for k in (*ends, "nan", "time_out")]
            self._log_names = (*(f"reward/{k}" for k in terms), *ended, *metrics)
            with torch.inference_mode(False):  # it outlives the rollout that happens to come first
                self._log_values = torch.zeros(values.shape, device=self.device)
        self._log_values.copy_(values)

    def metrics(self) -> dict[str, torch.Tensor]:
        """Task metrics for the log, scalars on the device."""
        return {}

    def drawn_model(self, world: int) -> mujoco.MjModel:
        """A model of one world as it is now, with the shells and skins, to render its qpos; reads from the device."""
        drawn = self._drawn = self._drawn or self.drawn_spec.compile()
        model = copy.copy(drawn)
        for slot in self.objects.scene.slots if self.scene.object is not None else ():
            g = drawn.geom(slot).id
            e = self.engine.geom(slot)
            for name in ("geom_pos", "geom_quat", "geom_size", "geom_dataid"):
                value = self.engine.field(name)[world, e].cpu().numpy()
                getattr(model, name)[g] = value
            model.geom_group[g] = 0
        return model

    def render(self, world: int = 0, size: tuple[int, int] = (640, 480)) -> np.ndarray:
        """A picture [H, W, 3] uint8 of one world as it is now, without a display; size: width, height. Raises
        UserError where no OpenGL opens."""
        from dexsim.view.frames import Frames

        if self._frames is None or self._frames[0].size != size:
            self._frames = Frames(size, self.camera), {}
        frames, models = self._frames
        model = models.get(world)
        fresh = int(self._episode_length[world]) <= 1  # an episode's object may be another
        if model is None or fresh:
            models.clear()
            model = models[world] = self.drawn_model(world)
        return frames(model, self.engine.t.qpos[world].double().cpu().numpy())

    def close(self) -> None:
        """Give back memory and threads at once; afterwards nothing but `close` may be called.

        They refer to each other in circles, so that Python would keep them until it happens to look for such; of 64
        worlds that is some 100 MB.
        """
        for part in ("_recorded", "_nan_dump", "touch", "servo", "objects", "sampler", "engine"):
            held = self.__dict__.pop(part, None)
            if hasattr(held, "__dict__"):
                vars(held).clear()
        held = None
        self.__dict__.clear()
        give_back()

    def check(self) -> None:
        """Raise UserError if contacts were lost since the last call, or more than MOST_NAN of all world-steps were not
        finite; write a world that was not finite to `dump_folder` (a file nan_<k>.npz). Reads from the device: once an
        iteration."""
        path = self._nan_dump.write(Path(self.dump_folder))
        if path is not None:
            print(
                f"a world was not finite and began anew ({int(self.nan_count)} so far); one is kept in {path}: "
                f"dexsim nan-dump {path} repeats the step",
                flush=True,
            )
        self._check_share()
        self.engine.check_overflow()

    def _check_share(self) -> None:
        """A few worlds that diverge cost their episodes only; many mean that a setting makes them."""
        if self._wrong is None:
            return
        counts, steps = self._wrong.tolist(), self._steps_since * self.num_envs
        self._wrong.zero_()
        self._steps_since = 0
        if sum(counts) > MOST_NAN * steps and sum(counts) > 20:
            where = ", ".join(f"{k} {100 * n / steps:.0f} %" for k, n in zip(self._sources, counts, strict=True) if n)
            raise UserError(
                f"not finite in so many of the last {steps} world-steps that nothing is learned from them: {where};"
                " allowed"
                f" {100 * MOST_NAN:.0f} % in all. Look at what this task's settings of that name are, or lower"
                " sim.timestep"
            )

    def action_rows(self) -> list[tuple[str, float, float, str]]:
        """(joint, lowest, highest, what) of the targets, for the first screen."""
        what, base = f"rad ({self.task['action']['mode']})", len(self.hand.joints)
        low, high = self.q_low.tolist(), self.q_high.tolist()
        return [(j, low[k], high[k], what if k < base or k >= base + 3 else what.replace("rad", "m"))
                for k, j in enumerate(self.joints)]  # fmt: skip

    def usual_ends(self) -> list[tuple[str, str]]:
        """Rows of the ends that every task has."""
        return [("nan", "state not finite"), ("time_out", f"{self.max_episode_length} steps")]

    def describe(self) -> dict[str, Any]:
        """Tables for the first screen: "observations" (name, width, what) by group, "action", "rewards",
        "terminations", "randomization", "notes", and "headline", names of the log that the console shows."""
        return {
            "observations": {group: [(group, value.shape[1], "")] for group, value in self.obs.items()},
            "action": self.action_rows(),
            "rewards": [row for row in self.reward_rows() if row[1]],
            "terminations": self.usual_ends(),
            "randomization": self.sampler.rows(),
            "notes": self.hand_notes(),
        }

    def figure_units(self) -> dict[str, str]:
        """Units of the figures in `last`, which an evaluation reports."""
        return dict.fromkeys(self.last, "")

    def judge_kept_out(self, kept_out: bool) -> None:
        """Episodes begin with objects kept out of the training from now on, or with those of it."""
        raise UserError(f"task {self.task['name']}: has task.objects.held_out, and no judge_kept_out that draws them")

    def evaluate(
        self,
        policy: Callable[..., torch.Tensor],
        episodes: int = 256,
        seed: int = 0,
        progress: Callable[..., None] | None = None,
    ) -> dict:
        """Play episodes; returns {"metrics", "tables", "frames"} and perhaps "plots" (`dexsim.tasks.evaluation`)."""
        from dexsim.tasks.evaluation import evaluate

        return evaluate(self, policy, episodes, seed, progress)

    def hand_notes(self) -> list[str]:
        """What a reader of the first screen must know of the hand."""
        guessed = self.hand.file.guessed
        return [
            *([] if self.pads else ["no touch: this hand has no pads; nothing of touch is observed"]),
            *([f"guessed in {self.hand.folder}/hand.yaml, to be checked: {', '.join(guessed)}"] if guessed else []),
        ]

    @property
    def action_names(self) -> tuple[str, ...]:
        return self.joints

    def memory(self) -> dict[str, torch.Tensor | tuple[torch.Tensor, int, int]]:
        """What a control step leaves to the next, live; a task adds its own. Whole numbers with their lowest and
        highest."""
        names = ("action", "last_action", "target", "q", "qd", "torque", "object_pose", "object_velocity", "tips")
        out = {name: getattr(self, name) for name in (*names, "nan")}
        out |= {f"obs_{group}": value for group, value in self.obs.items()}
        return out | {"episode_length": (self._episode_length, 0, 2**31), "width": self.sampler.width}

    def keep_worlds(self) -> dict[str, torch.Tensor]:
        """A copy of all worlds: with it, a run goes on as if it had not stopped (`tasks/worlds.py`)."""
        return worlds.keep(self)

    def load_worlds(self, state: dict[str, torch.Tensor]) -> None:
        """Go on from `keep_worlds()`. Raises ValueError, and changes nothing, for those of another environment."""
        worlds.put_back(self, state)

    def state_dict(self) -> dict[str, torch.Tensor]:
        """What a resumed run needs beside the worlds: counters and random state."""
        return {"rng": self.rng.get_state(), "nan_count": self.nan_count.clone()}

    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        rng = state["rng"].cpu()
        if rng.shape == self.rng.get_state().shape:
            self.rng.set_state(rng)
        else:  # learned until now on another kind of device, whose generator is another one
            self.rng.manual_seed(zlib.crc32(rng.numpy().tobytes()))
        self.nan_count.copy_(state["nan_count"])
        self.reset_all()


def _periods(sim: dict, task: dict) -> tuple[int, float]:
    dt, control = float(sim["timestep"]), float(sim["control_period"])
    if not 1e-4 <= dt <= 0.02:
        raise UserError(f"sim.timestep={dt}: must lie in [0.0001, 0.02] s")
    k = round(control / dt)
    if k < 1 or not math.isclose(k * dt, control, rel_tol=1e-6):
        raise UserError(
            f"sim.control_period={control} s is not a multiple of sim.timestep={dt} s; e.g."
            f" sim.control_period={max(k, 1) * dt:.4g}"
        )
    if task["episode_s"] < control:
        raise UserError(f"task.episode_s={task['episode_s']}: must be at least one control period, {control} s")
    return k, control


def model_of(hand: Hand, path: str | None) -> mujoco.MjSpec:
    """The hand's model, or a file's version of it (a diagnosis writes one where inertia or mass was fitted).

    Raises UserError for a file that does not compile, or lacks a joint, fingertip body or fingertip geom of the
    hand."""
    if path is None:
        return hand.spec()
    if not os.path.isfile(files.place(path)):
        raise UserError(f"model_file={path}: no such file")
    spec = model_file.read(files.place(path), f"model_file={path}")
    has = {x.name for x in (*spec.joints, *spec.bodies, *spec.geoms)}
    missing = [n for n in (*hand.joints, *hand.tip_bodies, *hand.tip_geoms) if n not in has]
    if missing:
        raise UserError(
            f"model_file={path}: is not a model of hand={hand.name}: it lacks {', '.join(missing[:4])}; give the"
            " model.xml that a diagnosis of this hand wrote"
        )
    return spec



def _solver_options(spec: mujoco.MjSpec, sim: dict, engine: str, several: bool) -> None:
    """several: contacts of two hulls may be, or what lies on a table would rock."""
    o = spec.option
    o.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    o.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    o.impratio = sim["impratio"]
    o.iterations, o.ls_iterations = newton_iterations(sim, engine), sim["ls_iterations"]
    o.noslip_iterations = sim["noslip_iterations"]
    if engine == "warp":  # MuJoCo-Warp then adds up an iteration's Hessian in one kernel, not two: 7 % of the step
        o.jacobian = mujoco.mjtJacobian.mjJAC_SPARSE
    if not several:  # one contact a convex pair, so that a fingertip's stiffness is that of one contact
        o.disableflags |= mujoco.mjtDisableBit.mjDSBL_MULTICCD
