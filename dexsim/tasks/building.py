"""Builds what an environment steps: hand, object and what else there is in one scene, its engine, drives and touch."""

from __future__ import annotations

import copy
import math
import os
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import mujoco
import numpy as np
import torch

from dexsim import files, model_file, system
from dexsim.actuator.servo import Servo
from dexsim.actuator.table import ServoTable
from dexsim.assets.objects.own import named
from dexsim.errors import UserError
from dexsim.hand import Hand, load_hand
from dexsim.hand.couplings import Couplings
from dexsim.hand.places import places
from dexsim.hand.skin import link_skins, tip_skins
from dexsim.sim import ContactPair, make_engine
from dexsim.sim.make import engine_of, solver_iterations
from dexsim.sim.scene import OBJECT, OBJECT_FIELDS, SLOTS, hand_object_scene
from dexsim.tactile.layout import hand_layout, tip_layout
from dexsim.tactile.shapes import ShapeSet
from dexsim.tactile.tactile import Tactile
from dexsim.tasks.objects import Objects
from dexsim.tasks.randomize import Sampler
from dexsim.tasks.reality import Reality, present
from dexsim.tasks.recorded import Constants
from dexsim.tasks.scenes import BASE, Scene, fasten, furnish, mount
from dexsim.tasks.watched import Watched

if TYPE_CHECKING:

    class VecEnv:
        """Stand for rsl-rl's class, which says nothing of its types: a wrong name on an environment is then seen."""

else:
    from rsl_rl.env import VecEnv

MOST_GROUPS = 4
"""Groups of observations that a task may have."""
UNIT_SPAN = 0.1
"""m, `span` of the hand that the lengths in task settings are for; they are multiplied by span / UNIT_SPAN."""
UNIT_PALM = 0.025
"""m, height of that hand's palm over the origin of its palm frame."""


def contact_pairs(hand: Hand, root: str, parts: Sequence[str] = ()) -> tuple[ContactPair, ...]:
    """Return contact pairs of hand scenes, F fingers: fingertip on object (0 .. F-1), whole finger on object
    (F .. 2F-1), palm on object (2F), distal link on the hand itself (2F+1 .. 3F); of links with skin, on the object
    and on the hand itself; then fingertips and those links on each of the bodies `parts`. root: the hand's root
    body."""
    obj, own = ("body", OBJECT), ("subtree", root)
    pads = dict(pad_pairs(hand))
    links = {p.body: name for p, name in zip(hand.pads, self_pairs(hand), strict=True) if p.body not in hand.tip_bodies}
    return (
        *(ContactPair(f"tip_{f.name}", f.presses, obj) for f in hand.fingers),
        *(ContactPair(f"finger_{f.name}", ("subtree", f.root), obj) for f in hand.fingers),
        ContactPair("palm", ("body", hand.palm_body), obj),
        *(ContactPair(f"self_{f.name}", ("body", f.body), own) for f in hand.fingers),
        *(ContactPair(name, first, obj) for name, first in pads.items() if name.startswith("link_")),
        *(ContactPair(name, ("body", body), own) for body, name in links.items()),
        *(ContactPair(f"{name}:{body}", first, ("body", body)) for body in parts for name, first in pads.items()),
    )


def pad_pairs(hand: Hand) -> list[tuple[str, tuple[str, str]]]:
    """Return the name of the contact pair with the object whose force each pad feels (each fingertip, without touch),
    and its first member: the fingertip; where a link has skin, the link, whose pads share its force."""
    skin = {p.body for p in hand.file.skin}
    tips = {f.body: (f"tip_{f.name}", f.presses) for f in hand.fingers}
    bodies = [*hand.tip_bodies, *(p.body for p in hand.file.skin)]
    return [(f"link_{b}", ("body", b)) if b in skin else tips[b] for b in bodies]


def self_pairs(hand: Hand) -> list[str]:
    """Return the name of the contact pair of each pad's body and the rest of the hand."""
    tips = dict(zip(hand.tip_bodies, hand.finger_names, strict=True))
    return [f"self_{tips[p.body]}" if p.body in tips else f"hand_{p.body}" for p in hand.pads]


def hand_of(cfg: dict) -> Hand:
    """Return the hand of a resolved config; the xHand for checkpoints from before there was a choice.

    Raises UserError."""
    return load_hand(cfg.get("hand") or "xhand", cfg.get("hand_mirror", False), cfg.get("hand_scale", 1.0))


class Built(VecEnv):
    """N worlds of a hand and its object, and the memory that holds their state; see `HandEnv`."""

    scene: ClassVar[Scene] = Scene()
    """What the world holds beside the hand."""
    TAKES_OBJECTS: bool = False
    """Whether `objects=` and `kept_out=` may give it a user's own objects (`task.objects`)."""
    camera: ClassVar[dict[str, Any] | None] = None
    """View of a film: lookat [3] m, distance m, azimuth and elevation in degrees; None: the usual one."""
    evaluation: ClassVar[str] = "dexsim.tasks.evaluation"
    """Module whose `evaluate` plays episodes."""
    given: Sequence[str] = ()
    """Names of settings that the user gave: after the first step each must have been read."""
    _own: Sequence[str] = ()
    """Names of settings that the task's class brings: likewise, in training and where the user gave none."""
    learning = True
    """False while an evaluation plays."""
    history = 1
    """Control steps of the actor's whole observation that it sees, newest first."""
    nan_count: torch.Tensor
    _reach: Any
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
        self.fingers, self.pads = len(self.hand.fingers), len(self.hand.pads)
        self.decimation, self.dt = _periods(sim, self.task)
        if self.task["action"]["mode"] not in ("relative", "absolute"):
            raise UserError(f"task.action.mode={self.task['action']['mode']}: must be relative or absolute")
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
            spec.stat.extent = 0.5  # m: by it a film is cut off near and far, and that body would make it 2 km
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
        touched = [v.shape for v in table.variants] if table is not None else []
        pairs = [[name, *(f"{name}:{body}" for body in bodies)] for name, _ in pad_pairs(self.hand)]
        skin = bool(self.hand.file.skin)
        self.touch = Tactile(
            self.engine,
            hand_layout(self.hand) or tip_layout(self.hand),
            ShapeSet([*touched, *(p.touch for p in self.furniture.parts)], device),
            [OBJECT, *bodies] if bodies else OBJECT,
            cfg["tactile"] if self.hand.touches and len(pairs) > 1 else cfg["tactile"] | {"feel_others": False},
            pairs=pairs,
            tips=tip_skins(self.hand) if self.hand.touches else None,
            links=link_skins(self.hand) if skin else None,
            selves=self_pairs(self.hand) if skin else None,
        )
        for k, part in enumerate(self.furniture.parts, 1):
            self.touch.shape_id[:, k] = len(touched) + k - 1
            self.touch.shape_size[:, k] = torch.as_tensor(part.size, dtype=torch.float32, device=device)
        self.sampler = Sampler(cfg["randomize"], self.rng, n_worlds, device)
        self._index()
        self._buffers()

    def hand_notes(self) -> list[str]:
        """Return what a reader of the first screen must know of the hand."""
        guessed = self.hand.file.guessed
        return [
            *([] if self.pads else ["no touch: this hand has no pads; nothing of touch is observed"]),
            *([f"guessed in {self.hand.folder}/hand.yaml, to be checked: {', '.join(guessed)}"] if guessed else []),
        ]

    @property
    def action_names(self) -> tuple[str, ...]:
        return self.joints

    def action_rows(self) -> list[tuple[str, float, float, str]]:
        """Return (joint, lowest, highest, what) of the targets, for the first screen."""
        what, base = f"rad ({self.task['action']['mode']})", len(self.hand.joints)
        low, high = self.q_low.tolist(), self.q_high.tolist()
        return [(j, low[k], high[k], what if k < base or k >= base + 3 else what.replace("rad", "m"))
                for k, j in enumerate(self.joints)]  # fmt: skip

    def q_of(self, joint: str) -> int:
        """Index in qpos of a joint of the scene (the first of a free one's seven): "object_joint", "NAME_free" of a
        further object, "TREE/JOINT" of an imported one."""
        return int(self.engine.mjm.jnt_qposadr[self.engine.joint(joint)])

    def v_of(self, joint: str) -> int:
        """Return the same in qvel."""
        return int(self.engine.mjm.jnt_dofadr[self.engine.joint(joint)])

    def _index(self) -> None:
        e, dev, hand = self.engine, self.device, self.hand
        mjm = e.mjm

        def long(x: Any) -> torch.Tensor:
            return torch.as_tensor(x, dtype=torch.long, device=dev)

        self._couplings = Couplings(mjm, self.joints)
        self.joint_q, self.joint_v = long(e.qpos_index(self.joints)), long(e.dof_index(self.joints))
        self._sensed_q = long(e.qpos_index(hand.sensed))
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
        self.pad_body = long([e.body(b) for b in self.touch.layout.bodies])
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
        self.figures: dict[str, torch.Tensor] = {}  # the same, of the present one
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

    def drawn_model(self, world: int) -> mujoco.MjModel:
        """Return a model of one world as it is now, with shells and skins, to render its qpos; reads the device."""
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
        """Return a picture [H, W, 3] uint8 of one world as it is now, without a display; size: width, height. Raises
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
        system.give_back()


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
    """Return the hand's model, or a file's version of it (a diagnosis writes one where inertia or mass was fitted).

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
    """Set the solver's options; several: two hulls may have several contacts, or what lies on a table would rock."""
    o = spec.option
    o.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    o.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    o.impratio = sim["impratio"]
    o.iterations, o.ls_iterations = solver_iterations(sim, engine)
    o.noslip_iterations = sim["noslip_iterations"]
    if engine == "warp":  # MuJoCo-Warp then adds up an iteration's Hessian in one kernel, not two: 7 % of the step
        o.jacobian = mujoco.mjtJacobian.mjJAC_SPARSE
    if not several:  # one contact a convex pair, so that a fingertip's stiffness is that of one contact
        o.disableflags |= mujoco.mjtDisableBit.mjDSBL_MULTICCD
